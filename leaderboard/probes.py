"""Agents that test the harness: a ceiling, a zero and two floors.

Probes act on the stage instead of on observations and are marked privileged in every table. Like
a `Policy` they keep no episode state: it travels in the memory.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np

from leaderboard.agents import PROBES
from sacil_tasks.errors import UsageError, find_name
from sacil_tasks.interface import SCENE_BOUNDS, Keyframe, Memory
from sacil_tasks.sizes import CANDIDATES

if TYPE_CHECKING:
    from sacil_tasks.episode import Stage


class Probe(Protocol):
    """An agent that is handed the stage itself."""

    privileged: bool

    def begin_on(self, stage: "Stage", rng: np.random.Generator) -> Memory:
        """Start an episode on a stage whose scene is built; `rng` is the episode's own."""

    def act_on(self, stage: "Stage", memory: Memory) -> tuple[Keyframe, Memory] | None:
        """Choose the next keyframe; None gives the rest of the budget away."""


@dataclass(frozen=True)
class _Plan:
    """The expert's keyframes for some candidates, and how far it has come."""

    choice: tuple[int, ...]
    """Indices of the candidates to handle, in order."""

    done: int = 0


class Oracle:
    """The expert's plan for the named candidates: what the executor can reach."""

    privileged = True

    def begin_on(self, stage: "Stage", rng: np.random.Generator) -> _Plan:
        """The named candidates."""
        return _Plan(stage.env.target_order())

    def act_on(self, stage: "Stage", memory: _Plan) -> tuple[Keyframe, _Plan] | None:
        """The next keyframe of the plan."""
        if memory.done == stage.spec.keyframes:
            return None
        keyframe = stage.expert_keyframe(memory.done, memory.choice)
        return keyframe, replace(memory, done=memory.done + 1)


class Blind(Oracle):
    """The expert's hands, deaf to the words: candidates drawn at random, without replacement."""

    def begin_on(self, stage: "Stage", rng: np.random.Generator) -> _Plan:
        """As many candidates as the words name."""
        choice = rng.permutation(CANDIDATES)[: len(stage.env.target_order())]
        return _Plan(tuple(choice.tolist()))


class Hold:
    """Keeps the gripper where and as it is: must score exactly 0, or success is free."""

    privileged = True

    def begin_on(self, stage: "Stage", rng: np.random.Generator) -> Keyframe:
        """The pose at the start."""
        pose = stage.env.tcp_in_base()[0].double().numpy()
        return Keyframe(pose[:3], pose[3:], gripper_open=True, ignore_collisions=True)

    def act_on(self, stage: "Stage", memory: Keyframe) -> tuple[Keyframe, Keyframe]:
        """The same pose again."""
        return memory, memory


class Random:
    """Keyframes drawn uniformly in the scene bounds: position, rotation, gripper, collisions."""

    privileged = True

    def begin_on(self, stage: "Stage", rng: np.random.Generator) -> int:
        """A seed: memories are immutable, generators are not."""
        return int(rng.integers(2**63))

    def act_on(self, stage: "Stage", memory: int) -> tuple[Keyframe, int]:
        """A keyframe, and the seed of the next one."""
        rng = np.random.default_rng(memory)
        offset = rng.uniform(-0.5, 0.5, size=3) * SCENE_BOUNDS.side_m
        # A normalised Gaussian 4-vector is a uniformly distributed rotation.
        quaternion = rng.normal(size=4)
        keyframe = Keyframe(
            np.asarray(SCENE_BOUNDS.center_in_base) + offset,
            quaternion / np.linalg.norm(quaternion),
            gripper_open=bool(rng.integers(2)),
            ignore_collisions=bool(rng.integers(2)),
        )
        return keyframe, int(rng.integers(2**63))


_PROBES: dict[str, Callable[[], Probe]] = dict(
    zip(PROBES, (Oracle, Hold, Random, Blind), strict=True)
)


def load(*, checkpoint: Path | None, tasks: tuple[str, ...], variant: str | None) -> Probe:
    """Make the probe called `variant`.

    Raises:
        UsageError: a checkpoint was given.
    """
    if checkpoint is not None:
        raise UsageError(f"--agent {variant} has no weights; drop --checkpoint {checkpoint}.")
    return _PROBES[find_name(str(variant), PROBES, "probe")]()
