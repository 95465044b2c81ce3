"""The contract between tasks, policies and the harness: observation in, keyframe out.

Everything is expressed in the robot base frame, in metres, with quaternions in the order wxyz.
This module imports neither torch nor ManiSkill, so a policy from another project needs nothing
of ours but this file's shapes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

import numpy as np
from jaxtyping import Float32, Float64, UInt8, UInt16

CAMERAS = ("front", "left_shoulder", "right_shoulder", "wrist")
"""The four RGB-D cameras, always in this order (paper section 4.1)."""

IMAGE_PIXELS = 128
"""Pixels per side of every camera image (paper section 4.1)."""

MAX_KEYFRAMES = 25
"""Keyframes a policy may spend on one episode, as in RVT."""


@dataclass(frozen=True)
class SceneBounds:
    """The cube every view-based agent renders; it holds each expert keyframe of all nine tasks."""

    center_in_base: tuple[float, float, float]
    side_m: float


# D-cube: smaller than RVT's workspace.
SCENE_BOUNDS = SceneBounds(center_in_base=(0.535, 0.0, 0.33), side_m=0.72)


@dataclass(frozen=True)
class Observation:
    """What a policy sees before it chooses a keyframe."""

    rgb: UInt8[np.ndarray, "4 h w 3"]
    """Colour images in the order of `CAMERAS`."""

    depth_mm: UInt16[np.ndarray, "4 h w"]
    """Depth along the optical axis in millimetres; 0 where nothing was seen."""

    intrinsics: Float32[np.ndarray, "4 3 3"]
    """Pinhole matrices in pixels; pixel centres lie at integer + 0.5."""

    camera_in_base: Float32[np.ndarray, "4 4 4"]
    """Camera poses: x right, y down, z forward (the OpenCV frame) to base."""

    tcp_in_base: Float32[np.ndarray, "7"]
    """Gripper pose: position (m), then quaternion wxyz; link `panda_hand_tcp`."""

    gripper_open: bool
    """Commanded state, binary: the finger width after a grasp would tell the size."""

    step: int
    """Keyframes executed so far in this episode."""

    max_steps: int
    """Keyframe budget of the episode."""


@dataclass(frozen=True)
class Keyframe:
    """Where the gripper should be next: the arm moves there, then the gripper acts."""

    position_m: Float64[np.ndarray, "3"]
    """Tool centre point in the base frame."""

    quaternion_wxyz: Float64[np.ndarray, "4"]
    """Orientation of `panda_hand_tcp` in the base frame, unit length."""

    gripper_open: bool
    """State of the gripper after the move."""

    ignore_collisions: bool
    """Plan the move without collision checks (for intended contact)."""


Memory: TypeAlias = Any
"""What a policy carries between keyframes of one episode; immutable, owned by the harness."""


class Policy(Protocol):
    """An agent under evaluation. It holds no episode state of its own."""

    def begin(self, instruction: str) -> Memory:
        """Start an episode with these words."""

    def act(
        self, observations: Sequence[Observation], memories: Sequence[Memory]
    ) -> tuple[list[Keyframe], list[Memory]]:
        """Choose the next keyframe of each running episode."""
