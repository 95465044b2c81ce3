"""Which of a cloud's points a stage keeps, and who is whose neighbour (PolarNet section 3).

The points come farthest first: each is the one farthest from all before it. So every stage of a
point network keeps a prefix of this order, and the first points within a radius are spread over it.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int32

from baselines.scene.compiled import compiled
from sacil_tasks.errors import UsageError

PARENTS = 3
"""Coarse points that a finer one is interpolated from."""

TAKEN = np.float32(-1)
"""Gap of a point that has its place in the order."""

BLOCK = 32
"""Points among which neighbours are looked for at a time."""


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
    points, wanted = xyz.shape[1], near.shape[1]
    gaps, inside = np.empty(min(before, points), np.float32), np.empty(wanted + BLOCK, np.int32)
    for row in range(len(near)):
        _squared(xyz[0], xyz[1], xyz[2], row % points, gaps)
        found, start = 0, 0
        while found < wanted and start < len(gaps):
            block = gaps[start : start + BLOCK]
            if _any_within(block, squared):
                for i in range(len(block)):  # always written: there is no branch to be guessed
                    inside[found] = start + i
                    found += block[i] <= squared
            start += BLOCK
        for k in range(wanted):
            near[row, k] = inside[k if k < found else 0]


@compiled
def _three_nearest(xyz: np.ndarray, count: int, parents: np.ndarray, shares: np.ndarray) -> None:
    """Fill the parents of the points from `count` on among the first `count`.

    Where there are fewer than three, the nearest is named again, with no share.
    """
    points = xyz.shape[1]
    gaps = np.empty(min(count, points), np.float32)
    for row in range(len(parents)):
        _squared(xyz[0], xyz[1], xyz[2], (count + row) % points, gaps)
        for rank in range(PARENTS):
            parent = _least(gaps.view(np.int32)) if rank < len(gaps) else parents[row, 0]
            share = np.float32(1) / (np.sqrt(gaps[parent]) + np.float32(1e-8))
            parents[row, rank] = parent
            shares[row, rank] = share if rank < len(gaps) else np.float32(0)
            gaps[parent] = np.inf
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
    return int(-best & 2**32 - 1)


@compiled
def _any_within(gaps: np.ndarray, limit: np.float32) -> bool:
    """Whether one of the floats is no greater than `limit`."""
    within = 0
    for i in range(len(gaps)):
        within |= gaps[i] <= limit
    return within > 0


@compiled
def _least(bits: np.ndarray) -> int:
    """Index of the least float, the first one of equals; `bits` are those of the floats."""
    best = np.int64(2**63 - 1)
    for i in range(len(bits)):
        best = min(best, np.int64(bits[i]) << 32 | i)
    return int(best & 2**32 - 1)
