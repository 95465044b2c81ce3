"""Keyframe files -> samples: which keyframe is shown at which step.

Images stay in memory, compressed (`baselines.packed`), one shard a task.
What is drawn is a pure function of (seed, step), so a resumed run sees what an unbroken one saw.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64

from baselines.packed import PackedRows
from sacil_tasks.errors import UsageError
from sacil_tasks.interface import MAX_KEYFRAMES, SCENE_BOUNDS, Observation
from sacil_tasks.keyframes import (
    IMAGE_COLUMNS,
    NO_ROW,
    Episode,
    KeyframeFile,
)

STREAMS = ("rows", "moves", "goals", "points", "torch")
"""Random streams of a step: one more stream never changes what another draws."""


def stream(seed: int, step: int, name: str) -> np.random.Generator:
    """The generator of one purpose at one step."""
    return np.random.default_rng([seed, step, STREAMS.index(name)])


class Sample(NamedTuple):
    """One observation with a keyframe to be reached from it."""

    shard: int
    row: int


@dataclass(frozen=True)
class Shard:
    """One task's keyframe file in memory."""

    origin: tuple[str, str, str]
    """Task, split and partition."""

    path: Path
    content_sha256: str
    episodes: Sequence[Episode]
    first_rows: Sequence[int]
    columns: dict[str, np.ndarray]
    """Datasets of `observations/` by name, all rows, but for the images."""

    images: dict[str, PackedRows]
    """The images (RGB u8, depth u16), all rows."""

    @classmethod
    def load(cls, path: Path) -> "Shard":
        """Read a whole keyframe file.

        Raises:
            UsageError: missing, truncated, foreign or changed file, or a keyframe outside the
                render cube.
        """
        columns, images = dict[str, np.ndarray](), dict[str, PackedRows]()
        with KeyframeFile.open(path) as file:
            for name, rows in file.columns():
                if name in IMAGE_COLUMNS:
                    images[name] = PackedRows(rows)
                else:
                    columns[name] = rows
            origin = (file.meta.task, file.meta.split, file.meta.partition)
            sha256 = file.content_sha256
            episodes, first_rows = file.episodes, file.first_rows
        _check_in_cube(path, columns["keyframe_in_base"][:, :3])
        return cls(origin, path, sha256, episodes, first_rows, columns, images)

    @property
    def task(self) -> str:
        """Its task."""
        return self.origin[0]

    def __len__(self) -> int:
        """Number of episodes."""
        return len(self.episodes)

    @cached_property
    def meanings(self) -> Sequence[str]:
        """Task and slots of each episode as one word: equal whatever the sentence."""
        return [f"{self.task} {json.dumps(e.slots, sort_keys=True)}" for e in self.episodes]

    def keyframes(self, episode: int) -> range:
        """Rows of an episode that have a keyframe to be reached."""
        first = self.first_rows[episode]
        return range(first, first + self._rows[episode] - 1)

    @cached_property
    def _rows(self) -> Sequence[int]:
        return np.bincount(self.columns["episode_id"], minlength=len(self.episodes)).tolist()

    def choices(self, episode: int) -> list[int]:
        """Rows at which the words decide: the first, and those that turn to another candidate."""
        rows, targets = self.keyframes(episode), self.columns["target_index"]
        turns = [row for row in rows[1:] if NO_ROW != targets[row] != targets[row - 1]]
        return [*rows[:1], *turns]

    def others(self, episode: int) -> Sequence[int]:
        """Rows that can be told from where the hand is; all rows where there are none."""
        choices, rows = self.choices(episode), self.keyframes(episode)
        return [row for row in rows if row not in choices] or rows

    def observation(self, row: int) -> Observation:
        """The observation of `row`, as a policy would have seen it."""
        c = self.columns
        return Observation(
            rgb=self.images["rgb"][row],
            depth_mm=self.images["depth_mm"][row],
            intrinsics=c["intrinsics"][row],
            camera_in_base=c["camera_in_base"][row],
            tcp_in_base=c["tcp_in_base"][row],
            gripper_open=bool(c["gripper_open"][row]),
            step=int(c["step"][row]),
            max_steps=MAX_KEYFRAMES,
        )

    def before(self, row: int) -> list[Observation]:
        """The observations of the same episode before `row`."""
        first = self.first_rows[int(self.columns["episode_id"][row])]
        return [self.observation(earlier) for earlier in range(first, row)]

    def target_in_base(self, row: int) -> Float32[np.ndarray, "7"]:
        """Pose of the keyframe to be reached; at an episode's end the gripper's own pose."""
        target = self.columns["keyframe_in_base"][row]
        return target if np.isfinite(target).all() else self.columns["tcp_in_base"][row]


class KeyframeSet:
    """The keyframes of several tasks, drawn so that every task and every demo weighs the same."""

    def __init__(self, shards: Sequence[Shard]) -> None:
        """Use `load` for files on disk."""
        self.shards = tuple(shards)

    @classmethod
    def load(cls, folder: Path, tasks: Sequence[str]) -> "KeyframeSet":
        """Read `<task>.h5` of every task; `folder` is `<data>/<split>/<partition>/keyframes`.

        Raises:
            UsageError: a file is missing (says how to make it), truncated, foreign, or of another
                task, split or partition than its place says.
        """
        missing = [task for task in tasks if not (folder / f"{task}.h5").is_file()]
        if missing:
            raise UsageError(
                f"no keyframes of {', '.join(missing)} in {folder}. " + _gen_demos(folder, *missing)
            )
        shards = [Shard.load(folder / f"{task}.h5") for task in tasks]
        for task, shard in zip(tasks, shards, strict=True):
            place = (task, *folder.parts[-3:-1])
            if shard.origin != place:
                raise UsageError(
                    f"{shard.path} holds keyframes of {', '.join(shard.origin)}, not of "
                    f"{', '.join(place)}. Move it away. " + _gen_demos(folder, task)
                )
        return cls(shards)

    @property
    def tasks(self) -> tuple[str, ...]:
        """Tasks in the order of `Sample.shard`."""
        return tuple(shard.task for shard in self.shards)

    @cached_property
    def meaning_ids(self) -> dict[str, int]:
        """A number for each task and slots."""
        words = {meaning for shard in self.shards for meaning in shard.meanings}
        return {word: number for number, word in enumerate(sorted(words))}

    def meaning(self, sample: Sample) -> str:
        """Task and slots of a sample."""
        return self.shards[sample.shard].meanings[self.episode(sample)]

    def episode(self, sample: Sample) -> int:
        """Index of a sample's episode within its shard."""
        return int(self.shards[sample.shard].columns["episode_id"][sample.row])

    def everything(self) -> list[Sample]:
        """All samples in file order."""
        return [
            Sample(number, row)
            for number, shard in enumerate(self.shards)
            for episode in range(len(shard))
            for row in shard.keyframes(episode)
        ]

    def draw(
        self, rng: np.random.Generator, count: int, choice_share: float | None
    ) -> list[Sample]:
        """`count` samples: a task, one of its demos, one of the demo's keyframes, each uniform.

        With `choice_share`, that share of them shows keyframes at which the words decide
        (D-choice-share), and tasks weigh there by how many of these a demo has: other keyframes
        can be told from where the hand is, so they do not teach what the words mean.

        A draw without two sizes of one task is repeated: such a batch would let a contrast be
        solved by task identity (D-two-sizes). RVT draws keyframes uniformly within a task and
        repeats late ones for every earlier frame (D-demo-uniform).

        Raises:
            UsageError: no task has demos of two sizes.
            ValueError: `count` is below 2: no draw would ever show two sizes.
        """
        if count < 2:
            raise ValueError(f"a draw of {count} cannot show two sizes; at least 2 are needed")
        self._require_two_meanings()
        while True:
            samples = [self._draw_one(rng, choice_share) for _ in range(count)]
            if self._tells_sizes_apart(samples):
                return samples

    def _draw_one(self, rng: np.random.Generator, choice_share: float | None) -> Sample:
        if choice_share is None:
            return self._draw_from(rng, Shard.keyframes)
        if rng.random() < choice_share:
            return self._draw_from(rng, Shard.choices, self._choices_per_demo)
        return self._draw_from(rng, Shard.others)

    def _draw_from(
        self,
        rng: np.random.Generator,
        rows_of: Callable[[Shard, int], Sequence[int]],
        task_weights: Float64[np.ndarray, "tasks"] | None = None,
    ) -> Sample:
        number = int(rng.choice(len(self.shards), p=task_weights))
        shard = self.shards[number]
        rows = rows_of(shard, int(rng.integers(len(shard))))
        return Sample(number, rows[int(rng.integers(len(rows)))])

    @cached_property
    def _choices_per_demo(self) -> Float64[np.ndarray, "tasks"]:
        """Mean number of choices in a demo of each task, as shares of one."""
        counts = [np.mean([len(s.choices(e)) for e in range(len(s))]) for s in self.shards]
        return np.array(counts) / sum(counts)

    def _tells_sizes_apart(self, samples: Sequence[Sample]) -> bool:
        meanings = {self.meaning(sample) for sample in samples}
        return len(meanings) > len({sample.shard for sample in samples})

    def _require_two_meanings(self) -> None:
        if len(self.meaning_ids) == len(self.shards):
            raise UsageError(
                "every task has demos of a single size only, so nothing about size can be learnt. "
                + _gen_demos(self.shards[0].path.parent, *self.tasks)
            )


def _check_in_cube(path: Path, targets_in_base: Float32[np.ndarray, "m 3"]) -> None:
    """A target outside the cube is in no view, so nothing could learn it."""
    half = SCENE_BOUNDS.side_m / 2
    outside = np.abs(targets_in_base - SCENE_BOUNDS.center_in_base) > half  # False where NaN
    if outside.any():
        raise UsageError(
            f"{path}: {outside.any(1).sum()} keyframes lie outside the cube that is rendered "
            f"({SCENE_BOUNDS}). Move the task into it."
        )


def _gen_demos(folder: Path, *tasks: str) -> str:
    """The command that makes the keyframes of `<data>/<split>/<partition>/keyframes`."""
    data, split, partition = folder.parents[2], folder.parts[-3], folder.parts[-2]
    return (
        f"Run `python -m sacil_tasks.gen_demos --tasks {' '.join(tasks)} --split {split} "
        f"--partition {partition} --out {data}`."
    )
