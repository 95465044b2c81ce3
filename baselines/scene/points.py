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
from baselines.scene.sight import STILL, Moment, gripper_in_cube
from baselines.scene.views import cube_from_base
from sacil_tasks.errors import UsageError
from sacil_tasks.interface import SCENE_BOUNDS, Observation

TABLE_M = 0.003
"""Points up to this height are the table: depth is rounded to a millimetre, and 99.9 % of the
table's points lie within one."""

SMOOTH_M = 0.02
"""Pixels farther apart than this are not of one surface, as far as normals are concerned."""

FRACTION = 2**20
"""Sums over a voxel count in these parts of one, which makes them exact in any order."""

PARENTS = 3
"""Coarse points that a finer one is interpolated from."""

TAKEN = np.float32(-1)
"""Gap of a point that has its place in the order."""

LOW_BITS = 2**32 - 1

COLUMNS = 9
"""Of a row of a cloud: position in the cube, colour (0 to 255), normal."""

HALF_SIDE_M = SCENE_BOUNDS.side_m / 2


@dataclass(frozen=True, kw_only=True)
class Pyramid:
    """How a cloud is thinned out, stage by stage."""

    voxel_m: float
    """Edge of the cells in which points are averaged."""

    points: int
    """Points that enter the network; a smaller cloud is repeated, a larger one drawn from."""

    stages: tuple[int, ...]
    """Points that each stage keeps, falling."""

    radius: float
    """Reach of the first stage's neighbourhoods, as a share of the cloud's."""

    growth: float
    """Factor from one stage's radius to the next one's."""

    neighbours: int
    """Points that a neighbourhood counts."""

    def __post_init__(self) -> None:
        """Check that stages fall.

        Raises:
            UsageError: a stage keeps more points than there are.
        """
        counts = (self.points, *self.stages)
        if list(counts) != sorted(counts, reverse=True) or counts[-1] < 1:
            raise UsageError(
                f"stages of {self.stages} points cannot be taken from {self.points}: each keeps "
                "some of the one before. Change --points or --stages."
            )

    @property
    def radii(self) -> tuple[float, ...]:
        """Reach of each stage's neighbourhoods."""
        return tuple(self.radius * self.growth**stage for stage in range(len(self.stages)))


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
        offsets = voxels[:, :3] - gripper
        reach = np.float32(np.linalg.norm(offsets, axis=1).max()) or np.float32(1)
        chosen = np.random.default_rng(moment.seed).permutation(len(voxels))[: self.pyramid.points]
        xyz = offsets[chosen] / reach
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
    return _means(rows, np.sort(_cells(rows, np.float32(cell))))


def farthest_first(xyz: Float32[np.ndarray, "n 3"], count: int) -> Int32[np.ndarray, "n"]:
    """An order in which each of the first `count` points is the farthest from those before it.

    It begins with point 0, and ends with the points not chosen, in the order they came.
    """
    return _farthest_first(np.ascontiguousarray(xyz.T), count)


def near_points(xyz: Float32[np.ndarray, "n 3"], pyramid: Pyramid) -> Int32[np.ndarray, "r k"]:
    """For each centre of each stage, the first points within its radius in the stage before.

    With the farthest first, the first points are those that spread over the neighbourhood
    (D-polarnet-ball).
    """
    near = np.empty((sum(pyramid.stages), pyramid.neighbours), np.int32)
    axes = np.ascontiguousarray(xyz.T)
    start, before = 0, pyramid.points
    for count, radius in zip(pyramid.stages, pyramid.radii, strict=True):
        _first_in_balls(axes, before, np.float32(radius**2), near[start : start + count])
        start, before = start + count, count
    return near


def nearest_three(
    xyz: Float32[np.ndarray, "n 3"], pyramid: Pyramid
) -> tuple[Int32[np.ndarray, "u 3"], Float32[np.ndarray, "u 3"]]:
    """Parents of each point that a stage drops, and weights by inverse distance."""
    dropped = pyramid.points - pyramid.stages[-1]
    parents = np.empty((dropped, PARENTS), np.int32)
    shares = np.empty((dropped, PARENTS), np.float32)
    axes = np.ascontiguousarray(xyz.T)
    before = pyramid.points
    for count in pyramid.stages:
        part = slice(count - pyramid.stages[-1], before - pyramid.stages[-1])
        _three_nearest(axes, count, parents[part], shares[part])
        before = count
    return parents, shares


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
    count = 0
    for k in range(len(maps)):
        for i in range(height):
            for j in range(width):
                if not inside[k, i, j] or maps[k, 2, i, j] <= floor:
                    continue
                for c in range(3):
                    rows[count, c] = maps[k, c, i, j]
                    rows[count, 3 + c] = rgb[k, i, j, c]
                _normal(maps[k], inside[k], i, j, rows[count, 6:])
                count += 1
    return count


@compiled
def _normal(maps: np.ndarray, inside: np.ndarray, i: int, j: int, out: np.ndarray) -> None:
    """Unit normal towards the camera from the pixel's neighbours; 0 where there is none
    (D-polarnet-normals)."""
    height, width = inside.shape
    left = j - 1 if j > 0 and _smooth(maps, inside, i, j, i, j - 1) else j
    right = j + 1 if j + 1 < width and _smooth(maps, inside, i, j, i, j + 1) else j
    above = i - 1 if i > 0 and _smooth(maps, inside, i, j, i - 1, j) else i
    below = i + 1 if i + 1 < height and _smooth(maps, inside, i, j, i + 1, j) else i
    ux = maps[0, i, right] - maps[0, i, left]
    uy = maps[1, i, right] - maps[1, i, left]
    uz = maps[2, i, right] - maps[2, i, left]
    vx = maps[0, below, j] - maps[0, above, j]
    vy = maps[1, below, j] - maps[1, above, j]
    vz = maps[2, below, j] - maps[2, above, j]
    out[0], out[1], out[2] = vy * uz - vz * uy, vz * ux - vx * uz, vx * uy - vy * ux
    length = np.sqrt(out[0] ** 2 + out[1] ** 2 + out[2] ** 2)
    if length > 0:
        out /= length


@compiled
def _smooth(maps: np.ndarray, inside: np.ndarray, i: int, j: int, row: int, column: int) -> bool:
    """Whether a neighbouring pixel continues the surface."""
    if not inside[row, column]:
        return False
    squared = np.float32(0)
    for c in range(3):
        squared += (maps[c, row, column] - maps[c, i, j]) ** 2
    return bool(squared < np.float32((SMOOTH_M / HALF_SIDE_M) ** 2))


@compiled
def _cells(rows: np.ndarray, cell: np.float32) -> np.ndarray:
    """The cell of each row as one number, and the row's own number in the low bits.

    Sorted they list the rows cell by cell; NumPy sorts numbers far faster than it ranks them.
    """
    side = np.int64(2 / cell) + 2
    keys = np.empty(len(rows), np.int64)
    for i in range(len(rows)):
        key = np.int64(0)
        for axis in range(3):
            key = key * side + np.int64((rows[i, axis] + np.float32(1)) / cell)
        keys[i] = key << 32 | i
    return keys


@compiled
def _means(rows: np.ndarray, keys: np.ndarray) -> np.ndarray:
    """Mean of the rows of each cell, whose keys are sorted."""
    means = np.empty(rows.shape, np.float32)
    sums = np.zeros(rows.shape[1], np.int64)
    runs, start = 0, 0
    for i in range(len(keys)):
        row = keys[i] & LOW_BITS
        for c in range(len(sums)):
            sums[c] += np.int64(np.rint(rows[row, c] * np.float64(FRACTION)))
        if i + 1 == len(keys) or keys[i + 1] >> 32 != keys[i] >> 32:
            for c in range(len(sums)):
                means[runs, c] = sums[c] / (np.float64(FRACTION) * (i + 1 - start))
                sums[c] = 0
            runs, start = runs + 1, i + 1
    return means[:runs]


@compiled
def _farthest_first(xyz: np.ndarray, count: int) -> np.ndarray:
    points = xyz.shape[1]
    gaps = np.full(points, np.float32(np.inf))
    order = np.empty(points, np.int32)
    latest = 0
    for taken in range(count):
        order[taken] = latest
        _shrink(xyz[0], xyz[1], xyz[2], latest, gaps)
        gaps[latest] = TAKEN
        latest = _widest(gaps.view(np.int32))
    rest = count
    for i in range(points):
        if gaps[i] != TAKEN:
            order[rest] = i
            rest += 1
    return order


@compiled
def _first_in_balls(xyz: np.ndarray, before: int, squared: np.float32, near: np.ndarray) -> None:
    """Fill one stage's neighbourhoods; the first neighbour fills what is left over."""
    points = xyz.shape[1]
    gaps = np.empty(min(before, points), np.float32)
    for row in range(len(near)):
        _squared(xyz[0], xyz[1], xyz[2], row % points, gaps)
        found = 0
        for i in range(len(gaps)):
            if gaps[i] <= squared:
                near[row, found] = i
                found += 1
                if found == near.shape[1]:
                    break
        near[row, found:] = near[row, 0]


@compiled
def _three_nearest(xyz: np.ndarray, count: int, parents: np.ndarray, shares: np.ndarray) -> None:
    """Fill the parents of the points from `count` on among the first `count`.

    Where there are fewer than three, the nearest is named again, with no share.
    """
    points = xyz.shape[1]
    gaps = np.empty(min(count, points), np.float32)
    for row in range(len(parents)):
        _squared(xyz[0], xyz[1], xyz[2], (count + row) % points, gaps)
        key = np.int64(-1)
        for rank in range(PARENTS):
            key = _next_nearest(gaps.view(np.int32), key)
            parent = key & LOW_BITS if rank < len(gaps) else parents[row, 0]
            share = np.float32(1) / (np.sqrt(gaps[parent]) + np.float32(1e-8))
            parents[row, rank] = parent
            shares[row, rank] = share if rank < len(gaps) else np.float32(0)
        shares[row] /= shares[row].sum()


# The loops below are functions of contiguous arrays because LLVM then turns them into vector
# instructions. The bits of floats that are not negative are integers of the same order, and with
# the index beside them one minimum finds both; minima of integers vectorise, those of floats with
# their index do not.


@compiled
def _squared(x: np.ndarray, y: np.ndarray, z: np.ndarray, point: int, gaps: np.ndarray) -> None:
    """Squared distances from one point to as many first points as there are gaps."""
    px, py, pz = x[point], y[point], z[point]
    for i in range(len(gaps)):
        gaps[i] = (x[i] - px) ** 2 + (y[i] - py) ** 2 + (z[i] - pz) ** 2


@compiled
def _shrink(x: np.ndarray, y: np.ndarray, z: np.ndarray, point: int, gaps: np.ndarray) -> None:
    """Lower each point's squared gap to what is taken, now that `point` is."""
    px, py, pz = x[point], y[point], z[point]
    for i in range(len(gaps)):
        gap = (x[i] - px) ** 2 + (y[i] - py) ** 2 + (z[i] - pz) ** 2
        gaps[i] = min(gaps[i], gap)


@compiled
def _widest(bits: np.ndarray) -> int:
    """Index of the greatest float, the first one of equals; `bits` are those of the floats."""
    best = np.int64(-(2**63))
    for i in range(len(bits)):
        best = max(best, (np.int64(bits[i]) << 32) - i)
    return int(-best & LOW_BITS)


@compiled
def _next_nearest(bits: np.ndarray, after: int) -> int:
    """The least key above `after`; a key is the float's bits, then its index."""
    none = np.int64(2**63 - 1)
    best = none
    for i in range(len(bits)):
        key = (np.int64(bits[i]) << 32) | i
        best = min(best, key if key > after else none)
    return int(best)
