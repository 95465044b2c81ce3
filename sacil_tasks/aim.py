"""Which object a keyframe is meant for, told from where it is. Pure; needs no simulator."""

import numpy as np
from jaxtyping import Float

REACH_M = 0.06
"""A keyframe this close to an object, seen from above, is meant for it."""


def nearest(objects: Float[np.ndarray, "k 3"], position: Float[np.ndarray, "3"]) -> int | None:
    """The object within `REACH_M` of `position` seen from above, or None."""
    distances = np.linalg.norm(objects[:, :2] - position[:2], axis=-1)
    return int(distances.argmin()) if distances.min() <= REACH_M else None
