"""Writing: whole or not at all, by one process at a time, and every stop says how to go on."""

import json
import resource
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
import pytest

from sacil_tasks.errors import UsageError, run_command
from sacil_tasks.files import atomic_hdf5, sole_writer, write_json

HOLD = """
import sys
from pathlib import Path
from sacil_tasks.files import sole_writer
with sole_writer(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_a_file_appears_whole_or_not_at_all(tmp_path):
    path = tmp_path / "deep" / "file.json"
    with pytest.raises(TypeError, match="JSON"):
        write_json(path, {"no": json})
    assert list(path.parent.iterdir()) == []
    write_json(path, {"whole": True})
    assert [file.name for file in path.parent.iterdir()] == ["file.json"]


@pytest.fixture
def little_room() -> Iterator[None]:
    """No file may grow beyond 10 kB: to the writer it is what a full disk is."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.usefixtures("little_room")
def test_hdf5_on_a_full_disk_is_one_sentence_and_leaves_nothing(tmp_path):
    path = tmp_path / "file.h5"
    with (
        pytest.raises(UsageError, match=r"cannot write .*File too large"),
        atomic_hdf5(path) as file,
    ):
        file["numbers"] = np.arange(100_000)
    assert list(tmp_path.iterdir()) == []


def test_hdf5_is_edited_whole_or_not_at_all(tmp_path):
    path = tmp_path / "file.h5"
    with atomic_hdf5(path) as file:
        file["kept"] = 1
    before = path.read_bytes()
    with pytest.raises(ZeroDivisionError), atomic_hdf5(path, "r+") as file:
        file["lost"] = 1 // 0
    assert path.read_bytes() == before
    with atomic_hdf5(path, "r+") as file:
        file["added"] = 2
    with h5py.File(path) as file:
        assert [file[name][()] for name in ("kept", "added")] == [1, 2]


@pytest.mark.parametrize("write", [lambda path: write_json(path / "x", 1), lambda path: hold(path)])
def test_a_folder_below_a_file_is_one_sentence(tmp_path, write):
    (tmp_path / "file").touch()
    with pytest.raises(UsageError, match=r"cannot write .*Not a directory.*--out"):
        write(tmp_path / "file" / "folder")


def hold(folder: Path) -> None:
    with sole_writer(folder):
        pass


def test_a_folder_has_one_writer_at_a_time_and_keeps_no_trace_of_it(tmp_path):
    folder = tmp_path / "run"
    with sole_writer(folder), pytest.raises(UsageError, match="another run is writing in"):
        hold(folder)
    hold(folder)
    assert list(folder.iterdir()) == []


def test_a_writer_killed_with_9_holds_nothing(tmp_path):
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", HOLD, tmp_path], **pipes) as other:
        assert other.stdout.readline() == b"held\n"
        with pytest.raises(UsageError, match="another run"):
            hold(tmp_path)
        other.send_signal(signal.SIGKILL)
        other.wait()
    hold(tmp_path)


@pytest.mark.parametrize(
    ("stop", "code", "said"),
    [
        (UsageError("no such thing."), 2, "error: no such thing.\n"),
        (KeyboardInterrupt(), 130, "error: stopped by Ctrl-C. Do this.\n"),
    ],
)
def test_a_command_ends_in_one_sentence(stop, code, said, capsys):
    def fail() -> None:
        raise stop

    with pytest.raises(SystemExit) as ended:
        run_command(fail, after_stop="Do this.")
    assert ended.value.code == code
    assert capsys.readouterr().err == said


@pytest.mark.parametrize(
    ("module", "advice"),
    [
        ("sacil_tasks.gen_demos", "The same command again"),
        ("leaderboard.run", "The same command again"),
        ("baselines.train", "The same command with --resume"),
    ],
)
def test_each_command_says_how_to_go_on_after_ctrl_c(module, advice):
    """Ctrl-C comes while the command line is read, before all work."""
    script = (
        "import runpy, sys, tyro\n"
        "def stop(*_, **__): raise KeyboardInterrupt\n"
        "tyro.cli = stop\n"
        f"sys.argv = ['{module}', '--agent', 'rvt']\n"
        f"runpy.run_module('{module}', run_name='__main__')\n"
    )
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert ended.returncode == 130
    assert ended.stderr.splitlines()[-1].startswith(f"error: stopped by Ctrl-C. {advice}".rstrip())
