import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import binomtest

from leaderboard.stats import Tally, wilson


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
