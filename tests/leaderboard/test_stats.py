from fractions import Fraction
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import binomtest

from leaderboard.stats import (
    Paired,
    SignFlip,
    Tally,
    bootstrap,
    detectable,
    holm,
    mean_difference,
    sign_flip,
    wilson,
    wilson_of_mean,
)


@settings(deadline=None)  # a busy machine is no failure
@given(
    episodes=st.integers(1, 2000), share=st.floats(0, 1), confidence=st.sampled_from([0.9, 0.95])
)
def test_wilson_agrees_with_scipy(episodes, share, confidence):
    successes = round(share * episodes)
    truth = binomtest(successes, episodes).proportion_ci(confidence, method="wilson")
    ours = wilson(Tally(successes, episodes), confidence)
    assert ours.low == pytest.approx(truth.low, abs=1e-12)
    assert ours.high == pytest.approx(truth.high, abs=1e-12)


def test_no_episodes_know_nothing():
    nothing = Tally.of([])
    assert nothing.rate is None
    assert (wilson(nothing).low, wilson(nothing).high) == (0, 1)


def test_a_tally_counts_failures_in_the_denominator():
    tally = Tally.of([True, False, True, False])
    assert (str(tally), tally.rate) == ("2/4", 0.5)


def test_a_mean_of_one_rate_has_wilsons_interval():
    ours, truth = wilson_of_mean([Tally(17, 25)]), wilson(Tally(17, 25))
    assert (ours.low, ours.high) == pytest.approx((truth.low, truth.high))


def test_means_agree_with_newcombes_published_difference():
    """56/70 - 48/80 has (0.0524, 0.3339) by his tenth method; 56/70 + 32/80 is that plus 1."""
    interval = wilson_of_mean([Tally(56, 70), Tally(32, 80)])
    assert 2 * interval.low - 1 == pytest.approx(0.0524, abs=5e-5)
    assert 2 * interval.high - 1 == pytest.approx(0.3339, abs=5e-5)


def test_a_mean_of_perfect_rates_is_not_certain():
    low = wilson_of_mean([Tally(102, 102)] * 4).low
    assert wilson(Tally(102, 102)).low < low < 1


def random_tasks(*shapes: tuple[int, int, int], words: int = 3) -> list[Paired]:
    rng = np.random.default_rng(1)
    return [
        Paired(
            rng.binomial(words, 0.7, size=(ours, scenes)) / words,
            rng.binomial(words, 0.5, size=(theirs, scenes)) / words,
        )
        for ours, theirs, scenes in shapes
    ]


def every_resample(tasks: list[Paired]) -> list[float]:
    """All equally likely resamples of seeds and scenes, one by one: slow and obvious."""
    found = []
    seeds = [range(len(tasks[0].ours))] * len(tasks[0].ours)
    rivals = [range(len(tasks[0].theirs))] * len(tasks[0].theirs)
    scenes = [[range(t.ours.shape[1])] * t.ours.shape[1] for t in tasks]
    for drawn_seeds in product(*seeds):
        for drawn_rivals in product(*rivals):
            for drawn in product(*(product(*task) for task in scenes)):
                means = []
                for task, picked in zip(tasks, drawn, strict=True):
                    ours = [task.ours[s][n] for s in drawn_seeds for n in picked]
                    theirs = [task.theirs[r][n] for r in drawn_rivals for n in picked]
                    means.append(sum(ours) / len(ours) - sum(theirs) / len(theirs))
                found.append(sum(means) / len(means))
    return found


@pytest.mark.parametrize(
    "shapes", [[(1, 1, 5)], [(3, 2, 4)], [(2, 2, 3), (2, 2, 3)]], ids=["scenes", "seeds", "tasks"]
)
def test_the_bootstrap_draws_what_looping_over_all_resamples_gives(shapes):
    tasks = random_tasks(*shapes)
    truth, drawn = np.array(every_resample(tasks)), bootstrap(tasks, draws=100_000)
    assert truth.mean() == pytest.approx(mean_difference(tasks))
    assert drawn.mean() == pytest.approx(truth.mean(), abs=4 * truth.std() / 300)
    assert drawn.std() == pytest.approx(truth.std(), rel=0.02)
    for quantile in (0.1, 0.5, 0.9):
        value = np.quantile(truth, quantile)
        below, upto = np.mean(drawn < value - 1e-9), np.mean(drawn <= value + 1e-9)
        assert below - 0.01 <= quantile <= upto + 0.01


def test_training_seeds_widen_the_interval():
    """Two networks that differ are less certain than twice the same one."""
    one, other = np.ones((1, 20)), np.zeros((1, 20))
    split = [Paired(np.concatenate([one, other]), np.full((2, 20), 0.5))]
    same = [Paired(np.full((2, 20), 0.5), np.full((2, 20), 0.5))]
    assert bootstrap(same).std() == 0
    assert bootstrap(split).std() == pytest.approx(np.sqrt(1 / 8), rel=0.05)


def flipped_by_loops(tasks: list[Paired]) -> Fraction:
    """Share of sign patterns with as large a mean, in exact arithmetic."""
    shares = [
        Fraction(float(d)).limit_denominator(1000) / (task.differences.size * len(tasks))
        for task in tasks
        for d in task.differences
    ]
    observed = abs(sum(shares))
    sums = [
        abs(sum(sign * share for sign, share in zip(signs, shares, strict=True)))
        for signs in product((-1, 1), repeat=len(shares))
    ]
    return Fraction(sum(it >= observed for it in sums), len(sums))


@pytest.mark.parametrize("shapes", [[(1, 1, 7)], [(2, 3, 5), (2, 3, 6)]])
def test_the_sign_flip_test_counts_all_patterns_exactly(shapes):
    tasks = random_tasks(*shapes)
    result = sign_flip(tasks)
    assert result.exact
    assert result.p_value == pytest.approx(float(flipped_by_loops(tasks)), abs=1e-12)


def test_many_scenes_are_flipped_at_random_and_come_near_the_truth():
    (task,) = random_tasks((1, 1, 24))
    differing = np.flatnonzero(task.differences)[:16]
    tasks = [Paired(task.ours[:, differing], task.theirs[:, differing])]
    truth, result = float(flipped_by_loops(tasks)), sign_flip(tasks)
    assert not result.exact
    assert result == sign_flip(tasks), "the same every time"
    assert result.p_value == pytest.approx(truth, abs=4 * np.sqrt(truth / 10_000))


def test_a_random_test_never_says_that_chance_is_impossible():
    assert 0 < sign_flip([Paired(np.ones((1, 200)), np.zeros((1, 200)))]).p_value < 0.001


def test_agents_that_do_the_same_differ_by_chance_for_certain():
    same = np.ones((1, 30))
    assert sign_flip([Paired(same, same)]) == SignFlip(1.0, exact=True)


def test_the_sign_flip_test_keeps_its_level():
    rng = np.random.default_rng(0)
    p_values = [
        sign_flip([Paired(*(rng.binomial(3, 0.5, size=(2, 1, 8)) / 3))]).p_value
        for _ in range(1000)
    ]
    assert np.mean(np.array(p_values) <= 0.05) <= 0.05 + 2 * np.sqrt(0.05 * 0.95 / 1000)


def test_holm_by_hand():
    assert holm([0.04, 0.01, 0.03, 0.5]) == pytest.approx([0.09, 0.04, 0.09, 0.5])
    assert holm([0.6, 0.7]) == [1.0, 1.0]
    assert holm([]) == []


@given(st.lists(st.floats(0, 1), max_size=12))
def test_holm_rejects_what_stepping_down_rejects(p_values):
    """At any level: go up from the smallest p and stop at the first that is too large."""
    adjusted = holm(p_values)
    for level in (0.01, 0.05, 0.3):
        rejected, ordered = set(), sorted(range(len(p_values)), key=lambda i: p_values[i])
        for step, i in enumerate(ordered):
            if p_values[i] * (len(p_values) - step) > level:
                break
            rejected.add(i)
        assert {i for i, p in enumerate(adjusted) if p <= level} == rejected


def test_a_detectable_difference_is_found_as_often_as_promised():
    rng, standard_error = np.random.default_rng(0), 3.0
    seen = rng.normal(detectable(standard_error), standard_error, size=100_000)
    assert np.mean(np.abs(seen) > 1.959964 * standard_error) == pytest.approx(0.8, abs=0.005)
