"""Size ladders: which sizes stand on the table under which split, named by rank alone.

A family has one geometric ladder; a scene holds three consecutive rungs of it. The split chooses
the rungs after everything else of the scene is drawn, so it never moves an object (D-sizes).
Pure numpy.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

LABELS = ("small", "medium", "large")
"""Size words in ascending order; a label is the index of its word, the rank in the scene."""

CANDIDATES = len(LABELS)
"""Look-alikes on the table, one of each label."""

FIRST_RUNG = {"canon": 1, "shift_down": 0, "shift_up": 2}
"""Split -> rung of the small object. Training sees `canon` only; a policy that has learnt
absolute sizes picks the wrong object in two thirds of the shifted scenes."""

SPLITS = tuple(FIRST_RUNG)

_COMMON_JITTER = (0.96, 1.04)
_OWN_JITTER = (0.98, 1.02)


@dataclass(frozen=True)
class SizeFamily:
    """One ladder of sizes in metres, smallest first."""

    rungs_m: tuple[float, ...]
    """Edge of a block, outer diameter of a cup, cap diameter of a button."""

    @property
    def splits(self) -> tuple[str, ...]:
        """Splits whose three rungs exist on this ladder."""
        return tuple(
            split for split, first in FIRST_RUNG.items() if first + CANDIDATES <= len(self.rungs_m)
        )


FAMILIES = {
    "block": SizeFamily((0.022, 0.029, 0.038, 0.050, 0.065)),
    "cup": SizeFamily((0.031, 0.0395, 0.050, 0.063)),
    "button": SizeFamily((0.018, 0.025, 0.035, 0.049, 0.068)),
}
"""Adjacent ratios 1.31, 1.265 and 1.40; the largest cup still fits the open gripper (80 mm)."""


def draw_jitter(rng: np.random.Generator) -> Float64[np.ndarray, "3"]:
    """Size factor of each candidate: one common draw per scene times one of its own.

    The ranges are narrow enough that sizes of neighbouring labels never overlap.
    """
    return rng.uniform(*_COMMON_JITTER) * rng.uniform(*_OWN_JITTER, size=CANDIDATES)


def sizes_m(
    family: str, split: str, labels: Int64[np.ndarray, "3"], jitter: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "3"]:
    """Size of each candidate in metres, for known `family` and a `split` it supports."""
    rungs = np.asarray(FAMILIES[family].rungs_m)
    return rungs[FIRST_RUNG[split] + labels] * jitter
