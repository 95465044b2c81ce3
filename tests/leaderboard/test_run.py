import json
import shlex
from pathlib import Path

import pytest
import tyro

from leaderboard import manifest as manifests
from leaderboard.records import EPISODES_FILE
from leaderboard.run import Job, RunConfig, command_line, default_folder, main
from sacil_tasks.errors import UsageError


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"agent": "oracel"}, "Did you mean oracle"),
        ({"tasks": ("pick_and_lft",)}, "Did you mean pick_and_lift"),
        ({"suite": "slise"}, "Did you mean slice"),
        ({"split": ("cannon",)}, "Did you mean canon"),
        (
            {"tasks": ("pick_up_cup",), "split": ("canon", "shift_up")},
            "pick_up_cup has no split shift_up: its largest size",
        ),
        ({"episodes": 0}, "--episodes must be at least 1"),
        ({"workers": 0}, "--workers must be at least 1"),
        ({"checkpoint": Path("no/such/folder")}, "no checkpoint at no/such/folder"),
    ],
)
def test_a_wrong_word_is_one_sentence_before_anything_starts(changes, sentence, tmp_path):
    with pytest.raises(UsageError, match=sentence):
        Job.of(RunConfig(**{"agent": "oracle", "out": tmp_path / "run"} | changes))
    assert not (tmp_path / "run").exists()


def test_under_a_suite_a_split_that_a_task_lacks_is_not_applicable(tmp_path):
    config = RunConfig(agent="oracle", suite="single", split=("shift_up",), out=tmp_path)
    job = Job.of(config)
    tasks = {key.task for key in job.keys}
    assert "pick_and_lift" in tasks
    assert "pick_up_cup" not in tasks
    assert any(line.startswith("n/a  pick_up_cup shift_up: its larg") for line in job.not_there)


def test_a_group_of_splits_stands_for_its_members(tmp_path):
    config = RunConfig(agent="oracle", tasks=("pick_and_lift",), split=("fine",), out=tmp_path)
    assert len(Job.of(config).splits) == 6


def test_the_default_folder_tells_agents_weights_and_scenes_apart():
    configs = [
        RunConfig(agent="rvt"),
        RunConfig(agent="rvt:small"),
        RunConfig(agent="rvt", checkpoint=Path("runs/train/a")),
        RunConfig(agent="rvt", partition="val"),
        RunConfig(agent="rvt", split=("canon", "shift_down")),
        RunConfig(agent="rvt", seed=1),
    ]
    assert len({default_folder(config) for config in configs}) == len(configs)
    assert default_folder(RunConfig(agent="rvt", episodes=102)) == default_folder(configs[0])


def test_the_stored_command_asks_for_the_same_run():
    config = RunConfig(
        agent="rvt",
        tasks=("pick_and_lift", "push_buttons"),
        episodes=6,
        out=Path("a b"),
        video=True,
    )
    words = shlex.split(command_line(config))
    assert words[:3] == ["python", "-m", "leaderboard.run"]
    assert tyro.cli(RunConfig, args=words[3:]) == config


def manifest(**changes) -> manifests.Manifest:
    standard = {
        "agent": "toy",
        "privileged": False,
        "checkpoint": "abc",
        "partition": "test",
        "scene_set": 0,
        "splits": ["canon"],
        "protocols": {"pick_and_lift": {"hash": "1", "shader": "minimal"}},
        "commands": ["first"],
        "versions": {},
    }
    return manifests.Manifest(**standard | changes)


def test_a_manifest_survives_its_file_and_keeps_its_history(tmp_path):
    first = manifest()
    manifests.write_manifest(tmp_path, first)
    assert manifests.read_manifest(tmp_path) == first
    later = first.joined(manifest(commands=["second"], splits=["shift_up"], protocols={}))
    assert later.commands == ["first", "second"]
    assert later.splits == ["canon", "shift_up"]
    assert later.protocols == first.protocols


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"agent": "rvt"}, "with agent toy, but this one has rvt"),
        ({"checkpoint": "def"}, "with checkpoint abc, but this one has def"),
        ({"partition": "val"}, "with partition test"),
        ({"scene_set": 1}, "with scene_set 0"),
        (
            {"protocols": {"pick_and_lift": {"hash": "2", "shader": "default"}}},
            r"another protocol \(shader differ",
        ),
    ],
)
def test_a_folder_keeps_to_one_agent_checkpoint_and_protocol(changes, sentence, tmp_path):
    with pytest.raises(UsageError, match=sentence):
        manifests.check_same_run(tmp_path, manifest(**changes), manifest())


def test_episodes_without_a_manifest_are_foreign(tmp_path):
    (tmp_path / EPISODES_FILE).write_text("somebody else's notes")
    with pytest.raises(UsageError, match="not a run of ours"):
        manifests.read_manifest(tmp_path)


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"kind": "recipe", "schema_version": 1}'])
def test_a_foreign_manifest_is_one_sentence(content, tmp_path):
    (tmp_path / manifests.MANIFEST_FILE).write_text(content)
    with pytest.raises(UsageError, match="not the manifest of an evaluation"):
        manifests.read_manifest(tmp_path)


def test_test_runs_of_the_same_weights_are_counted(tmp_path):
    for name, changes in {
        "same": {},
        "other_weights": {"checkpoint": "def"},
        "val": {"partition": "val"},
        "other_split": {"splits": ["shift_up"]},
    }.items():
        manifests.write_manifest(tmp_path / name, manifest(**changes))
    (tmp_path / "damaged").mkdir()
    (tmp_path / "damaged" / manifests.MANIFEST_FILE).write_text("x")
    assert manifests.counted(tmp_path / "new", manifest()).test_runs == 2
    assert manifests.counted(tmp_path / "same", manifest()).test_runs == 1
    assert manifests.counted(tmp_path / "new", manifest(partition="val")).test_runs == 0


def test_an_agent_that_dies_while_loading_stops_the_run(tmp_path, monkeypatch):
    (tmp_path / "dies_h6.py").write_text("import os\ndef load(**_):\n    os.abort()\n")
    monkeypatch.syspath_prepend(tmp_path)
    config = RunConfig(agent="dies_h6:load", tasks=("pick_and_lift",), out=tmp_path / "run")
    with pytest.raises(UsageError, match=r"failed while loading .*SIGABRT"):
        main(config)
    assert not (tmp_path / "run").exists()


def test_the_manifest_is_plain_json(tmp_path):
    manifests.write_manifest(tmp_path, manifest())
    assert json.loads((tmp_path / manifests.MANIFEST_FILE).read_text())["kind"] == manifests.KIND
