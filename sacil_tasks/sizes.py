"""Size ladders: which sizes stand on the table under which split, named by rank alone.

A family has one geometric ladder; a scene holds three consecutive rungs of it. The split chooses
the rungs after everything else of the scene is drawn, so it never moves an object (D-sizes).
Pure numpy.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

LABELS = ("small", "medium", "large")
"""Size words in ascending order; a label is the index of its word, the rank in the scene."""

CANDIDATES = len(LABELS)
"""Look-alikes on the table, one of each label."""

CANON_RUNG = 1
"""Rung of the small object in training."""

GRASPABLE_M = 0.070
"""Widest object that the open gripper (0.080 m) straddles with room to spare."""

_COMMON_JITTER = (0.96, 1.04)
_OWN_JITTER = (0.98, 1.02)


@dataclass(frozen=True)
class SizeFamily:
    """One ladder of sizes in metres, smallest first."""

    measure: str
    """What of the object is as long as its size says."""

    rungs_m: tuple[float, ...]

    def first_rungs(self, wanted: Sequence[int]) -> tuple[int, ...]:
        """Those of `wanted` from which three rungs can be taken."""
        return tuple(first for first in wanted if first + CANDIDATES <= len(self.rungs_m))


FAMILIES = {
    "block": SizeFamily("edge", (0.022, 0.029, 0.038, 0.050, 0.065)),
    "cup": SizeFamily("outer diameter", (0.031, 0.0395, 0.050, 0.063)),
    "pepper": SizeFamily("width", (0.030, 0.038, 0.048, 0.061)),
    "button": SizeFamily("cap diameter", (0.018, 0.025, 0.035, 0.049, 0.068)),
}
"""Adjacent ratios 1.31, 1.265, 1.265 and 1.40; what is to be grasped fits the open gripper."""


def draw_jitter(rng: np.random.Generator) -> Float64[np.ndarray, "3"]:
    """Size factor of each candidate: one common draw per scene times one of its own.

    The ranges are narrow enough that sizes of neighbouring labels never overlap.
    """
    return rng.uniform(*_COMMON_JITTER) * rng.uniform(*_OWN_JITTER, size=CANDIDATES)


def sizes_m(
    family: str, first_rung: int, labels: Int64[np.ndarray, "3"], jitter: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "3"]:
    """Size of each candidate in metres; the small one has the rung `first_rung`."""
    rungs = np.asarray(FAMILIES[family].rungs_m)
    return rungs[first_rung + labels] * jitter


def spread_m(
    family: str, ratio: float, labels: Int64[np.ndarray, "3"], jitter: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "3"]:
    """Sizes of exactly this ratio around the middle rung: the jitter is common to all."""
    common = np.exp(np.log(jitter).mean())
    return _middle_m(FAMILIES[family]) * ratio ** (labels - 1.0) * common


def largest_m(family: SizeFamily, ratio: float) -> float:
    """Largest size that `spread_m` can draw."""
    return _middle_m(family) * ratio * _COMMON_JITTER[1] * _OWN_JITTER[1]


def absolute_choice(
    family: str, label: str, sizes_m: Sequence[float] | Float64[np.ndarray, "k"]
) -> int:
    """Which of the objects is nearest to the size that `label` had in training.

    What a policy takes that has learnt sizes instead of ranks: right in `canon`, wrong wherever
    the shift moves another object nearer.
    """
    trained_m = FAMILIES[family].rungs_m[CANON_RUNG + LABELS.index(label)]
    return int(np.abs(np.log(np.asarray(sizes_m) / trained_m)).argmin())


def _middle_m(family: SizeFamily) -> float:
    return family.rungs_m[CANON_RUNG + 1]
