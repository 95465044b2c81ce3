"""Orientations as 3 x 72 classes: Euler angles x, y, z in steps of five degrees (RVT, PerAct).

The angles are extrinsic (SciPy's lower-case "xyz"): turn about the fixed x axis, then y, then z.
Bin b stands for 5 b - 180 degrees; bin 72 is bin 0. A gripper that points straight down has
x = +-180, which is bin 0 either way, and its yaw is the z angle. Quaternions are wxyz.
"""

import numpy as np
import torch
from jaxtyping import Float, Int

BINS = 72
BIN_DEG = 360 / BINS
GIMBAL_DEG = 1.0
"""This close to y = +-90 degrees x and z turn about the same axis: y is snapped and z is 0."""

SOFT_SIGMA_BINS = 1.5
"""Width of the soft labels."""

TIE = 1e-5
"""Below this a component of a unit vector is rounding of 32-bit quaternions."""


def quaternion_to_bins(quaternion_wxyz: Float[np.ndarray, "*b 4"]) -> Int[np.ndarray, "*b 3"]:
    """The class of each Euler angle; q and -q give the same."""
    steps = np.rint((np.degrees(_euler_xyz(quaternion_wxyz)) + 180) / BIN_DEG)
    return steps.astype(np.int64) % BINS


def bins_to_quaternion(bins: Int[torch.Tensor, "*b 3"]) -> Float[torch.Tensor, "*b 4"]:
    """Orientation at the centre of the bins, w >= 0."""
    half = torch.deg2rad(bins * BIN_DEG - 180.0) / 2
    (cx, cy, cz), (sx, sy, sz) = half.cos().unbind(-1), half.sin().unbind(-1)
    parts = (
        cz * cy * cx + sz * sy * sx,
        cz * cy * sx - sz * sy * cx,
        cz * sy * cx + sz * cy * sx,
        sz * cy * cx - cz * sy * sx,
    )
    quaternion = torch.stack(parts, dim=-1)
    return torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)


def soft_labels(
    bins: Int[torch.Tensor, "*b"], sigma_bins: float = SOFT_SIGMA_BINS
) -> Float[torch.Tensor, "*b 72"]:
    """Class probabilities that fall off as a Gaussian around the circle; they sum to 1."""
    distance = (torch.arange(BINS, device=bins.device) - bins[..., None]).abs()
    distance = torch.minimum(distance, BINS - distance)
    return torch.softmax(distance.float().square() / (-2 * sigma_bins**2), dim=-1)


def multiply(
    first: Float[np.ndarray, "*#b 4"], second: Float[np.ndarray, "*#b 4"]
) -> Float[np.ndarray, "*#b 4"]:
    """Hamilton product: the rotation `second`, then `first`, both about fixed axes."""
    (w, x, y, z), (a, b, c, d) = np.moveaxis(first, -1, 0), np.moveaxis(second, -1, 0)
    parts = [
        w * a - (x * b + y * c + z * d),
        w * b + a * x + (y * d - z * c),
        w * c + a * y + (z * b - x * d),
        w * d + a * z + (x * c - y * b),
    ]
    return np.stack(parts, axis=-1)


def canonical_yaw(quaternion_wxyz: Float[np.ndarray, "*b 4"]) -> Float[np.ndarray, "*b 4"]:
    """The orientation or its twin, half a turn about the tool z axis: one rule for both, w >= 0.

    Two parallel fingers cannot tell the twins apart, so labels use one of them (D-twins: RVT takes
    what the demonstration happened to use): the one whose tool x axis points towards base +x +z,
    or towards base +y where that is a tie. For a gripper that points down this is yaw in
    (-90, 90] degrees, and the choice does not flip while such a gripper is tilted forwards until
    it is level.
    """
    w, x, y, z = np.moveaxis(np.asarray(quaternion_wxyz), -1, 0)
    twin = np.stack([-z, y, -x, w], axis=-1)  # quaternion times (0, 0, 0, 1)
    tool_x = _matrix(quaternion_wxyz)[..., :, 0]
    forward, sideways = tool_x[..., 0] + tool_x[..., 2], tool_x[..., 1]
    keep = np.where(np.abs(forward) > TIE, forward > 0, sideways > 0)
    chosen = np.where(keep[..., None], quaternion_wxyz, twin)
    return np.where(chosen[..., :1] < 0, -chosen, chosen)


def _euler_xyz(quaternion_wxyz: Float[np.ndarray, "*b 4"]) -> Float[np.ndarray, "*b 3"]:
    """Extrinsic angles (rad) with the gimbal fix."""
    m = _matrix(quaternion_wxyz)
    sine = np.clip(-m[..., 2, 0], -1, 1)
    y = np.arcsin(sine)
    locked = np.abs(y) > np.radians(90 - GIMBAL_DEG)
    x_locked = np.arctan2(np.sign(sine) * m[..., 0, 1], m[..., 1, 1])
    x = np.where(locked, x_locked, np.arctan2(m[..., 2, 1], m[..., 2, 2]))
    z = np.where(locked, 0.0, np.arctan2(m[..., 1, 0], m[..., 0, 0]))
    return np.stack([x, np.where(locked, np.copysign(np.pi / 2, y), y), z], axis=-1)


def _matrix(quaternion_wxyz: Float[np.ndarray, "*b 4"]) -> Float[np.ndarray, "*b 3 3"]:
    q = np.asarray(quaternion_wxyz, np.float64)
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    entries = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in entries], axis=-2)
