"""Camera images cropped at random, the place of every pixel kept (D-hiveformer-augment)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int64, UInt8, UInt16

from baselines.scene.compiled import compiled
from sacil_tasks.interface import Observation


@dataclass(frozen=True)
class Shown:
    """What a crop shows of an observation's images, as many pixels as before."""

    rgb: UInt8[np.ndarray, "k h w 3"]
    """Colours; beyond the old edges those of the edge."""

    depth_mm: UInt16[np.ndarray, "k h w"]
    """Depth; beyond the old edges 0, which is nothing."""

    sources: Int64[np.ndarray, "2 side"]
    """The camera's columns and rows that are shown; may lie beyond the edges."""


@dataclass(frozen=True)
class Crop:
    """One frame for the images of all cameras and steps of an episode."""

    corner_px: Int64[np.ndarray, "2"]
    """Column and row that become the first ones; may lie beyond the edges."""

    def show(self, seen: Observation) -> Shown:
        """What lies within the frame."""
        sources = np.arange(seen.depth_mm.shape[-1]) + self.corner_px[:, None]
        if not self.corner_px.any():
            return Shown(seen.rgb, seen.depth_mm, sources)
        rgb, depth_mm = np.empty_like(seen.rgb), np.empty_like(seen.depth_mm)
        _pick(seen.rgb, seen.depth_mm, sources, rgb, depth_mm)
        return Shown(rgb, depth_mm, sources)


WHOLE = Crop(np.zeros(2, np.int64))


def draw(seed: int, reach_px: int) -> Crop:
    """Any corner up to `reach_px` columns and rows from the old one."""
    return Crop(np.random.default_rng(seed).integers(-reach_px, reach_px + 1, 2))


@compiled
def _pick(
    rgb: np.ndarray,
    depth_mm: np.ndarray,
    sources: np.ndarray,
    picked_rgb: np.ndarray,
    picked_mm: np.ndarray,
) -> None:
    """Write colours and depths of the columns and rows in `sources` into the last two arrays."""
    last = depth_mm.shape[1] - 1
    for k in range(len(rgb)):
        for i in range(last + 1):
            row = min(max(sources[1, i], 0), last)
            for j in range(last + 1):
                column = min(max(sources[0, j], 0), last)
                inside = row == sources[1, i] and column == sources[0, j]
                picked_mm[k, i, j] = depth_mm[k, row, column] if inside else 0
                picked_rgb[k, i, j, 0] = rgb[k, row, column, 0]
                picked_rgb[k, i, j, 1] = rgb[k, row, column, 1]
                picked_rgb[k, i, j, 2] = rgb[k, row, column, 2]
