"""Counts -> rates with intervals."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Self

from scipy.stats import norm


@dataclass(frozen=True)
class Interval:
    """A range of success probabilities."""

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
