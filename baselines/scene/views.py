"""Orthographic virtual views of a point cloud (RVT section 3.1; paper section 3.2).

The cube [-1, 1]^3 is the scene. Each view looks along one axis from a face of the cube and shows
it edge to edge, so image coordinates and depth are cube coordinates up to scale and sign: no
camera model is needed. Every cloud point is a square of 2 x 2 pixels and the nearest point wins
(D-splat: RVT blends the five nearest discs). On equal depth the point with the lower index wins.

view    camera at   u (px)      v (px)      depth       with h = pixels / 2
top     +z          h (1 + x)   h (1 - y)   1 - z
front   +y          h (1 - x)   h (1 - z)   1 - y
back    -y          h (1 + x)   h (1 - z)   1 + y
left    +x          h (1 + y)   h (1 - z)   1 - x
right   -x          h (1 - y)   h (1 - z)   1 + x

Coordinates are continuous: pixel k covers [k, k + 1).
"""

from collections.abc import Sequence
from dataclasses import astuple, dataclass
from functools import cache

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64, UInt8

from baselines.scene.compiled import compiled
from sacil_tasks.interface import SCENE_BOUNDS, SceneBounds


@dataclass(frozen=True)
class View:
    """How one view lies in the cube; axes are counted x, y, z."""

    u_axis: int
    u_sign: int
    """Axis of the image's columns, and whether they run with it (1) or against it (-1)."""

    v_axis: int
    """Axis of the image's rows, which always run against it."""

    depth_axis: int
    side: int
    """Axis the view looks along, and the side it looks from."""


TOP, FRONT, BACK = View(0, 1, 1, 2, 1), View(0, -1, 2, 1, 1), View(0, 1, 2, 1, -1)
LEFT, RIGHT = View(1, 1, 2, 0, 1), View(1, -1, 2, 0, -1)

VIEWS = (TOP, FRONT, BACK, LEFT, RIGHT)
"""RVT's five views in its order; those of one axis stand together, so they share their work."""

THREE_VIEWS = (TOP, LEFT, FRONT)
"""RVT-2's: one along each axis (it calls them top, front and right)."""

CHANNELS = ("x", "y", "z", "red", "green", "blue", "depth")
"""Position in the cube frame, colour in [0, 1], depth less its mean over the view's points;
pixel locations are not drawn (D-channels)."""

EMPTY_DEPTH = -1.0
"""Depth where no point is seen; the other channels are 0 there."""

INDEX_BITS = 27
DEPTH_SCALE = 2.0 ** (24 + INDEX_BITS)
"""1 - c is a multiple of 2^-24 for every float32 c in [-1, 1], so depth times this leaves the low
bits free for the index of the point, and the sum of both is exact in a float64."""

NOTHING = np.inf

SHADES = (np.arange(256) / np.float32(255)).astype(np.float32)
"""Each colour value as a share of one."""


@cache
def cube_from_base(bounds: SceneBounds = SCENE_BOUNDS) -> Float32[np.ndarray, "3 4"]:
    """Affine map from the base frame (m) to cube coordinates."""
    scale = 2.0 / bounds.side_m
    shift = -scale * np.asarray(bounds.center_in_base)
    transform = np.column_stack([scale * np.eye(3), shift]).astype(np.float32)
    transform.flags.writeable = False  # every caller gets the same array
    return transform


def apply_affine(
    transform: Float[np.ndarray, "3 4"], points: Float[np.ndarray, "*b 3"]
) -> Float[np.ndarray, "*b 3"]:
    """Map points (not directions) through a 3 x 4 matrix."""
    return points @ transform[:, :3].T + transform[:, 3]


def base_from_cube(
    points_in_cube: Float[torch.Tensor, "*b 3"], bounds: SceneBounds = SCENE_BOUNDS
) -> Float[torch.Tensor, "*b 3"]:
    """Cube coordinates back to metres in the base frame."""
    center = points_in_cube.new_tensor(bounds.center_in_base)
    return points_in_cube * (bounds.side_m / 2) + center


def project(
    points_in_cube: Float[torch.Tensor, "*b 3"], pixels: int, views: Sequence[View] = VIEWS
) -> Float[torch.Tensor, "*b v 2"]:
    """Continuous pixel coordinates (u, v) of points in each view."""
    signs = points_in_cube.new_tensor([view.u_sign for view in views])
    u = 1 + signs * points_in_cube[..., [view.u_axis for view in views]]
    v = 1 - points_in_cube[..., [view.v_axis for view in views]]
    return torch.stack([u, v], dim=-1) * (pixels / 2)


def render_views(
    xyz: Float32[np.ndarray, "n 3"],
    rgb: UInt8[np.ndarray, "n 3"],
    transform: Float32[np.ndarray, "3 4"],
    pixels: int,
    out: Float32[np.ndarray, "v 7 h w"] | None = None,
    views: tuple[View, ...] = VIEWS,
) -> Float32[np.ndarray, "v 7 h w"]:
    """Draw the cloud into the views; single-threaded, deterministic, without the GIL.

    Args:
        xyz: points in any frame (m).
        rgb: their colours.
        transform: from that frame to the cube, augmentation included; points that land outside
            [-1, 1]^3 or are not finite are dropped, so none at all gives empty views.
        pixels: side of each view.
        out: memory to draw into (a slice of a batch saves allocating it anew).
        views: which views, in order.
    """
    shape = (len(views), len(CHANNELS), pixels, pixels)
    if out is None:
        out = np.empty(shape, np.float32)
    if out.shape != shape or xyz.shape != rgb.shape:
        shapes = f"{xyz.shape}, {rgb.shape} into {out.shape}"
        raise ValueError(f"expected points (n, 3), colours (n, 3) into {shape}, came {shapes}")
    transform = np.asarray(transform, np.float32)
    _render(np.asarray(xyz, np.float32), rgb, transform, _table(views), out)
    return out


@cache
def _table(views: tuple[View, ...]) -> Int64[np.ndarray, "v 5"]:
    """The views as the compiled code reads them: one row each, fields in order."""
    return np.array([astuple(view) for view in views], np.int64)


@compiled
def _render(
    xyz: np.ndarray, rgb: np.ndarray, transform: np.ndarray, table: np.ndarray, out: np.ndarray
) -> None:
    pixels = out.shape[2]
    points = np.empty((len(xyz), 4), np.float32)
    cells = np.empty((len(xyz), 4), np.int16)
    count = _place(xyz, rgb, transform, points)
    points, cells = points[:count], cells[:count]
    _first_cells(points.ravel(), np.float32(pixels / 2), cells.ravel())
    nearest = np.empty((pixels + 1, pixels + 1, 2), np.float64)
    for k in range(len(table)):
        u_axis, u_sign, v_axis, depth_axis, side = table[k]
        if k == 0 or depth_axis != table[k - 1, 3]:
            _splat(points, cells, u_axis, v_axis, depth_axis, nearest)
        seen = nearest[:, :, int(side < 0)]
        _paint(points, seen, depth_axis, side, u_sign, out[k])


@compiled
def _place(xyz: np.ndarray, rgb: np.ndarray, transform: np.ndarray, points: np.ndarray) -> int:
    """Keep the points inside the cube, their colours packed behind them; returns how many."""
    one, bits = np.float32(1), points.view(np.int32)
    count = 0
    for i in range(len(xyz)):
        px, py, pz = xyz[i, 0], xyz[i, 1], xyz[i, 2]
        x = transform[0, 0] * px + transform[0, 1] * py + transform[0, 2] * pz + transform[0, 3]
        y = transform[1, 0] * px + transform[1, 1] * py + transform[1, 2] * pz + transform[1, 3]
        z = transform[2, 0] * px + transform[2, 1] * py + transform[2, 2] * pz + transform[2, 3]
        if abs(x) <= one and abs(y) <= one and abs(z) <= one:
            points[count, 0], points[count, 1], points[count, 2] = x, y, z
            bits[count, 3] = rgb[i, 0] | np.int32(rgb[i, 1]) << 8 | np.int32(rgb[i, 2]) << 16
            count += 1
    return count


@compiled
def _first_cells(coordinates: np.ndarray, half: np.float32, cells: np.ndarray) -> None:
    """The first of the two cells that a point covers along each axis.

    Cells are counted from 0 for the margin outside the cube, so both cells of a point exist.
    """
    for i in range(len(coordinates)):
        cells[i] = np.int16(half * (np.float32(1) + coordinates[i]) + np.float32(0.5))


@compiled
def _splat(
    points: np.ndarray,
    cells: np.ndarray,
    column_axis: int,
    row_axis: int,
    depth_axis: int,
    nearest: np.ndarray,
) -> None:
    """Find the nearest point of each cell seen from the + side (0) and the - side (1).

    An entry is depth followed by the point's index, so that the smaller entry is the nearer point
    and, on equal depth, the earlier one. Taking the minimum needs no branch to be guessed, and
    64-bit floats have one instruction for it.

    A point covers its first cell and the next one along both axes, but is entered in the first
    only: `_paint` looks at the four from which a cell is reached.
    """
    nearest[:] = NOTHING
    one = np.float32(1)
    for i in range(len(points)):
        along = points[i, depth_axis]
        plus = np.float64(one - along) * DEPTH_SCALE + i
        minus = np.float64(one + along) * DEPTH_SCALE + i
        row, column = cells[i, row_axis], cells[i, column_axis]
        nearest[row, column, 0] = min(nearest[row, column, 0], plus)
        nearest[row, column, 1] = min(nearest[row, column, 1], minus)


@compiled
def _paint(
    points: np.ndarray,
    nearest: np.ndarray,
    depth_axis: int,
    side: int,
    u_sign: int,
    view: np.ndarray,
) -> None:
    """Gather the features of the nearest points into one view (7, h, w)."""
    view[:6] = 0
    view[6] = EMPTY_DEPTH
    pixels = view.shape[1]
    total, covered, colours = 0.0, 0, points.view(np.int32)
    for v in range(pixels):
        above, below = nearest[pixels - v - 1], nearest[pixels - v]
        for u in range(pixels):
            left = u if u_sign > 0 else pixels - 1 - u
            entry = min(min(above[left], above[left + 1]), min(below[left], below[left + 1]))
            if entry == NOTHING:
                continue
            i = np.int64(entry) & ((1 << INDEX_BITS) - 1)
            for c in range(3):
                view[c, v, u] = points[i, c]
                view[3 + c, v, u] = SHADES[colours[i, 3] >> 8 * c & 255]
            view[6, v, u] = np.float32(1) - np.float32(side) * points[i, depth_axis]
            total += view[6, v, u]
            covered += 1
    mean = np.float32(total / max(covered, 1))
    for row in view[6]:
        for u in range(pixels):
            row[u] -= mean if row[u] != EMPTY_DEPTH else np.float32(0)
