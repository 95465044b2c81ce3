"""Finished demos -> `trajectory.h5 + .json` in ManiSkill's layout and `keyframes/<task>.h5`.

A new demo is first a file of its own, `parts/<index>.h5`, which appears whole or not at all; when
all are there they are merged. So generation may be killed at any instant without losing or
doubling a demo. The keyframe file appears last: once it is there, the stage is finished.
"""

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from jaxtyping import Bool, Float32

from sacil_tasks.catalog import MAX_EPISODE_STEPS, env_id, suite_names, suite_tasks, task_spec
from sacil_tasks.errors import UsageError
from sacil_tasks.files import atomic_hdf5, content_hash, write_json
from sacil_tasks.instructions import variations
from sacil_tasks.keyframes import (
    KeyframeDemo,
    KeyframeFile,
    KeyframeMeta,
    arrays_sha256,
    copy_demo,
    create_tables,
    seal,
    write_demo,
)
from sacil_tasks.workers import JobFailure

REDRAW_STRIDE = 1_000_000

MAX_FAILURES = 10
"""Scenes tried for one demo before it is given up."""

ENV_KWARGS: Mapping[str, Any] = {
    "obs_mode": "none",
    "control_mode": "pd_joint_pos",
    "sim_backend": "physx_cpu",
}
"""How the environment is made for a demo and for its replay."""

_PART_SCHEMA = 2


StateTree = dict[str, Any]
"""Nested dicts of arrays with the same structure as ManiSkill's `get_state_dict()`."""


@dataclass(frozen=True, kw_only=True)
class Trajectory:
    """One episode, as ManiSkill's `RecordEpisode` stores it."""

    actions: Float32[np.ndarray, "steps joints"]
    success: Bool[np.ndarray, "steps"]
    states: StateTree
    """Leaves have one row more than there are actions: the first is the state after the reset."""


@dataclass(frozen=True, kw_only=True)
class DemoSet:
    """All demos of one task, split and partition, and where they are kept."""

    out: Path
    task: str
    split: str
    partition: str
    scene_set: int
    code_version: str

    @property
    def folder(self) -> Path:
        """Holds `trajectory.h5`, `trajectory.json`, `expert.json` and, while at work, `parts`."""
        return self.out / self.split / self.partition / "demos" / self.task

    @property
    def trajectory(self) -> Path:
        """The ManiSkill trajectory file."""
        return self.folder / "trajectory.h5"

    @property
    def keyframes(self) -> Path:
        """The file that training reads."""
        return self.out / self.split / self.partition / "keyframes" / f"{self.task}.h5"

    @property
    def identity(self) -> dict[str, Any]:
        """What all files of this set have in common; files of another set are not mixed in."""
        names = ("task", "split", "partition", "scene_set", "code_version")
        return {name: getattr(self, name) for name in names}

    def part(self, index: int) -> Path:
        """The file of one finished demo before merging."""
        return self.folder / "parts" / f"{index:06d}.h5"


@dataclass(frozen=True)
class ExpertFailure:
    """A scene in which the expert did not succeed."""

    scene_index: int
    reason: str
    """Outcome code, refused keyframe, or what happened to the worker."""


@dataclass(frozen=True)
class DemoJob:
    """One demo to make."""

    demos: DemoSet
    index: int
    failures: tuple[ExpertFailure, ...] = ()
    """Scenes already tried in vain."""

    retried: bool = False
    """A worker has died of the next scene once."""

    @property
    def variation(self) -> int:
        """The same in every redraw, so that the words stay balanced."""
        return self.index % len(variations(task_spec(self.demos.task), self.demos.split))

    @property
    def given_up(self) -> bool:
        """Whether so many scenes were tried in vain that it is not worth another."""
        return len(self.failures) >= MAX_FAILURES

    def scene_index(self, redraw: int) -> int:
        """Scene of a redraw: beyond the scenes of all other demos."""
        return self.index + redraw * REDRAW_STRIDE

    def after(self, failure: JobFailure) -> "DemoJob":
        """What to do next about a job whose worker failed: once again, then another scene."""
        if failure.died and not self.retried:
            return replace(self, retried=True)
        scene_index = self.scene_index(redraw=len(self.failures))
        failures = (*self.failures, ExpertFailure(scene_index, failure.reason))
        return replace(self, failures=failures, retried=False)


def save_part(
    demos: DemoSet, index: int, keyframes: KeyframeDemo, trajectory: Trajectory, record: Mapping
) -> None:
    """Write one finished demo; `record` becomes its entry in `trajectory.json`.

    Raises:
        UsageError: the folder cannot be written or the disk is full.
    """
    with atomic_hdf5(demos.part(index)) as file:
        create_tables(file, episodes=1, demo_rows=len(keyframes.observations))
        write_demo(file, keyframes, episode_id=0, first_row=0)
        _write_trajectory(file.create_group("trajectory"), trajectory)
        file.attrs["record"] = json.dumps(record)
        file.attrs["identity"] = _part_identity(demos, index)


def has_part(demos: DemoSet, index: int) -> bool:
    """Whether the demo is finished and still to be merged; parts of another set do not count."""
    try:
        with h5py.File(demos.part(index), "r") as file:
            return file.attrs.get("identity") == _part_identity(demos, index)
    except OSError:
        return False


def count_merged(demos: DemoSet) -> int:
    """How many demos the finished files hold; 0 if there are none.

    Raises:
        UsageError: they are damaged or belong to another scene set or version.
    """
    if not demos.keyframes.exists():
        return 0
    with KeyframeFile.open(demos.keyframes) as file:
        found = {name: getattr(file.meta, name) for name in demos.identity}
        count = len(file.episodes)
    if found != demos.identity:
        raise UsageError(
            f"{demos.keyframes} holds demos of {found}, asked for are {demos.identity}; "
            "delete its folder or choose another one with --out."
        )
    if len(read_records(demos.folder)) < count:
        raise UsageError(
            f"{demos.folder} has fewer demos than {demos.keyframes}; delete both to make them anew."
        )
    return count


def read_records(folder: Path) -> list[dict[str, Any]]:
    """Entries of `trajectory.json`, one a demo, checked against the trajectories beside it.

    Raises:
        UsageError: one of the two files is missing or damaged, or they do not fit.
    """
    trajectory = folder / "trajectory.h5"
    if not trajectory.is_file():
        raise UsageError(
            f"no demos at {trajectory}. Make them with `python -m sacil_tasks.gen_demos`."
        )
    try:
        records = json.loads(trajectory.with_suffix(".json").read_text())["episodes"]
        with h5py.File(trajectory, "r") as file:
            missing = [r for r in records if f"traj_{r['episode_id']}/actions" not in file]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UsageError(
            f"{trajectory} or the .json beside it is damaged ({error}). "
            "Delete the folder and run `python -m sacil_tasks.gen_demos` again."
        ) from error
    if missing:
        raise UsageError(f"{trajectory} lacks {len(missing)} trajectories that its .json lists.")
    return records


def merge(demos: DemoSet, count: int) -> None:
    """Join merged demos and parts, `count` in all; the parts stay.

    Raises:
        UsageError: the folder cannot be written or the disk is full.
    """
    merged = count_merged(demos)
    records = _merge_records(demos, count, merged)
    arrays = _merge_trajectories(demos, count, merged)
    write_json(
        demos.trajectory.with_suffix(".json"),
        {
            "env_info": {
                "env_id": f"sacil_tasks:{env_id(demos.task)}",
                "max_episode_steps": MAX_EPISODE_STEPS,
                "env_kwargs": dict(ENV_KWARGS),
            },
            "source_type": "motionplanning",
            "source_desc": "expert keyframes executed by sacil_tasks.motion",
            "identity": demos.identity,
            "episodes": records,
        },
    )
    write_json(demos.folder / "expert.json", expert_summary(records))
    _merge_keyframes(demos, count, merged, demos_sha256=content_hash([arrays, records]))


def drop_parts(demos: DemoSet) -> None:
    """Remove parts, all of which have been merged."""
    shutil.rmtree(demos.folder / "parts", ignore_errors=True)


def expert_summary(records: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """How the expert fared: successes and trials by size words, failures, scenes accepted."""
    by_size: dict[str, dict[str, int]] = {}
    for record in records:
        tally = by_size.setdefault(
            " then ".join(record["slots"].values()), {"successes": 0, "trials": 0}
        )
        tally["successes"] += 1
        tally["trials"] += 1 + len(record["failures"])
    return {
        "successes": len(records),
        "trials": sum(tally["trials"] for tally in by_size.values()),
        "by_size": dict(sorted(by_size.items())),
        "scenes_accepted": len(records),
        "scenes_drawn": sum(record["attempt"] + 1 for record in records),
        "failures": [{"demo": r["episode_id"], **f} for r in records for f in r["failures"]],
    }


def _part_identity(demos: DemoSet, index: int) -> str:
    return content_hash([_PART_SCHEMA, demos.identity, index])


def _write_trajectory(group: h5py.Group, trajectory: Trajectory) -> None:
    never = [False] * len(trajectory.actions)
    success, states = trajectory.success, trajectory.states
    tree = {"actions": trajectory.actions, "success": success, "terminated": success}
    _write_tree(group, tree | {"fail": never, "truncated": never, "env_states": states})


def _write_tree(group: h5py.Group, tree: StateTree) -> None:
    for name, branch in tree.items():
        if isinstance(branch, dict):
            _write_tree(group.create_group(name), branch)
        else:
            group.create_dataset(name, data=branch, compression="gzip", shuffle=True)


def _merge_records(demos: DemoSet, count: int, merged: int) -> list[dict[str, Any]]:
    records = read_records(demos.folder)[:merged] if merged else []
    for index in range(merged, count):
        with h5py.File(demos.part(index), "r") as part:
            records.append({"episode_id": index, **json.loads(part.attrs["record"])})
    return records


def _merge_trajectories(demos: DemoSet, count: int, merged: int) -> str:
    with atomic_hdf5(demos.trajectory) as file:
        for index in range(count):
            old = index < merged
            path = demos.trajectory if old else demos.part(index)
            with h5py.File(path, "r") as source:
                source.copy(f"traj_{index}" if old else "trajectory", file, f"traj_{index}")
        return arrays_sha256(file, tuple(file))


def _merge_keyframes(demos: DemoSet, count: int, merged: int, *, demos_sha256: str) -> None:
    meta = KeyframeMeta(
        **demos.identity,
        env_id=f"sacil_tasks:{env_id(demos.task)}",
        suites={suite: suite_tasks(suite) for suite in suite_names()},
        demos_sha256=demos_sha256,
    )
    with atomic_hdf5(demos.keyframes) as file:
        create_tables(file, episodes=count, demo_rows=task_spec(demos.task).keyframes + 1)
        first_row = 0
        for index in range(count):
            old = index < merged
            with h5py.File(demos.keyframes if old else demos.part(index), "r") as source:
                first_row += copy_demo(
                    source,
                    file,
                    episode=index if old else 0,
                    episode_id=index,
                    first_row=first_row,
                )
        seal(file, meta)
