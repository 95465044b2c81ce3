"""Counts -> rates with intervals; two agents on the same scenes -> what can be said of them.

The unit is the scene: its episodes differ in words only, and all agents meet the same ones. So
agents are compared scene by scene, and training seeds, where there are several, are drawn anew
together with the scenes.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Self

import numpy as np
from jaxtyping import Float64
from scipy.stats import norm

DRAWS = 10_000
"""Resamples of a bootstrap, and sign patterns of a test that is not exact."""

EXACT_SCENES = 14
"""Up to so many scenes with a difference, all sign patterns are tried."""

LEVEL, POWER = 0.05, 0.8

_TIE = 1e-12
"""Sums of the same numbers in another order differ by less."""


@dataclass(frozen=True)
class Interval:
    """A range of success probabilities, or of their differences."""

    low: float
    high: float


@dataclass(frozen=True)
class Tally:
    """Successes among episodes; a failed or errored episode counts in the denominator."""

    successes: int
    episodes: int

    @classmethod
    def of(cls, outcomes: Iterable[bool]) -> Self:
        """Count the true ones."""
        counted = tuple(outcomes)
        return cls(sum(counted), len(counted))

    @property
    def rate(self) -> float | None:
        """Share of successes; None without an episode."""
        return self.successes / self.episodes if self.episodes else None

    def __str__(self) -> str:
        """As tables show it: `17/25`."""
        return f"{self.successes}/{self.episodes}"


def wilson(tally: Tally, confidence: float = 0.95) -> Interval:
    """Wilson's score interval for a binomial proportion; [0, 1] without an episode.

    It describes one cell. The episodes of a scene are not independent, so differences between
    agents are for paired tests on scenes.
    """
    if not tally.episodes:
        return Interval(0.0, 1.0)
    n, rate = tally.episodes, tally.successes / tally.episodes
    z = float(norm.ppf(0.5 + confidence / 2))
    center = (rate + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * (rate * (1 - rate) / n + z * z / (4 * n * n)) ** 0.5
    return Interval(max(0.0, center - half), min(1.0, center + half))


def wilson_of_mean(tallies: Sequence[Tally], confidence: float = 0.95) -> Interval:
    """Interval of the mean of several rates, each task counting alike; of one, it is Wilson's.

    The distances from each rate to the ends of its Wilson interval add in squares (Newcombe's
    method), so that it keeps a width where every rate is 0 or 1.
    """
    rates = np.array([tally.rate or 0.0 for tally in tallies])
    ends = [wilson(tally, confidence) for tally in tallies]
    below = rates - [end.low for end in ends]
    above = [end.high for end in ends] - rates
    mean, count = float(rates.mean()), len(tallies)
    low, high = mean - np.linalg.norm(below) / count, mean + np.linalg.norm(above) / count
    return Interval(max(0.0, float(low)), min(1.0, float(high)))


@dataclass(frozen=True)
class Paired:
    """Two agents on the same scenes of one task: shares of successes over a scene's words."""

    ours: Float64[np.ndarray, "s n"]
    """A row for each training seed, a column for each scene."""

    theirs: Float64[np.ndarray, "r n"]
    """The same scenes; the seeds are others."""

    @property
    def differences(self) -> Float64[np.ndarray, "n"]:
        """Ours minus theirs on each scene, means over the training seeds."""
        gains: Float64[np.ndarray, n] = self.ours.mean(axis=0) - self.theirs.mean(axis=0)
        return gains


def mean_difference(tasks: Sequence[Paired]) -> float:
    """Ours minus theirs, each task counting alike."""
    return float(np.mean([task.differences.mean() for task in tasks]))


def bootstrap(
    tasks: Sequence[Paired], *, draws: int = DRAWS, seed: int = 0
) -> Float64[np.ndarray, "draws"]:
    """Mean differences if training seeds, then scenes within tasks, had been drawn anew.

    A seed is one network on all tasks, and all networks meet the same scenes: seeds are drawn once
    for all tasks (each agent's by themselves), scenes once for all networks. With one seed each,
    the result says nothing of another training.
    """
    rng = np.random.default_rng(seed)
    ours, theirs = (_redrawn(rng, draws, len(rows)) for rows in (tasks[0].ours, tasks[0].theirs))
    total = np.zeros(draws)
    for task in tasks:
        scenes = _redrawn(rng, draws, task.ours.shape[1])
        total += np.sum(ours * (scenes @ task.ours.T), axis=1)
        total -= np.sum(theirs * (scenes @ task.theirs.T), axis=1)
    return total / len(tasks)


def percentiles(drawn: Float64[np.ndarray, "draws"], confidence: float = 0.95) -> Interval:
    """The middle `confidence` of a bootstrap."""
    low, high = np.quantile(drawn, [(1 - confidence) / 2, (1 + confidence) / 2])
    return Interval(float(low), float(high))


@dataclass(frozen=True)
class SignFlip:
    """Outcome of a sign-flip test."""

    p_value: float
    """Two-sided."""

    exact: bool
    """All sign patterns were tried, not a random part of them."""


def sign_flip(tasks: Sequence[Paired], *, draws: int = DRAWS, seed: int = 0) -> SignFlip:
    """Could the mean difference be chance, if on each scene either agent had been the better one?

    It speaks of these trained networks: exchanging them scene by scene says nothing of others.
    """
    shares = np.concatenate(
        [task.differences / (task.differences.size * len(tasks)) for task in tasks]
    )
    shares = shares[np.abs(shares) > _TIE]
    exact = len(shares) <= EXACT_SCENES
    signs = _all_signs(len(shares)) if exact else _random_signs(len(shares), draws, seed)
    as_large = int(np.sum(np.abs(signs @ shares) >= abs(shares.sum()) - _TIE))
    # A random test counts what was observed among the patterns, so that p is never 0.
    p_value = as_large / len(signs) if exact else (1 + as_large) / (1 + draws)
    return SignFlip(p_value, exact)


def holm(p_values: Sequence[float]) -> list[float]:
    """p-values of a family of comparisons, adjusted so that any false one among them is rare."""
    raw = np.asarray(p_values, dtype=np.float64)
    order, count = np.argsort(raw, kind="stable"), len(raw)
    stepped = np.maximum.accumulate(raw[order] * (count - np.arange(count)))
    adjusted = np.empty(count)
    adjusted[order] = np.minimum(stepped, 1.0)
    return [float(p) for p in adjusted]


def detectable(standard_error: float, *, level: float = LEVEL, power: float = POWER) -> float:
    """The smallest true difference that would be found (two-sided, at `level`) so often.

    By the normal approximation around a difference with this standard error.
    """
    return float((norm.ppf(1 - level / 2) + norm.ppf(power)) * standard_error)


def _redrawn(rng: np.random.Generator, draws: int, count: int) -> Float64[np.ndarray, "draws n"]:
    """Weights of `count` units in each resample with replacement; rows sum to 1."""
    picked = rng.integers(count, size=(draws, count)) + count * np.arange(draws)[:, None]
    times = np.bincount(picked.ravel(), minlength=draws * count)
    return times.reshape(draws, count) / count


def _all_signs(count: int) -> Float64[np.ndarray, "patterns n"]:
    return np.array(list(product((-1.0, 1.0), repeat=count))).reshape(2**count, count)


def _random_signs(count: int, draws: int, seed: int) -> Float64[np.ndarray, "draws n"]:
    rng = np.random.default_rng(seed)
    return 2.0 * rng.integers(2, size=(draws, count), dtype=np.int8) - 1.0
