"""Can the named candidate be guessed from what must not tell it? A classifier that tries. Pure.

For each scene the classifier scores the three candidates by some of their features, crossed with
the word that was said, and takes the best. It is fitted on one half of the scenes and judged on
the other, both ways: at chance it is right in a third of them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from sacil_tasks.sizes import CANDIDATES, LABELS

ERRORS_ALLOWED = 4.0
"""Standard errors that chance is allowed: it exceeds them once in 16,000 tries."""

_RIDGE = 1.0
_NEWTON_STEPS = 8


@dataclass(frozen=True)
class Scenes:
    """What was seen in many scenes, candidates in the order of their index."""

    sentences: Sequence[str]
    asked: Int64[np.ndarray, "n s"]
    """Label named in each slot."""

    targets: Int64[np.ndarray, "n s"]
    """Candidate named in each slot."""

    xy_m: Float64[np.ndarray, "n 3 2"]
    yaw_rad: Float64[np.ndarray, "n 3"]
    rgb: Float64[np.ndarray, "n 3 3"]
    ids: Float64[np.ndarray, "n 3"]
    """Segmentation id of each candidate: also the order in which they were made."""

    shared: Float64[np.ndarray, "n k"]
    """Numbers of `info` and of the observation's extras, which belong to no candidate."""


def guesses(scenes: Scenes) -> dict[str, list[float]]:
    """Kind of feature -> share of right guesses, slot by slot."""
    kinds = _features(scenes)
    return {
        name: [
            cross_fitted_accuracy(_crossed(features, words), scenes.targets[:, slot])
            for slot, words in enumerate(_words(scenes, name))
        ]
        for name, features in kinds.items()
    }


def limit(scenes: int) -> float:
    """How far from a third the share of right guesses may be."""
    return ERRORS_ALLOWED * float(np.sqrt(2 / 9 / scenes))


def cross_fitted_accuracy(
    features: Float64[np.ndarray, "n 3 d"], targets: Int64[np.ndarray, "n"]
) -> float:
    """Right guesses in both halves, each guessed by what was learnt from the other."""
    order = np.arange(len(targets))
    right = 0
    for half in (order % 2 == 0, order % 2 == 1):
        weights = _fit(features[half], targets[half])
        right += int((np.argmax(features[~half] @ weights, axis=1) == targets[~half]).sum())
    return right / len(targets)


def _fit(
    features: Float64[np.ndarray, "n 3 d"], targets: Int64[np.ndarray, "n"]
) -> Float64[np.ndarray, "d"]:
    """Weights of a conditional logit model, by Newton's method with a ridge."""
    weights = np.zeros(features.shape[-1])
    chosen = features[np.arange(len(targets)), targets].sum(0)
    for _ in range(_NEWTON_STEPS):
        scores = features @ weights
        odds = np.exp(scores - scores.max(axis=1, keepdims=True))
        odds /= odds.sum(axis=1, keepdims=True)
        means = np.einsum("nk,nkd->nd", odds, features)
        gradient = chosen - means.sum(0) - _RIDGE * weights
        weighted = features * np.sqrt(odds)[..., None]
        flat = weighted.reshape(-1, features.shape[-1])
        hessian = flat.T @ flat - means.T @ means + _RIDGE * np.eye(len(weights))
        weights = weights + np.linalg.solve(hessian, gradient)
    return weights


def _features(scenes: Scenes) -> Mapping[str, Float64[np.ndarray, "n 3 d"]]:
    index = np.broadcast_to(np.eye(CANDIDATES), (len(scenes.targets), CANDIDATES, CANDIDATES))
    x, y = scenes.xy_m[..., 0], scenes.xy_m[..., 1]
    reach_m = np.linalg.norm(scenes.xy_m - scenes.xy_m.mean((0, 1)), axis=-1)
    place = [x, y, x * x, y * y, x * y, reach_m, np.cos(scenes.yaw_rad), np.sin(scenes.yaw_rad)]
    ranks = [_rank_flags(values) for values in (x, y, reach_m)]
    shared = _standard(scenes.shared)
    return {
        "position": np.concatenate([_standard(np.stack(place, -1)), *ranks], -1),
        "colour": np.concatenate([scenes.rgb, scenes.rgb**2], -1),
        "segmentation id": np.concatenate(
            [_standard(scenes.ids[..., None]), _rank_flags(scenes.ids)], -1
        ),
        "actor name": index,
        "text": index,
        "info and extras": (index[..., None] * shared[:, None, None]).reshape(
            len(shared), CANDIDATES, -1
        ),
    }


def _words(scenes: Scenes, kind: str) -> list[Float64[np.ndarray, "n w"]]:
    """What is crossed with the features: the word of each slot, or the sentence for `text`."""
    if kind != "text":
        return [np.eye(len(LABELS))[labels] for labels in scenes.asked.T]
    known = sorted(set(scenes.sentences))
    numbers = np.array([known.index(sentence) for sentence in scenes.sentences])
    return [np.eye(len(known))[numbers]] * scenes.asked.shape[1]


def _crossed(
    features: Float64[np.ndarray, "n 3 d"], words: Float64[np.ndarray, "n w"]
) -> Float64[np.ndarray, "n 3 e"]:
    crossed = features[..., None, :] * words[:, None, :, None]
    return crossed.reshape(*features.shape[:2], -1)


def _standard(values: np.ndarray) -> np.ndarray:
    """Mean 0 and deviation 1 over all but the last axis; constants become 0."""
    axes = tuple(range(values.ndim - 1))
    spread = values.std(axis=axes)
    return np.where(spread > 0, values - values.mean(axis=axes), 0) / np.where(
        spread > 0, spread, 1
    )


def _rank_flags(values: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3 3"]:
    """Which of the three is the lowest, the middle and the highest."""
    return np.eye(CANDIDATES)[values.argsort(axis=1).argsort(axis=1)]
