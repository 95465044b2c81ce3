"""A grip as numbers that can be regressed, for agents that do not classify rotations (D-grip).

Two parallel fingers grip alike from an orientation and from its twin, half a turn about the tool z
axis. As quaternions a grip therefore has four names, and no continuous function of the scene picks
one of them. Its approach (tool z) and its closing line (the outer product of tool x with itself)
have one value each and change smoothly.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn import functional

from baselines.batch import Labels, Prediction
from baselines.rotation import canonical_yaw
from baselines.scene.augment import AugmentConfig

GRIP = 9
"""Numbers of a grip: the tool z axis, then xx, yy, zz, and sqrt(2) times xy, yz, xz of the outer
product, so that their distance is that of the matrices."""

POSE = GRIP + 2
"""Numbers of a pose: a grip, and the logits of gripper open and ignore collisions."""

UNTURNED = AugmentConfig(yaw_rad=0.0)
"""How scenes are moved for agents that regress a pose: not turned, as in their own papers
(D-unturned)."""

_ROWS, _COLUMNS = (0, 1, 2, 0, 1, 0), (0, 1, 2, 1, 2, 2)
_SCALES = (1.0, 1.0, 1.0, 2**0.5, 2**0.5, 2**0.5)


@dataclass(frozen=True)
class Regressed:
    """A keyframe as a network regresses it."""

    position_in_cube: Float[Tensor, "b 3"]
    pose: Float[Tensor, "b 11"]

    def terms(self, labels: Labels) -> dict[str, Tensor]:
        """Losses of the pose, means over samples: squared error of the grip, cross-entropies."""
        flags = {"bc/gripper": labels.gripper_open, "bc/collision": labels.ignore_collisions}
        error = grip_error(self.pose[:, :GRIP], labels.quaternion_wxyz)
        return {"bc/rotation": error.mean()} | {
            name: functional.binary_cross_entropy_with_logits(logit, flag.float())
            for (name, flag), logit in zip(flags.items(), self.pose[:, GRIP:].T, strict=True)
        }

    @property
    def prediction(self) -> Prediction:
        """The keyframe."""
        return Prediction(
            position_in_cube=self.position_in_cube,
            quaternion_wxyz=grip_quaternion(self.pose[:, :GRIP]),
            gripper_open=self.pose[:, GRIP] > 0,
            ignore_collisions=self.pose[:, GRIP + 1] > 0,
        )


def tool_axes(quaternion_wxyz: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b 6"]:
    """Where the tool's z and x axes point."""
    w, x, y, z = quaternion_wxyz.unbind(-1)
    axes = (
        *(2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
        *(1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
    )
    return torch.stack(axes, dim=-1)


def grip_numbers(quaternion_wxyz: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b 9"]:
    """The grip of unit quaternions; equal for q, -q and their twins."""
    *tool_z, x, y, z = tool_axes(quaternion_wxyz).unbind(-1)
    tool_x = (x, y, z)
    outer = (
        scale * tool_x[row] * tool_x[column]
        for row, column, scale in zip(_ROWS, _COLUMNS, _SCALES, strict=True)
    )
    return torch.stack([*tool_z, *outer], dim=-1)


def grip_error(
    numbers: Float[Tensor, "*b 9"], quaternion_wxyz: Float[Tensor, "*b 4"]
) -> Float[Tensor, "*b"]:
    """Squared distance of regressed numbers to the grip of a label."""
    return (numbers - grip_numbers(quaternion_wxyz)).square().sum(-1)


def grip_quaternion(numbers: Float[Tensor, "b 9"]) -> Float[Tensor, "b 4"]:
    """The orientation nearest to regressed numbers: wxyz, the canonical one of the twins.

    The approach is taken as it points; the closing line is the main axis of the outer product in
    the plane across the approach.
    """
    n = numbers.detach().double().cpu().numpy()
    tool_z = n[:, :3] / np.linalg.norm(n[:, :3], axis=1, keepdims=True)
    outer = np.empty((len(n), 3, 3))
    outer[:, _ROWS, _COLUMNS] = outer[:, _COLUMNS, _ROWS] = n[:, 3:] / _SCALES
    along = tool_z[:, :, None] * tool_z[:, None]
    across = np.eye(3) - along
    # In its own direction the approach must lose against any axis across it.
    flat = across @ outer @ across - (1 + np.abs(outer).sum((1, 2)))[:, None, None] * along
    tool_x = np.linalg.eigh(flat).eigenvectors[:, :, -1]
    axes = np.stack([tool_x, np.cross(tool_z, tool_x), tool_z], axis=-1)
    turn = canonical_yaw(Rotation.from_matrix(axes).as_quat(scalar_first=True))
    return torch.from_numpy(turn).to(numbers)
