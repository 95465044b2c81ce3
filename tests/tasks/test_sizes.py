"""Sizes: labels are ranks, splits shift them, and absolute size is a cue in `canon` only."""

import itertools

import numpy as np
import pytest

from sacil_tasks import sizes
from sacil_tasks.sizes import FAMILIES, LABELS
from sacil_tasks.splits import FINE_RATIOS

EXTREMES = (0.96 * 0.98, 1.04 * 1.02)
"""Smallest and largest jitter."""

FIRST_RUNGS = [
    (name, first) for name, family in FAMILIES.items() for first in family.first_rungs((0, 1, 2))
]


@pytest.mark.parametrize("family", FAMILIES)
def test_ladders_are_geometric(family: str) -> None:
    ratios = np.divide(FAMILIES[family].rungs_m[1:], FAMILIES[family].rungs_m[:-1])
    assert np.allclose(ratios, ratios.mean(), rtol=0.03)


@pytest.mark.parametrize(("family", "first"), FIRST_RUNGS)
def test_rank_survives_any_jitter(family: str, first: int) -> None:
    labels = np.arange(3)
    for pair in itertools.product(EXTREMES, repeat=3):
        drawn = sizes.sizes_m(family, first, labels, np.array(pair))
        assert np.all(np.diff(drawn) > 0)


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("ratio", FINE_RATIOS)
def test_a_ratio_is_exact_whatever_the_jitter(family: str, ratio: float) -> None:
    jitter = sizes.draw_jitter(np.random.default_rng(0))
    drawn = sizes.spread_m(family, ratio, np.array([2, 0, 1]), jitter)
    assert drawn[[2, 0]] / drawn[[1, 2]] == pytest.approx([ratio, ratio])
    assert drawn.max() <= sizes.largest_m(FAMILIES[family], ratio)


@pytest.mark.parametrize(("family", "first"), FIRST_RUNGS)
def test_shifted_sizes_mislead_whoever_learnt_absolute_sizes(family: str, first: int) -> None:
    """The nearest object to a word's training size is the named one in a third of cases."""
    for corner in itertools.product(EXTREMES, repeat=3):
        shown = sizes.sizes_m(family, first, np.arange(3), np.array(corner))
        picks = [sizes.absolute_choice(family, label, shown) for label in LABELS]
        assert picks == {0: [1, 2, 2], 1: [0, 1, 2], 2: [0, 0, 1]}[first]


def test_what_is_grasped_fits_the_open_gripper() -> None:
    for name in set(FAMILIES) - {"button"}:
        assert max(FAMILIES[name].rungs_m) * EXTREMES[1] < sizes.GRASPABLE_M
    assert FAMILIES["cup"].first_rungs((0, 1, 2)) == (0, 1)


def test_jitter_is_mostly_common_to_the_scene() -> None:
    rng = np.random.default_rng(0)
    jitter = np.array([sizes.draw_jitter(rng) for _ in range(2000)])
    assert jitter.min() >= EXTREMES[0]
    assert jitter.max() <= EXTREMES[1]
    assert np.ptp(jitter, axis=1).max() <= 0.04 * 1.04
    assert len(LABELS) == jitter.shape[1]
