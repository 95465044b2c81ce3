"""Stored demos: played again in a fresh process they succeed, by our command and by ManiSkill's."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import h5py
import pytest

from sacil_tasks import gen_demos, replay
from sacil_tasks.catalog import env_id
from sacil_tasks.errors import UsageError
from sacil_tasks.gen_demos import GenConfig
from sacil_tasks.keyframes import KeyframeFile
from sacil_tasks.replay import ReplayConfig

TASK = "pick_and_lift"
DEMOS = 3


def generate(out: Path, **flags: object) -> Path:
    """Demos of the real expert; returns their folder."""
    gen_demos.main(
        GenConfig(**{"tasks": (TASK,), "demos": DEMOS, "out": out, "workers": 1} | flags)
    )
    return out / "canon" / "train" / "demos" / TASK


def hashes(demos: Path) -> tuple[str, str]:
    """Of all arrays of keyframes (pixels too) and of trajectories."""
    with KeyframeFile.open(demos.parents[1] / "keyframes" / f"{TASK}.h5") as file:
        return file.content_sha256, file.meta.demos_sha256


def run(*command: object) -> subprocess.CompletedProcess[str]:
    """A command line in a process of its own, as a user starts it."""
    words = [sys.executable, "-m", *map(str, command)]
    return subprocess.run(words, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return generate(tmp_path_factory.mktemp("data"))


@pytest.fixture
def copy(demos: Path, tmp_path: Path) -> Path:
    """Demos that may be spoilt."""
    return Path(shutil.copytree(demos, tmp_path / "demos"))


@pytest.mark.sim
@pytest.mark.slow
def test_demos_are_bit_identical_for_two_workers_and_whatever_was_made_before(demos, tmp_path):
    """With two workers a demo meets another process, renderer and history."""
    assert hashes(generate(tmp_path, workers=2)) == hashes(demos)


@pytest.mark.sim
@pytest.mark.slow
def test_replaying_succeeds_without_drift(demos):
    ended = run("sacil_tasks.replay", "--demos", demos)
    assert ended.returncode == 0, ended.stderr
    last = ended.stdout.splitlines()[-1]
    assert last == f"{DEMOS}/{DEMOS} demos succeed again, largest drift 0.000 mm"


@pytest.mark.sim
@pytest.mark.slow
def test_maniskills_own_command_replays_them(copy):
    command = "mani_skill.trajectory.replay_trajectory"
    ended = run(command, "--traj-path", copy / "trajectory.h5", "--save-traj")
    assert ended.returncode == 0, ended.stderr
    assert f"{DEMOS}/{DEMOS}=100.00% demos saved" in ended.stdout


@pytest.mark.sim
@pytest.mark.slow
def test_a_demo_that_fails_is_counted_and_named(copy, capsys):
    with h5py.File(copy / "trajectory.h5", "r+") as file:
        file["traj_0/actions"][:] = file["traj_0/actions"][0]
    with pytest.raises(UsageError, match="1 of 1 demos do not succeed again here"):
        replay.main(ReplayConfig(demos=copy, count=1))
    assert f"{TASK} demo 0: FAILED" in capsys.readouterr().out


def test_a_folder_without_demos_is_one_sentence_and_exit_code_2(tmp_path):
    ended = run("sacil_tasks.replay", "--demos", tmp_path)
    assert ended.returncode == 2
    assert ended.stderr.startswith(f"error: no trajectory.h5 in or below {tmp_path}. Make demos")
    assert ended.stderr.count("\n") == 1


@pytest.fixture
def made_up(tmp_path: Path) -> Path:
    """The two files of one demo, as far as they are read before a simulator starts."""
    with h5py.File(tmp_path / "trajectory.h5", "w") as file:
        file["traj_0/actions"] = [[0.0] * 8]
    record = {"episodes": [{"episode_id": 0, "reset_kwargs": {"seed": 0}}]}
    (tmp_path / "trajectory.json").write_text(json.dumps(record))
    return tmp_path


@pytest.mark.parametrize("name", ["trajectory.h5", "trajectory.json"])
@pytest.mark.parametrize("content", [b"", b"{}", b'{"episodes": [{"episode_id": 7'])
def test_damaged_and_foreign_files_are_one_sentence(made_up, name, content):
    (made_up / name).write_bytes(content)
    with pytest.raises(UsageError, match=r"is damaged .*Delete the folder"):
        replay.main(ReplayConfig(demos=made_up))


def test_a_missing_half_is_one_sentence(made_up):
    (made_up / "trajectory.json").unlink()
    with pytest.raises(UsageError, match=r"is damaged .*No such file"):
        replay.main(ReplayConfig(demos=made_up))


def test_trajectories_that_are_listed_but_missing_are_counted(made_up):
    with h5py.File(made_up / "trajectory.h5", "w") as file:
        file["somebody else's"] = 1
    with pytest.raises(UsageError, match="lacks 1 trajectories"):
        replay.main(ReplayConfig(demos=made_up))


@pytest.mark.parametrize(
    ("episodes", "env_info"),
    [([], {"env_kwargs": {}}), ([{"episode_id": 0}], {"env_kwargs": {}}), (None, {})],
)
def test_a_list_without_demos_or_resets_is_one_sentence(made_up, episodes, env_info):
    content = json.loads((made_up / "trajectory.json").read_text())
    content["env_info"] = env_info | {"env_id": f"sacil_tasks:{env_id(TASK)}"}
    content["episodes"] = content["episodes"] if episodes is None else episodes
    (made_up / "trajectory.json").write_text(json.dumps(content))
    with pytest.raises(UsageError, match="lists no demos, or not how"):
        replay.main(ReplayConfig(demos=made_up))


@pytest.mark.parametrize("count", [0, -1])
def test_a_count_below_one_is_refused(made_up, count):
    with pytest.raises(UsageError, match="--count is at least 1"):
        replay.main(ReplayConfig(demos=made_up, count=count))


def test_a_recording_of_another_environment_is_one_sentence(made_up):
    """ManiSkill's own files have the same layout, but name no environment of ours."""
    content = json.loads((made_up / "trajectory.json").read_text())
    content["env_info"] = {"env_id": "PickCube-v1", "env_kwargs": {}}
    (made_up / "trajectory.json").write_text(json.dumps(content))
    with pytest.raises(UsageError, match="holds demos of PickCube-v1"):
        replay.main(ReplayConfig(demos=made_up))
