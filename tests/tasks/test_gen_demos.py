"""Generation: killed, extended, spread over workers or crashing, it makes the same demos."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import pytest

from sacil_tasks import gen_demos
from sacil_tasks.demos import DemoSet, read_records
from sacil_tasks.errors import UsageError
from sacil_tasks.files import sole_writer
from sacil_tasks.gen_demos import GenConfig
from sacil_tasks.keyframes import KeyframeFile

TASK = "pick_up_cup"


def generate(out: Path, expert: str = "make_expert", **flags: object) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gen_demos, "EXPERT", f"tests.tasks.synthetic_expert:{expert}")
        gen_demos.main(
            GenConfig(**{"tasks": (TASK,), "out": out, "workers": 1, "demos": 5} | flags)
        )


def keyframes_of(out: Path) -> Path:
    return out / "canon" / "train" / "keyframes" / f"{TASK}.h5"


def demos_of(out: Path) -> Path:
    return out / "canon" / "train" / "demos" / TASK


def hashes(out: Path) -> tuple[str, str]:
    with KeyframeFile.open(keyframes_of(out)) as file:
        return file.content_sha256, file.meta.demos_sha256


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("unbroken")
    generate(out, demos=12)
    return out


def test_variations_take_turns_and_every_file_is_there(unbroken):
    records = read_records(demos_of(unbroken))
    assert [record["slots"]["size"] for record in records[:3]] == ["small", "medium", "large"]
    with KeyframeFile.open(keyframes_of(unbroken)) as file:
        assert [episode.variation for episode in file.episodes] == [0, 1, 2] * 4
        assert [episode.scene_index for episode in file.episodes] == list(range(12))
    assert sorted(path.name for path in demos_of(unbroken).iterdir()) == [
        "expert.json",
        "trajectory.h5",
        "trajectory.json",
    ]


def test_two_workers_make_what_one_makes(unbroken, tmp_path):
    generate(tmp_path, demos=12, workers=2)
    assert hashes(tmp_path) == hashes(unbroken)


def test_a_finished_run_again_does_nothing(unbroken, capsys):
    before = keyframes_of(unbroken).stat().st_mtime_ns
    generate(unbroken, "no_such_expert", demos=12)
    assert keyframes_of(unbroken).stat().st_mtime_ns == before
    assert "12 demos" in capsys.readouterr().out


def test_a_larger_number_extends_to_what_would_have_been_made_at_once(unbroken, tmp_path):
    generate(tmp_path, demos=5)
    generate(tmp_path, demos=12)
    assert hashes(tmp_path) == hashes(unbroken)


KILLABLE = """
import sys
from pathlib import Path
from sacil_tasks import gen_demos
from sacil_tasks.errors import run_command
gen_demos.EXPERT = "tests.tasks.synthetic_expert:make_slow_expert"
config = gen_demos.GenConfig(tasks=("pick_up_cup",), out=Path(sys.argv[1]), workers=2, demos=12)
run_command(lambda: gen_demos.main(config))
"""


@pytest.mark.parametrize("blow", [signal.SIGKILL, signal.SIGINT])
@pytest.mark.parametrize("parts", [1, 7])
def test_a_run_stopped_at_any_instant_resumes_to_the_same_demos(unbroken, tmp_path, blow, parts):
    run = subprocess.Popen([sys.executable, "-c", KILLABLE, tmp_path], stderr=subprocess.PIPE)
    deadline = time.monotonic() + 60
    while len(list(demos_of(tmp_path).glob("parts/0*.h5"))) < parts:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    run.send_signal(blow)
    _, stderr = run.communicate()
    assert run.returncode == (130 if blow == signal.SIGINT else -signal.SIGKILL)
    assert b"Traceback" not in stderr
    assert not keyframes_of(tmp_path).exists()
    generate(tmp_path, demos=12)
    assert hashes(tmp_path) == hashes(unbroken)
    assert not (demos_of(tmp_path) / "parts").exists()


@pytest.mark.parametrize(
    "step", ["demos.write_json", "demos._merge_keyframes", "gen_demos.drop_parts"]
)
def test_a_kill_while_files_are_merged_loses_nothing(unbroken, tmp_path, step):
    generate(tmp_path, demos=5)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(f"sacil_tasks.{step}", _die)
        with pytest.raises(KeyboardInterrupt):
            generate(tmp_path, demos=12)
    generate(tmp_path, demos=12)
    assert hashes(tmp_path) == hashes(unbroken)


def _die(*_: object, **__: object) -> None:
    raise KeyboardInterrupt


def test_failures_and_crashes_are_drawn_again_with_the_same_words(tmp_path, capsys):
    generate(tmp_path, "make_fragile_expert", workers=2)
    records = read_records(demos_of(tmp_path))
    assert [len(record["failures"]) for record in records] == [0, 1, 0, 2, 0]
    assert records[1]["failures"][0]["reason"] == "the worker died of SIGSEGV"
    with KeyframeFile.open(keyframes_of(tmp_path)) as file:
        assert [e.variation for e in file.episodes] == [0, 1, 2, 0, 1]
        assert [e.scene_index for e in file.episodes] == [0, 1_000_001, 2, 2_000_003, 4]
    expert = json.loads((demos_of(tmp_path) / "expert.json").read_text())
    assert (expert["successes"], expert["trials"]) == (5, 8)
    assert expert["by_size"]["small"] == {"successes": 2, "trials": 4}
    assert "expert 5/8" in capsys.readouterr().out


def test_a_demo_that_never_succeeds_fails_the_run_but_keeps_the_others(tmp_path):
    with pytest.raises(UsageError, match=r"demo 1 of pick_up_cup \(MOTOR_FAIL\)"):
        generate(tmp_path, "make_hopeless_expert")
    assert len(list(demos_of(tmp_path).glob("parts/0*.h5"))) == 4


@pytest.mark.parametrize(
    ("flags", "complaint"),
    [
        ({"tasks": ("pick_up_cups",)}, "Did you mean pick_up_cup"),
        ({"tasks": (), "suite": "duals"}, "no suite called 'duals'"),
        ({"split": "shift_up"}, "pick_up_cup has no split shift_up"),
        ({"demos": 0}, "at least 1"),
    ],
)
def test_wrong_names_are_refused_before_any_worker_starts(tmp_path, flags, complaint):
    with pytest.raises(UsageError, match=complaint):
        generate(tmp_path, "no_such_expert", **flags)


def test_a_task_is_merged_as_soon_as_all_of_its_demos_are_there(tmp_path):
    tasks = (TASK, "push_buttons")
    with pytest.MonkeyPatch.context() as patch:
        merged = []
        patch.setattr(gen_demos, "merge", lambda demos, count: merged.append(demos.task) or _die())
        with pytest.raises(KeyboardInterrupt):
            generate(tmp_path, tasks=tasks)
    assert merged == [TASK]
    assert not list((demos_of(tmp_path).parent / "push_buttons").glob("parts/000004.h5"))
    generate(tmp_path, tasks=tasks)
    assert len(read_records(demos_of(tmp_path))) == 5


def test_two_runs_on_one_folder_do_not_mix(tmp_path):
    with sole_writer(demos_of(tmp_path)), pytest.raises(UsageError, match="another run is writing"):
        generate(tmp_path, "no_such_expert")


def test_demos_of_another_scene_set_are_not_mixed_in(tmp_path):
    generate(tmp_path, demos=1)
    with pytest.raises(UsageError, match="'scene_set': 0"):
        generate(tmp_path, demos=2, seed=1)


def test_a_truncated_part_is_made_again(unbroken, tmp_path):
    with pytest.raises(UsageError):
        generate(tmp_path, "make_hopeless_expert", demos=12)
    part = demos_of(tmp_path) / "parts" / "000003.h5"
    part.write_bytes(part.read_bytes()[:1000])
    generate(tmp_path, demos=12)
    assert hashes(tmp_path) == hashes(unbroken)


@pytest.mark.parametrize("name", ["trajectory.h5", "trajectory.json"])
def test_missing_or_truncated_demos_beside_keyframes_are_reported(tmp_path, name):
    generate(tmp_path, demos=1)
    path = demos_of(tmp_path) / name
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(UsageError, match="damaged"):
        generate(tmp_path, demos=2)
    path.unlink()
    with pytest.raises(UsageError, match=r"no demos at|damaged"):
        generate(tmp_path, demos=2)


def test_an_output_folder_that_cannot_be_is_refused(tmp_path):
    (tmp_path / ".writable" / "occupied").mkdir(parents=True)
    with pytest.raises(UsageError, match="cannot write"):
        generate(tmp_path)


def test_trajectories_have_maniskills_layout(unbroken):
    with h5py.File(demos_of(unbroken) / "trajectory.h5") as file:
        steps = len(file["traj_0/actions"])
        assert {len(file[f"traj_0/{name}"]) for name in ("success", "fail", "truncated")} == {steps}
        assert len(file["traj_0/env_states/actors/candidate_0"]) == steps + 1
    info = json.loads((demos_of(unbroken) / "trajectory.json").read_text())
    assert info["env_info"]["env_id"] == "sacil_tasks:SizedPickUpCup-v1"
    assert [episode["episode_id"] for episode in info["episodes"]] == list(range(12))


def test_part_files_of_another_version_do_not_count(tmp_path):
    from sacil_tasks.demos import has_part
    from tests.tasks.synthetic_expert import work

    ours = DemoSet(
        out=tmp_path, task=TASK, split="canon", partition="train", scene_set=0, code_version="1"
    )
    work(gen_demos.DemoJob(ours, 0))
    theirs = DemoSet(**vars(ours) | {"code_version": "2"})
    assert has_part(ours, 0)
    assert not has_part(theirs, 0)
