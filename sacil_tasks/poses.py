"""Poses by heading: of things that stand, and of the gripper in the expert's keyframes.

Keyframes are asked for in the world frame and given in the base frame.
"""

import numpy as np
import torch
from jaxtyping import Float, Float64
from scipy.spatial.transform import Rotation
from torch import Tensor

from sacil_tasks.interface import Keyframe

BASE_IN_WORLD_M = (-0.615, 0.0, 0.0)
"""Where the robot stands; base and world axes are parallel."""

_PALM_REACH_M = (0.102, 0.0315)
"""Half extents of the palm along and across the closing axis."""


def upright(yaw_rad: Float[Tensor, "*n"]) -> Float[Tensor, "*n 4"]:
    """Quaternions (wxyz) of things that stand on the table with these headings."""
    nothing = torch.zeros_like(yaw_rad)
    return torch.stack([(yaw_rad / 2).cos(), nothing, nothing, (yaw_rad / 2).sin()], dim=-1)


def grasp_height_m(height_m: float) -> float:
    """How far above its foot the gripper, from above, takes a thing of this height.

    At the middle; but the palm stays off its top, and the fingertips, which reach 9.5 mm below the
    tool centre, off what it stands on, with room for the 5 mm that the arm may overshoot.
    """
    return max(height_m / 2, height_m - 0.025, 0.0165)


def roomy_yaw(heading_rad: float, others_m: Float64[np.ndarray, "n 2"]) -> float:
    """Gripper yaw that closes on a four-sided thing with the palm far from the others.

    `others_m` are the others' centres as seen from this one, in the world frame. Of the two ways,
    the one in which the palm, which is wider than the fingers, comes less close to them.
    """

    def gap_m(yaw_rad: float) -> float:
        along = np.array([[-np.sin(yaw_rad), np.cos(yaw_rad)], [np.cos(yaw_rad), np.sin(yaw_rad)]])
        beyond = np.maximum(np.abs(others_m @ along.T) - _PALM_REACH_M, 0)
        return float(np.linalg.norm(beyond, axis=1).min())

    yaws = (heading_rad, heading_rad - np.copysign(np.pi / 2, heading_rad))
    return max(yaws, key=gap_m)


def downwards(
    xyz_in_world_m: Float64[np.ndarray, "3"],
    yaw_rad: float,
    *,
    gripper_open: bool,
    ignore_collisions: bool,
) -> Keyframe:
    """Keyframe with the gripper pointing down; at yaw 0 it closes along y."""
    return Keyframe(
        position_m=np.asarray(xyz_in_world_m, dtype=np.float64) - BASE_IN_WORLD_M,
        quaternion_wxyz=np.array([0.0, np.cos(yaw_rad / 2), np.sin(yaw_rad / 2), 0.0]),
        gripper_open=gripper_open,
        ignore_collisions=ignore_collisions,
    )


def sideways(
    xyz_in_world_m: Float64[np.ndarray, "3"],
    heading_rad: float,
    *,
    gripper_open: bool,
    ignore_collisions: bool,
) -> Keyframe:
    """Keyframe with the gripper pointing horizontally along `heading_rad`, closing vertically."""
    cosine, sine = np.cos(heading_rad), np.sin(heading_rad)
    axes = np.array([[-sine, 0.0, cosine], [cosine, 0.0, sine], [0.0, 1.0, 0.0]])
    return Keyframe(
        position_m=np.asarray(xyz_in_world_m, dtype=np.float64) - BASE_IN_WORLD_M,
        quaternion_wxyz=Rotation.from_matrix(axes).as_quat(scalar_first=True),
        gripper_open=gripper_open,
        ignore_collisions=ignore_collisions,
    )
