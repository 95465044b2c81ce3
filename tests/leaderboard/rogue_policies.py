"""Foreign policies: the words decide how they misbehave."""

import os
import signal
from dataclasses import dataclass, replace

import numpy as np

from sacil_tasks.interface import Keyframe, Observation


def stay(observation: Observation) -> Keyframe:
    pose = observation.tcp_in_base.astype(float)
    return Keyframe(pose[:3], pose[3:], gripper_open=True, ignore_collisions=True)


@dataclass(frozen=True)
class Rogue:
    """Raises when asked for small, returns NaN for medium and kills its process for large."""

    def begin(self, instruction: str) -> str:
        return instruction

    def act(self, observations, memories):
        (observation,), (words,) = observations, memories
        if "small" in words:
            raise ValueError("I do not\nlike small ones")
        if "large" in words:
            os.kill(os.getpid(), signal.SIGSEGV)
        return [replace(stay(observation), position_m=np.full(3, np.nan))], memories


@dataclass(frozen=True)
class Wanderer:
    """Leaves the workspace when asked for small, and answers nonsense otherwise."""

    def begin(self, instruction: str) -> str:
        return instruction

    def act(self, observations, memories):
        (observation,), (words,) = observations, memories
        if "small" in words:
            return [replace(stay(observation), position_m=np.array([5.0, 0.0, 0.3]))], memories
        if "medium" in words:
            return [None], memories
        return [stay(observation)] * 2, memories


def load_rogue(*, checkpoint, tasks, variant):
    return Rogue()


def load_wanderer(*, checkpoint, tasks, variant):
    return Wanderer()
