"""Seed -> scene: where candidates stand, their sizes, colours and words. Pure numpy.

A scene is a function of its seed alone. Geometry, layout and instruction have streams of their
own: ManiSkill restarts one stream for building and for placing, which would make an object's size
and its position the same number.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from sacil_tasks.errors import UsageError, find_name
from sacil_tasks.sizes import CANDIDATES, draw_jitter
from sacil_tasks.spec import REGION_M as REGION_M
from sacil_tasks.spec import Fixture, Range, TaskSpec

SEED_BITS = 32
ATTEMPTS = 64
"""Seeds reserved for one scene index: the expert must be able to plan the one that is used."""

COLOURS = {
    "red": (0.80, 0.05, 0.05),
    "maroon": (0.35, 0.02, 0.06),
    "scarlet": (0.95, 0.22, 0.08),
    "orange": (0.95, 0.42, 0.02),
    "brown": (0.33, 0.15, 0.04),
    "gold": (0.80, 0.55, 0.05),
    "yellow": (0.95, 0.85, 0.05),
    "olive": (0.35, 0.36, 0.02),
    "lime": (0.50, 0.85, 0.05),
    "green": (0.05, 0.55, 0.08),
    "forest": (0.02, 0.24, 0.07),
    "teal": (0.02, 0.40, 0.38),
    "cyan": (0.05, 0.80, 0.85),
    "azure": (0.10, 0.48, 0.95),
    "blue": (0.04, 0.12, 0.80),
    "navy": (0.03, 0.04, 0.30),
    "violet": (0.40, 0.10, 0.75),
    "purple": (0.32, 0.03, 0.35),
    "magenta": (0.85, 0.05, 0.70),
    "rose": (0.95, 0.30, 0.50),
}
"""Linear RGB. Never in the words, and never a cue: a nuisance the policy has to ignore."""

_RANGES = {"train": (0, 2**31), "val": (2**31, 2**30), "test": (2**31 + 2**30, 2**30)}
"""Partition -> (first seed, number of seeds); together they are all seeds of 32 bits."""

PARTITIONS = tuple(_RANGES)
STREAMS = (
    *("geometry", "layout", "instruction"),
    *("split", "clutter", "phrases", "templates", "other"),
)
"""New ones go to the end: a stream is known by its place."""


@dataclass(frozen=True)
class Geometry:
    """What is built: everything of the candidates that needs new shapes, but for the split."""

    labels: Int64[np.ndarray, "3"]
    """Rank of each candidate's size (index into `sizes.LABELS`): a uniform permutation."""

    jitter: Float64[np.ndarray, "3"]
    """Factor on each candidate's rung."""

    rgb: Float64[np.ndarray, "3 3"]
    """Linear colour of each candidate."""


@dataclass(frozen=True)
class Layout:
    """Where things stand, in the world frame (table top at z = 0); knows nothing of sizes."""

    xy_m: Float64[np.ndarray, "3 2"]
    """Candidate centres."""

    yaw_rad: Float64[np.ndarray, "3"]
    """Candidate headings about the vertical."""

    goal_m: Float64[np.ndarray, "3"]
    """A point in the air over the region, for tasks that lift something to it."""

    fixture: Float64[np.ndarray, "3"]
    """x and y (m) and heading (rad) of the fixture; zeros where there is none."""


def scene_seed(partition: str, scene_set: int, task: str, index: int, attempt: int) -> int:
    """Seed of 32 bits; partitions cannot meet, since each owns a range of seeds.

    Within a partition and task, (index, attempt) pairs of one scene set never collide.

    Raises:
        UsageError: the partition is unknown or a number is out of range.
    """
    first, count = _RANGES[find_name(partition, PARTITIONS, "partition")]
    if not 0 <= attempt < ATTEMPTS or not 0 <= index < count // ATTEMPTS:
        raise UsageError(
            f"scene index 0 to {count // ATTEMPTS - 1} and attempt 0 to {ATTEMPTS - 1} exist, "
            f"but {index} and {attempt} came; ask for fewer scenes."
        )
    key = hashlib.sha256(f"{scene_set}/{task}".encode()).digest()[:8]
    return first + (int.from_bytes(key) + index * ATTEMPTS + attempt) % count


def partition_of(seed: object) -> str:
    """Partition a seed belongs to. Small seeds, as people type them, are `train`.

    Raises:
        UsageError: the seed has more than 32 bits or is negative.
    """
    for partition, (first, count) in _RANGES.items():
        if isinstance(seed, int | np.integer) and first <= seed < first + count:
            return partition
    raise UsageError(f"a seed is an integer from 0 to {2**SEED_BITS - 1}, but {seed!r} came.")


def check_seeds(seeds: Sequence[object], environments: int) -> None:
    """Accept the seeds of a reset: none, one for all, or one for each environment.

    Raises:
        UsageError: there are too few or too many, or one is no seed.
    """
    if len(seeds) not in {0, 1, environments}:
        raise UsageError(
            f"{environments} environment(s) take one seed, or one each, but {len(seeds)} came."
        )
    for seed in seeds:
        partition_of(seed)


def stream(seed: int, tag: str) -> np.random.Generator:
    """Random stream of one aspect of the scene, independent of the scene's other streams."""
    return np.random.default_rng([seed, STREAMS.index(tag)])


def draw_geometry(seed: int) -> Geometry:
    """Draw sizes by rank, jitter and colours."""
    rng = stream(seed, "geometry")
    return Geometry(
        labels=rng.permutation(CANDIDATES),
        jitter=draw_jitter(rng),
        rgb=_draw_colours(rng, partition_of(seed)),
    )


def draw_layout(spec: TaskSpec, seed: int) -> Layout:
    """Draw positions with the clearance of the largest size, then headings and the goal."""
    rng = stream(seed, "layout")
    limit_rad = np.deg2rad(spec.yaw_limit_deg)
    fixture = np.zeros(3) if spec.fixture is None else _draw_fixture(rng, spec.fixture)
    return Layout(
        xy_m=_draw_spaced_points(rng, spec, fixture),
        yaw_rad=rng.uniform(-limit_rad, limit_rad, size=CANDIDATES),
        goal_m=np.array([*_draw_points(rng, REGION_M, 1)[0], rng.uniform(0.20, 0.30)]),
        fixture=fixture,
    )


def in_world(
    fixture: Float64[np.ndarray, "3"], points_m: Float64[np.ndarray, "n 2"]
) -> Float64[np.ndarray, "n 2"]:
    """Points of the fixture's frame, seen from above, in the world frame."""
    cosine, sine = np.cos(fixture[2]), np.sin(fixture[2])
    return points_m @ np.array([[cosine, sine], [-sine, cosine]]) + fixture[:2]


def _draw_fixture(rng: np.random.Generator, fixture: Fixture) -> Float64[np.ndarray, "3"]:
    shift = rng.uniform(-fixture.shift_m, fixture.shift_m, size=2)
    low, high = fixture.yaw_deg[rng.integers(len(fixture.yaw_deg))]
    return np.array([*(fixture.xy_m + shift), np.deg2rad(rng.uniform(low, high))])


def _draw_spaced_points(
    rng: np.random.Generator, spec: TaskSpec, fixture: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "3 2"]:
    while True:
        if spec.fixture is None or not spec.fixture.spots_m:
            points = _draw_points(rng, spec.region_m, CANDIDATES)
        else:
            points = in_world(fixture, _draw_on_spots(rng, spec.fixture))
        gaps = np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1)
        if gaps.min() >= spec.spacing_m:
            return points


def _draw_points(
    rng: np.random.Generator, region_m: tuple[Range, Range], count: int
) -> Float64[np.ndarray, "n 2"]:
    low, high = np.transpose(region_m)
    return rng.uniform(low, high, size=(count, 2))


def _draw_on_spots(rng: np.random.Generator, fixture: Fixture) -> Float64[np.ndarray, "3 2"]:
    """Candidates on the spots in any order, in the fixture's frame."""
    shift = rng.uniform(-fixture.spot_shift_m, fixture.spot_shift_m, size=(CANDIDATES, 2))
    return rng.permutation(np.array(fixture.spots_m)) + shift


def _draw_colours(rng: np.random.Generator, partition: str) -> Float64[np.ndarray, "3 3"]:
    """Validation and test have one colour for all; half of the training scenes are mixed
    (D-colours)."""
    picks = rng.integers(len(COLOURS), size=CANDIDATES)
    if rng.random() < 0.5 or partition != "train":
        picks[:] = picks[0]
    return np.array(list(COLOURS.values()))[picks]
