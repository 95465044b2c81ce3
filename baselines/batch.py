"""What a network reads and what it is taught, as tensors of one batch.

Positions are in cube coordinates ([-1, 1] on each axis spans `interface.SCENE_BOUNDS`).
"""

from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, Generic, TypeVar

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor
from torch.nn import functional

Scene = TypeVar("Scene")
"""What the network's `Sight` makes of an observation: a dataclass of tensors."""

P = TypeVar("P")


@dataclass(frozen=True)
class Inputs(Generic[Scene]):
    """What an agent may see before it chooses a keyframe."""

    scene: Scene

    gripper_in_cube: Float[Tensor, "b 7"]
    """Gripper pose: position in the cube, quaternion wxyz."""

    step: Int64[Tensor, "b"]
    """Keyframes executed before."""

    proprio: Float[Tensor, "b 2"]
    """Gripper open (0 or 1) and time, from 1 at the first keyframe down to -1."""

    text: Float[Tensor, "b t e"]
    """Token vectors of the frozen text encoder; zeros where `text_mask` is False."""

    text_mask: Bool[Tensor, "b t"]
    """True at real tokens; the last of them is the end-of-text token."""

    def proprio_of(self, width: int) -> Float[Tensor, "b {width}"]:
        """`proprio`, with zeros behind it for a network that reads more numbers."""
        return functional.pad(self.proprio, (0, width - self.proprio.shape[1]))


@dataclass(frozen=True)
class Labels:
    """The expert's keyframe, in the frame of the augmented cube."""

    position_in_cube: Float[Tensor, "b 3"]
    quaternion_wxyz: Float[Tensor, "b 4"]
    """Of the twins half a turn apart, the one that `rotation.canonical_yaw` chooses."""

    rotation_bins: Int64[Tensor, "b 3"]
    gripper_open: Int64[Tensor, "b"]
    ignore_collisions: Int64[Tensor, "b"]


@dataclass(frozen=True)
class Batch(Generic[Scene]):
    """One training step."""

    inputs: Inputs[Scene]
    labels: Labels

    task: Int64[Tensor, "b"]
    """Index of the task in the training set."""

    meaning: Int64[Tensor, "b"]
    """Equal for equal task and slots, whatever the sentence."""

    trajectory: Int64[Tensor, "b"]
    """Equal for samples of one demonstration."""

    first: Bool[Tensor, "b"]
    """True at the first keyframe of a demonstration (the arm is still at home)."""

    goal: Any = None
    """The observation at the keyframe to be reached, with its own augmentation, as the network's
    `goal_sight` shows it; None unless it asks for goals."""


@dataclass(frozen=True)
class Prediction:
    """What an agent chose for each observation."""

    position_in_cube: Float[Tensor, "b 3"]
    quaternion_wxyz: Float[Tensor, "b 4"]
    gripper_open: Bool[Tensor, "b"]
    ignore_collisions: Bool[Tensor, "b"]


def moved(part: P, device: torch.device) -> P:
    """A dataclass of tensors, nested ones too, on `device`; what is no tensor stays."""
    found: Any = part
    if isinstance(part, Tensor):
        found = part.to(device)
    elif is_dataclass(part) and not isinstance(part, type):
        there = {field.name: moved(getattr(part, field.name), device) for field in fields(part)}
        found = replace(part, **there)
    return found


def proprio(*, gripper_open: bool, step: int, max_steps: int) -> tuple[float, float]:
    """One row of `Inputs.proprio`; time runs from 1 down to -1 over the keyframe budget."""
    return float(gripper_open), 1 - 2 * step / (max_steps - 1)
