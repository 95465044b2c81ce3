"""Seed and split -> what stands on the table: sizes, colours, absentees, clutter. Pure numpy.

The scene itself (`scenes`) knows no split. What a split adds or changes comes from a stream of its
own, so that the same seed has the same places, size order and jitter under every split.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from sacil_tasks.scenes import COLOURS, Geometry, Layout, draw_geometry, stream
from sacil_tasks.sizes import CANDIDATES, FAMILIES, LABELS, sizes_m, spread_m
from sacil_tasks.spec import TaskSpec
from sacil_tasks.splits import SPLITS, Split

_SPOTS = 256
"""Places tried for the clutter; the one farthest from every candidate is used."""


@dataclass(frozen=True)
class Clutter:
    """One more object, of another kind than the candidates."""

    family: str
    size_m: float


@dataclass(frozen=True)
class Contents:
    """What is built for one seed and split."""

    labels: Int64[np.ndarray, "3"]
    """Rank of each candidate's size (index into `sizes.LABELS`) among those present."""

    sizes_m: Float64[np.ndarray, "3"]
    present: Bool[np.ndarray, "3"]
    """Whether the candidate is on the table, unless that depends on the words."""

    rgb: Float64[np.ndarray, "3 3"]
    """Linear colour of each candidate."""

    colour_of: Mapping[str, str]
    """Colour name of each label, where the words name colours."""

    clutter: Clutter | None


def draw_contents(task: TaskSpec, name: str, seed: int) -> Contents:
    """Draw what the split `name` shows in the scene `seed`."""
    split, geometry, rng = SPLITS[name], draw_geometry(seed), stream(seed, "split")
    drawn_m = _draw_sizes(task, split, geometry, rng)
    labels, present = geometry.labels, np.ones(CANDIDATES, dtype=bool)
    if split.objects == "two":
        labels, present = _leave_one_out(labels, absent=int(rng.integers(CANDIDATES)))
    rgb, colours = geometry.rgb, {}
    if split.colours:
        picks = [str(pick) for pick in rng.permutation(split.colours)[:CANDIDATES]]
        rgb = np.array([COLOURS[pick] for pick in picks])
        colours = {LABELS[label]: pick for label, pick in zip(labels, picks, strict=True)}
    clutter = _draw_clutter(task, split, rng) if split.clutter else None
    return Contents(labels, drawn_m, present, rgb, colours, clutter)


def clutter_xy_m(task: TaskSpec, layout: Layout, seed: int) -> Float64[np.ndarray, "2"]:
    """Where the clutter stands in the world frame: clear of the candidates."""
    low, high = np.transpose(task.clutter_region_m or task.region_m)
    spots = stream(seed, "clutter").uniform(low, high, size=(_SPOTS, 2))
    gaps_m = np.linalg.norm(spots[:, None] - layout.xy_m, axis=-1).min(axis=1)
    clear = np.flatnonzero(gaps_m >= task.spacing_m)
    return spots[clear[0] if len(clear) else gaps_m.argmax()]


def _draw_sizes(
    task: TaskSpec, split: Split, geometry: Geometry, rng: np.random.Generator
) -> Float64[np.ndarray, "3"]:
    if split.ratio is not None:
        return spread_m(task.family, split.ratio, geometry.labels, geometry.jitter)
    first_rung = int(rng.choice(FAMILIES[task.family].first_rungs(split.first_rungs)))
    return sizes_m(task.family, first_rung, geometry.labels, geometry.jitter)


def _leave_one_out(
    labels: Int64[np.ndarray, "3"], absent: int
) -> tuple[Int64[np.ndarray, "3"], Bool[np.ndarray, "3"]]:
    """Leave out the rank `absent`; the others become small and large, and it takes the middle."""
    small, large = sorted({0, 1, 2} - {absent})
    renamed = np.empty(CANDIDATES, dtype=labels.dtype)
    renamed[[small, absent, large]] = [0, 1, 2]
    return renamed[labels], labels != absent


def _draw_clutter(task: TaskSpec, split: Split, rng: np.random.Generator) -> Clutter:
    others = [family for family in split.clutter if family != task.family]
    family = others[int(rng.integers(len(others)))]
    return Clutter(family, float(rng.choice(FAMILIES[family].rungs_m)))
