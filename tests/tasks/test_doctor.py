"""The doctor's verdicts: every failure is a line with what to do, and the exit code tells."""

import pytest

from sacil_tasks import doctor, vulkan
from sacil_tasks.doctor import Check, CheckError, DoctorConfig, diagnose, run_in_child
from sacil_tasks.errors import UsageError


def raise_check_error() -> str:
    raise CheckError("the thing is missing")


def test_a_failure_names_the_problem_and_the_remedy():
    finding = diagnose(Check("thing", raise_check_error, "Install the thing."))
    assert not finding.ok
    assert finding.text == "the thing is missing. Install the thing."


def test_a_remedy_is_said_once():
    def no_device() -> str:
        raise CheckError(vulkan.find_problem([]))

    finding = diagnose(Check("vulkan", no_device, vulkan.INSTALL_HINT))
    assert finding.text.count(vulkan.INSTALL_HINT) == 1


@pytest.mark.parametrize(
    ("code", "reason"),
    [
        ("import os; os.kill(os.getpid(), 11)", "SIGSEGV"),
        ("import no_such_library", "no_such_library"),
        ("raise OSError('libGL.so.1: cannot open')", "libGL"),
        ("sys.exit(3)", "exit code 3"),
    ],
)
def test_what_happens_to_a_child_becomes_a_reason(code, reason):
    with pytest.raises(CheckError, match=reason):
        run_in_child(code)


def test_the_last_line_of_a_child_is_its_answer():
    assert run_in_child("print('noise'); print('answer')") == "answer"


def test_an_untested_python_is_refused(monkeypatch):
    monkeypatch.setattr(doctor.sys, "version_info", (3, 9, 1))
    with pytest.raises(CheckError, match=r"3\.11"):
        doctor.check_python()


def test_one_failed_check_fails_the_command(monkeypatch, capsys):
    checks = (Check("good", lambda: "fine", ""), Check("bad", raise_check_error, "Mend it."))
    monkeypatch.setattr(doctor, "QUICK_CHECKS", checks)
    with pytest.raises(UsageError, match="1 of 2 checks failed: bad"):
        doctor.main(DoctorConfig(quick=True))
    assert "Mend it." in capsys.readouterr().out


def test_a_machine_without_vulkan_fails_only_that_check(monkeypatch, tmp_path):
    monkeypatch.setenv("VK_DRIVER_FILES", str(tmp_path / "none.json"))
    monkeypatch.setenv("VK_ICD_FILENAMES", str(tmp_path / "none.json"))
    failed = [c.name for c in doctor.QUICK_CHECKS if not diagnose(c).ok]
    assert failed == ["vulkan"]


@pytest.mark.sim
@pytest.mark.slow
def test_this_machine_passes_every_check():
    doctor.main(DoctorConfig())
