"""How far a keyframe is from the expert's: millimetres and degrees. Pure."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from jaxtyping import Float64

from sacil_tasks.interface import Keyframe

ALIGNED_MM, ALIGNED_DEG = 20.0, 15.0
"""Within both, a keyframe counts as the expert's: about what a grasp of the smallest objects
forgives."""


@dataclass(frozen=True)
class Deviation:
    """One keyframe against the expert's of the same number."""

    position_mm: float
    rotation_deg: float
    """The smaller angle of the two ways that parallel fingers cannot tell apart."""

    same_gripper: bool
    """Both open the gripper, or both close it."""

    @classmethod
    def of(cls, keyframe: Keyframe, expert: Keyframe) -> Self:
        """Compare a keyframe with the expert's."""
        gap_m = np.linalg.norm(np.asarray(keyframe.position_m) - expert.position_m)
        ours, theirs = (np.asarray(it.quaternion_wxyz, np.float64) for it in (keyframe, expert))
        angles = (_angle_rad(ours, theirs), _angle_rad(ours, _half_turned(theirs)))
        same = keyframe.gripper_open == expert.gripper_open
        return cls(1000 * float(gap_m), float(np.rad2deg(min(angles))), same)

    @property
    def aligned(self) -> bool:
        """Near enough to lead to the same thing."""
        near = self.position_mm <= ALIGNED_MM and self.rotation_deg <= ALIGNED_DEG
        return near and self.same_gripper

    def __str__(self) -> str:
        """As tables and pictures show it."""
        gripper = "" if self.same_gripper else ", gripper differs"
        return f"{self.position_mm:.0f} mm, {self.rotation_deg:.0f} deg{gripper}"


def _angle_rad(a: Float64[np.ndarray, "4"], b: Float64[np.ndarray, "4"]) -> float:
    """Angle between two orientations; both signs of a quaternion are the same one."""
    cosine = abs(a @ b) / (np.linalg.norm(a) * np.linalg.norm(b))
    return float(2 * np.arccos(np.clip(cosine, 0.0, 1.0)))


def _half_turned(wxyz: Float64[np.ndarray, "4"]) -> Float64[np.ndarray, "4"]:
    """Turned by 180 degrees about the gripper's own axis (z): wxyz times (0, 0, 0, 1)."""
    w, x, y, z = wxyz
    return np.array([-z, y, -x, w])
