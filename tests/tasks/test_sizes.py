"""Sizes: labels are ranks, splits shift them, and absolute size is a cue in `canon` only."""

import itertools

import numpy as np
import pytest

from sacil_tasks import sizes
from sacil_tasks.sizes import FAMILIES, LABELS

EXTREMES = (0.96 * 0.98, 1.04 * 1.02)
"""Smallest and largest jitter."""

SUPPORTED = [(name, split) for name, family in FAMILIES.items() for split in family.splits]


@pytest.mark.parametrize("family", FAMILIES)
def test_ladders_are_geometric(family: str) -> None:
    ratios = np.divide(FAMILIES[family].rungs_m[1:], FAMILIES[family].rungs_m[:-1])
    assert np.allclose(ratios, ratios.mean(), rtol=0.03)


@pytest.mark.parametrize(("family", "split"), SUPPORTED)
def test_rank_survives_any_jitter(family: str, split: str) -> None:
    labels = np.arange(3)
    for pair in itertools.product(EXTREMES, repeat=3):
        drawn = sizes.sizes_m(family, split, labels, np.array(pair))
        assert np.all(np.diff(drawn) > 0)


@pytest.mark.parametrize("family", FAMILIES)
def test_shifted_sizes_mislead_whoever_learnt_absolute_sizes(family: str) -> None:
    """The nearest object to a word's training size is the named one in a third of cases."""
    labels, ones = np.arange(3), np.ones(3)
    trained = sizes.sizes_m(family, "canon", labels, ones)
    for split in FAMILIES[family].splits:
        shown = sizes.sizes_m(family, split, labels, ones)
        picks = np.abs(np.log(shown[None] / trained[:, None])).argmin(axis=1)
        assert np.mean(picks == labels) == (1.0 if split == "canon" else pytest.approx(1 / 3))


def test_cups_fit_the_open_gripper() -> None:
    assert max(FAMILIES["cup"].rungs_m) * EXTREMES[1] < 0.08
    assert "shift_up" not in FAMILIES["cup"].splits


def test_jitter_is_mostly_common_to_the_scene() -> None:
    rng = np.random.default_rng(0)
    jitter = np.array([sizes.draw_jitter(rng) for _ in range(2000)])
    assert jitter.min() >= EXTREMES[0]
    assert jitter.max() <= EXTREMES[1]
    assert np.ptp(jitter, axis=1).max() <= 0.04 * 1.04
    assert len(LABELS) == jitter.shape[1]
