"""A merged cloud of points around the gripper, and who is whose neighbour (PolarNet section 3).

    images -> pixels in the cube and above the table -> one mean point a voxel -> some at random
           -> farthest first: each stage of a point network keeps a prefix of this order
           -> neighbours of every stage, so that the network only gathers and multiplies

All of it happens before the augmentation, which moves the result rigidly: neighbours do not
depend on where the scene is put (D-polarnet-crop).
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int32, UInt8
from torch import Tensor

from baselines.scene.cloud import point_maps
from baselines.scene.compiled import compiled
from baselines.scene.neighbours import Pyramid, farthest_first, near_points, nearest_three
from baselines.scene.sight import STILL, Moment, gripper_in_cube
from baselines.scene.views import cube_from_base
from sacil_tasks.interface import SCENE_BOUNDS, Observation

TABLE_M = 0.003
"""Points up to this height are the table: depth is rounded to a millimetre, and 99.9 % of the
table's points lie within one."""

SMOOTH_M = 0.02
"""Pixels farther apart than this are not of one surface, as far as normals are concerned."""

FRACTION = 2**20
"""Sums over a voxel count in these parts of one, which makes them exact in any order."""

DIGIT_BITS = 12
DIGIT = 2**DIGIT_BITS - 1
"""Cells are sorted by digits of so many bits."""

COLUMNS = 9
"""Of a row of a cloud: position in the cube, colour (0 to 255), normal."""

HALF_SIDE_M = SCENE_BOUNDS.side_m / 2


@dataclass(frozen=True)
class PointCloud:
    """Points in an order whose prefixes are the stages; rows of small clouds come repeatedly."""

    xyz: Float[Tensor, "b n 3"]
    """From the gripper, in units of `reach`."""

    features: Float[Tensor, "b n 7"]
    """Colour in [-1, 1], normal, height above the table (m)."""

    reach: Float[Tensor, "b"]
    """Distance from the gripper to the farthest point, in the cube's units."""

    near: Int32[Tensor, "b r k"]
    """Neighbourhood of each centre of each stage: indices into the stage before; `r` counts the
    centres of all stages, one stage after the other."""

    parents: Int32[Tensor, "b u 3"]
    """The three nearest points of the next stage, for each point that is not in it; `u` counts
    from the last stage's size up to all points, which is stage by stage too."""

    shares: Float[Tensor, "b u 3"]
    """What each of them contributes; sums to 1."""


class CloudSight:
    """Merges, crops, thins and orders what the cameras saw."""

    remembers = False

    def __init__(self, pyramid: Pyramid) -> None:
        """Thin out as `pyramid` says."""
        self.pyramid = pyramid

    def look(self, moments: Sequence[Moment]) -> PointCloud:
        """One cloud a moment; choices among its points follow the moment's seed."""
        clouds = [self._cloud(moment) for moment in moments]
        return PointCloud(
            **{
                field.name: torch.from_numpy(np.stack([cloud[field.name] for cloud in clouds]))
                for field in fields(PointCloud)
            }
        )

    def _cloud(self, moment: Moment) -> dict[str, np.ndarray]:
        """The fields of `PointCloud` for one moment."""
        gripper = gripper_in_cube(moment.seen, STILL)[:3]
        voxels = average(visible(moment.seen), self.pyramid.voxel_m / HALF_SIDE_M)
        if not len(voxels):  # nothing to be seen: a black point where the gripper is
            voxels = np.zeros((1, COLUMNS), np.float32)
            voxels[0, :3] = gripper
        reach = np.float32(_reach(voxels, gripper) or 1)
        chosen = np.random.default_rng(moment.seed).permutation(len(voxels))[: self.pyramid.points]
        xyz = (voxels[chosen, :3] - gripper) / reach
        order = farthest_first(xyz, min(self.pyramid.stages[0], len(xyz)))
        return self._placed(moment, voxels[chosen[order]], xyz[order], reach)

    def _placed(
        self,
        moment: Moment,
        voxels: Float32[np.ndarray, "n 9"],
        xyz: Float32[np.ndarray, "n 3"],
        reach: np.float32,
    ) -> dict[str, np.ndarray]:
        """Neighbours, then the turn of the scene, then repetition up to the number of points."""
        pyramid, turn = self.pyramid, moment.move.matrix[:, :3].T.astype(np.float32)
        parents, shares = nearest_three(xyz, pyramid)
        height_m = voxels[:, 2:3] * HALF_SIDE_M + SCENE_BOUNDS.center_in_base[2]
        features = np.hstack([voxels[:, 3:6] / 127.5 - 1, voxels[:, 6:] @ turn, height_m])
        rows = np.arange(pyramid.points) % len(xyz)
        return {
            "xyz": (xyz @ turn)[rows],
            "features": features.astype(np.float32)[rows],
            "reach": np.asarray(reach),
            "near": near_points(xyz, pyramid),
            "parents": parents,
            "shares": shares,
        }


def visible(seen: Observation) -> Float32[np.ndarray, "n 9"]:
    """Every pixel inside the cube and above the table, as rows of position, colour and normal."""
    maps, inside = point_maps(seen.depth_mm, seen.intrinsics, seen.camera_in_base, cube_from_base())
    floor = (TABLE_M - SCENE_BOUNDS.center_in_base[2]) / HALF_SIDE_M
    rows = np.empty((inside.sum(), COLUMNS), np.float32)
    return rows[: _collect(maps, inside, seen.rgb, np.float32(floor), rows)]


def average(rows: Float32[np.ndarray, "n 9"], cell: float) -> Float32[np.ndarray, "m 9"]:
    """The mean of the rows in each cubic cell of this edge, sorted by cell.

    The answer does not depend on the order of the rows, to the last bit.
    """
    return _means(rows, *_by_cell(_cells(rows, np.float32(cell))))


@compiled
def _reach(rows: np.ndarray, center: np.ndarray) -> np.float32:
    """Distance of the farthest row from a point."""
    squared = np.float32(0)
    for i in range(len(rows)):
        x, y, z = rows[i, 0] - center[0], rows[i, 1] - center[1], rows[i, 2] - center[2]
        squared = max(squared, x * x + y * y + z * z)
    return np.sqrt(squared)


@compiled
def _collect(
    maps: Float32[np.ndarray, "k 3 h w"],
    inside: Bool[np.ndarray, "k h w"],
    rgb: UInt8[np.ndarray, "k h w 3"],
    floor: np.float32,
    rows: Float32[np.ndarray, "n 9"],
) -> int:
    """Write the rows and return how many there are."""
    _, height, width = inside.shape
    beside = np.zeros((height, width + 1), np.bool_)
    below = np.zeros((height + 1, width), np.bool_)
    count = 0
    for k in range(len(maps)):
        image, shown = maps[k], inside[k]
        for i in range(height):
            start, end = image[:, i, :-1], image[:, i, 1:]
            _continues(start, end, shown[i, :-1], shown[i, 1:], beside[i, 1:-1])
        for i in range(height - 1):
            _continues(image[:, i], image[:, i + 1], shown[i], shown[i + 1], below[i + 1])
        for i in range(height):
            for j in range(width):
                if not shown[i, j] or image[2, i, j] <= floor:
                    continue
                for c in range(3):
                    rows[count, c] = image[c, i, j]
                    rows[count, 3 + c] = rgb[k, i, j, c]
                left, right = j - beside[i, j], j + beside[i, j + 1]
                above, under = i - below[i, j], i + below[i + 1, j]
                _normal(image, i, j, left, right, above, under, rows[count, 6:])
                count += 1
    return count


@compiled
def _continues(
    start: np.ndarray,
    end: np.ndarray,
    start_seen: np.ndarray,
    end_seen: np.ndarray,
    smooth: np.ndarray,
) -> None:
    """Whether each pixel of a row and its neighbour in the next one are of one surface."""
    limit = np.float32((SMOOTH_M / HALF_SIDE_M) ** 2)
    for j in range(len(smooth)):
        x, y, z = start[0, j] - end[0, j], start[1, j] - end[1, j], start[2, j] - end[2, j]
        smooth[j] = start_seen[j] & end_seen[j] & (x * x + y * y + z * z < limit)


@compiled
def _normal(
    maps: np.ndarray,
    i: int,
    j: int,
    left: int,
    right: int,
    above: int,
    below: int,
    out: np.ndarray,
) -> None:
    """Unit normal towards the camera from the pixel's neighbours; 0 where there is none
    (D-polarnet-normals)."""
    ux = maps[0, i, right] - maps[0, i, left]
    uy = maps[1, i, right] - maps[1, i, left]
    uz = maps[2, i, right] - maps[2, i, left]
    vx = maps[0, below, j] - maps[0, above, j]
    vy = maps[1, below, j] - maps[1, above, j]
    vz = maps[2, below, j] - maps[2, above, j]
    nx, ny, nz = vy * uz - vz * uy, vz * ux - vx * uz, vx * uy - vy * ux
    length = np.sqrt(nx * nx + ny * ny + nz * nz)
    scale = length if length > 0 else np.float32(1)
    out[0], out[1], out[2] = nx / scale, ny / scale, nz / scale


@compiled
def _cells(rows: np.ndarray, cell: np.float32) -> np.ndarray:
    """The cell of each row as one number."""
    side = np.int64(2 / cell) + 2
    cells = np.empty(len(rows), np.int64)
    for i in range(len(rows)):
        key = np.int64(0)
        for axis in range(3):
            key = key * side + np.int64((rows[i, axis] + np.float32(1)) / cell)
        cells[i] = key
    return cells


@compiled
def _by_cell(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The rows' numbers in the order of their cells, and those cells: one pass of counting for
    each digit, the lowest first, is several times as fast as NumPy's sort."""
    order, ordered = np.arange(len(cells), dtype=np.int32), cells.copy()
    other, others = np.empty_like(order), np.empty_like(ordered)
    shift, last = 0, cells.max() if len(cells) else 0
    while last >> shift:
        starts = np.zeros(DIGIT + 2, np.int32)
        for cell in ordered:
            starts[(cell >> shift & DIGIT) + 1] += 1
        for digit in range(DIGIT):
            starts[digit + 1] += starts[digit]
        for i in range(len(cells)):
            digit = ordered[i] >> shift & DIGIT
            other[starts[digit]], others[starts[digit]] = order[i], ordered[i]
            starts[digit] += 1
        order, other, ordered, others = other, order, others, ordered
        shift += DIGIT_BITS
    return order, ordered


@compiled
def _means(rows: np.ndarray, order: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Mean of the rows of each cell; `order` lists them cell by cell."""
    means = np.empty(rows.shape, np.float32)
    sums = np.zeros(rows.shape[1], np.int64)
    runs, start = 0, 0
    for i in range(len(order)):
        row = order[i]
        for c in range(len(sums)):
            sums[c] += np.int64(np.rint(rows[row, c] * np.float64(FRACTION)))
        if i + 1 == len(order) or cells[i + 1] != cells[i]:
            for c in range(len(sums)):
                means[runs, c] = sums[c] / (np.float64(FRACTION) * (i + 1 - start))
                sums[c] = 0
            runs, start = runs + 1, i + 1
    return means[:runs]
