"""Random rigid moves of a whole scene: the cloud and the label together (RVT section 3.3).

The scene turns about the vertical through the label and is then shifted, in the `cpu` presets
neither up nor down (D-heights). After a turn a gripper label may leave the canonical half of its
symmetry: pass it through `rotation.canonical_yaw`.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Float32, Float64

from baselines.configs import check_numbers
from baselines.rotation import multiply
from baselines.scene.views import apply_affine, cube_from_base
from sacil_tasks.interface import SCENE_BOUNDS, SceneBounds


@dataclass(frozen=True, kw_only=True)
class AugmentConfig:
    """How far a scene may be moved (paper section 4.1)."""

    yaw_rad: float = np.pi / 4
    """Largest turn about the vertical, to either side."""

    translation_m: float | tuple[float, float, float] = (0.125, 0.125, 0.0)
    """Largest shift to either side, along each axis or along all of them. The table is equally high
    in all scenes, so that the height of an object's top tells its size, unless shifts up and down
    hide it (D-heights; the paper shifts along all axes)."""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            UsageError: one of them is negative or not finite.
        """
        check_numbers(self)


@dataclass(frozen=True)
class Augmentation:
    """A rigid move within the base frame: a turn about the vertical, then a shift."""

    yaw_rad: float
    shift_m: Float64[np.ndarray, "3"]
    """Where the base origin ends up."""

    @cached_property
    def matrix(self) -> Float64[np.ndarray, "3 4"]:
        """Affine map base to base."""
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        turn = [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]
        matrix = np.column_stack([turn, self.shift_m])
        matrix.flags.writeable = False  # every caller gets the same array
        return matrix

    def move_points(self, points_in_base: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3"]:
        """Move positions (m)."""
        return apply_affine(self.matrix, points_in_base)

    def move_pose(self, pose_in_base: Float[np.ndarray, "*b 7"]) -> Float[np.ndarray, "*b 7"]:
        """Move poses: position (m), then quaternion wxyz."""
        half = self.yaw_rad / 2
        turn = np.array([np.cos(half), 0.0, 0.0, np.sin(half)])
        position = self.move_points(pose_in_base[..., :3])
        return np.concatenate([position, multiply(turn, pose_in_base[..., 3:])], axis=-1)

    def to_cube(self, bounds: SceneBounds = SCENE_BOUNDS) -> Float32[np.ndarray, "3 4"]:
        """This move, then base to cube, as one map for `render_views`."""
        whole = np.vstack([self.matrix, [0.0, 0.0, 0.0, 1.0]])
        return (cube_from_base(bounds).astype(np.float64) @ whole).astype(np.float32)


def draw(
    rng: np.random.Generator,
    target_in_base: Float[np.ndarray, "3"],
    config: AugmentConfig,
    bounds: SceneBounds = SCENE_BOUNDS,
) -> Augmentation:
    """Draw a move that leaves the target position inside the cube.

    The turn is uniform and pivots on the target; each shift is uniform over the part of its range
    that keeps the target inside (D-shift: RVT clamps, which piles labels up on the faces).
    """
    target = np.asarray(target_in_base, np.float64)
    center, reach = np.asarray(bounds.center_in_base), np.broadcast_to(config.translation_m, 3)
    to_low = center - bounds.side_m / 2 - target
    to_high = center + bounds.side_m / 2 - target
    yaw_rad = rng.uniform(-config.yaw_rad, config.yaw_rad)
    shift_m = rng.uniform(np.clip(-reach, to_low, to_high), np.clip(reach, to_low, to_high))
    turned = Augmentation(yaw_rad, np.zeros(3)).move_points(target)
    return Augmentation(yaw_rad, target - turned + shift_m)
