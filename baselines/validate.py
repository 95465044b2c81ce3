"""How good are a network's keyframes on held-out demos? Needs no simulator.

Every keyframe is predicted from the demo's own observation (teacher forcing). Counts are
reported beside their totals, so rows of several runs can be added up.
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from baselines.agent import Network
from baselines.loader import Loader
from baselines.rotation import multiply
from baselines.samples import Sample, Shard
from baselines.views import base_from_cube
from sacil_tasks.aim import nearest

ROTATION_DEG = 5.0
"""A rotation is right within one bin."""


@dataclass(frozen=True)
class Score:
    """One predicted keyframe against the demo's."""

    group: tuple[str, str]
    """Task, and the size words of its instruction."""

    choice: bool
    """Whether the words decide here (`Shard.choices`)."""
    position_mm: float
    rotation_deg: float
    gripper_right: bool
    selected: bool | None
    """Whether the candidate reached for is the right one; None where none is meant."""


def validate(network: Network, loader: Loader, *, batch: int = 16) -> dict[str, Any]:
    """Scores of `network` (in eval mode) over all keyframes of `loader`, by task and size."""
    samples = loader.keyframes.everything()
    groups = defaultdict(list)
    for start in range(0, len(samples), batch):
        for score in _score_batch(network, loader, samples[start : start + batch]):
            for name in ("all", score.group[0], "/".join(score.group)):
                groups[name].append(score)
    return {name: summary(groups[name]) for name in sorted(groups)}


def summary(scores: Sequence[Score]) -> dict[str, Any]:
    """Medians and counts of some scores."""
    meant = [score for score in scores if score.selected is not None]
    return {
        "keyframes": len(scores),
        "position_mm": round(float(np.median([s.position_mm for s in scores])), 2),
        "rotation_within_5deg": sum(s.rotation_deg <= ROTATION_DEG for s in scores),
        "gripper_right": sum(s.gripper_right for s in scores),
        "selected_by_words": _tally([s for s in meant if s.choice]),
        "selected_by_hand": _tally([s for s in meant if not s.choice]),
    }


def _tally(scores: Sequence[Score]) -> tuple[int, int]:
    """Right selections, of how many."""
    return sum(bool(score.selected) for score in scores), len(scores)


@torch.no_grad()
def _score_batch(network: Network, loader: Loader, samples: list[Sample]) -> Iterator[Score]:
    batch = loader.plain(samples)
    chosen = network.act(batch.inputs)
    right = chosen.gripper_open.long() == batch.labels.gripper_open
    for i, sample in enumerate(samples):
        shard = loader.keyframes.shards[sample.shard]
        asked = shard.columns["keyframe_in_base"][sample.row]
        reached = base_from_cube(chosen.position_in_cube[i]).numpy()
        words = shard.episodes[loader.keyframes.episode(sample)].slots.values()
        yield Score(
            group=(shard.task, "+".join(words)),
            choice=sample.row in shard.choices(loader.keyframes.episode(sample)),
            position_mm=1000 * float(np.linalg.norm(reached - asked[:3])),
            rotation_deg=grip_angle_deg(chosen.quaternion_wxyz[i].numpy(), asked[3:]),
            gripper_right=bool(right[i]),
            selected=_selected(shard, sample.row, reached),
        )


def _selected(shard: Shard, row: int, reached: Float[np.ndarray, "3"]) -> bool | None:
    candidates, target = shard.columns["candidate_in_base"][row], shard.columns["target_index"][row]
    if target < 0 or nearest(candidates, shard.columns["keyframe_in_base"][row, :3]) != target:
        return None
    return nearest(candidates, reached) == target


def grip_angle_deg(first: Float[np.ndarray, "4"], second: Float[np.ndarray, "4"]) -> float:
    """Angle between two grasps: q and -q are one, and so are the twins half a turn apart."""
    twin = multiply(first, np.array([0.0, 0.0, 0.0, 1.0]))
    cosine = max(abs(first @ second), abs(twin @ second))
    return float(np.degrees(2 * np.arccos(min(cosine, 1.0))))
