"""How good are a network's keyframes on held-out demos? Needs no simulator.

Every keyframe is predicted from the demo's own observation (teacher forcing), so what is chosen
is judged apart from how well the arm gets there. Counts are reported beside their totals, so rows
of several runs can be added up. `python -m baselines.validate --agent sacil --split shift_down`
scores a trained agent on the demos of any split.
"""

import json
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
from jaxtyping import Float

from baselines import checkpoint
from baselines.agent import Network
from baselines.batch import moved
from baselines.checkpoint import find_released
from baselines.loader import Loader
from baselines.rotation import multiply
from baselines.samples import KeyframeSet, Sample, Shard
from baselines.scene.views import base_from_cube
from sacil_tasks.aim import nearest
from sacil_tasks.catalog import task_names, task_spec
from sacil_tasks.errors import UsageError, run_command
from sacil_tasks.sizes import LABELS
from sacil_tasks.splits import check_split

ROTATION_DEG = 5.0
"""A rotation is right within one bin."""


@dataclass(frozen=True, kw_only=True)
class ValidateConfig:
    """Score a trained agent on demos, without a simulator."""

    agent: str = "sacil"
    """Name of the agent, `name` or `name:variant`."""

    checkpoint: Path | None = None
    """Folder with trained weights; without it, the agent's released ones."""

    tasks: tuple[str, ...] = ("pick_and_lift", "pick_up_cup", "push_buttons")
    """Tasks by name."""

    data: Path = Path("data")
    """Folder of all data."""

    split: str = "canon"
    """Split of the demos."""

    partition: Literal["val", "train"] = "val"
    """Scenes of the demos."""


def main(config: ValidateConfig) -> None:
    """Print the scores of each task.

    Raises:
        UsageError: a task or split is unknown, or a checkpoint or keyframes are missing, damaged
            or do not fit.
    """
    if not config.tasks:
        raise UsageError(f"--tasks names none. Name some of {', '.join(task_names())}.")
    for task in config.tasks:
        check_split(task_spec(task), config.split)
    folder = config.checkpoint or find_released(config.agent, config.tasks)
    trained = checkpoint.load(folder, agent=config.agent, tasks=config.tasks)
    keyframes = KeyframeSet.load(
        config.data / config.split / config.partition / "keyframes", config.tasks
    )
    loader = Loader(
        keyframes,
        trained.text,
        sight=trained.network.sight,
        recipe=trained.identity.config.recipe,
        seed=0,
    )
    for name, scores in validate(trained.network, loader).items():
        if "/" not in name:
            print(name, json.dumps(scores))


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
    slot: int
    """How many candidates have been handled before."""
    asked: str
    """Size of the candidate that is meant; empty where none is."""
    took: str
    """Size of the candidate reached for; empty where none is near."""

    @property
    def selected(self) -> bool | None:
        """Whether the candidate reached for is the right one; None where none is meant."""
        return self.asked == self.took if self.asked else None


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
        **{
            f"selected_in_slot_{slot + 1}": _tally(
                [s for s in meant if s.choice and s.slot == slot]
            )
            for slot in sorted({s.slot for s in meant if s.choice})
        },
        "took_when_asked": {
            asked: [sum(s.took == took for s in group) for took in LABELS]
            for asked in LABELS
            if (group := [s for s in meant if s.choice and s.asked == asked])
        },
    }


def _tally(scores: Sequence[Score]) -> tuple[int, int]:
    """Right selections, of how many."""
    return sum(bool(score.selected) for score in scores), len(scores)


@torch.no_grad()
def _score_batch(network: Network, loader: Loader, samples: list[Sample]) -> Iterator[Score]:
    batch = loader.plain(samples)
    chosen = moved(network.act(moved(batch.inputs, network.device)), torch.device("cpu"))
    right = chosen.gripper_open.long() == batch.labels.gripper_open
    for i, sample in enumerate(samples):
        shard = loader.keyframes.shards[sample.shard]
        asked = shard.columns["keyframe_in_base"][sample.row]
        reached = base_from_cube(chosen.position_in_cube[i]).numpy()
        episode = loader.keyframes.episode(sample)
        words, choices = shard.episodes[episode].slots.values(), shard.choices(episode)
        meant, took = _choices(shard, sample.row, reached)
        yield Score(
            group=(shard.task, "+".join(words)),
            choice=sample.row in choices,
            slot=sum(row < sample.row for row in choices[1:]) + (sample.row in choices[1:]),
            position_mm=1000 * float(np.linalg.norm(reached - asked[:3])),
            rotation_deg=grip_angle_deg(chosen.quaternion_wxyz[i].numpy(), asked[3:]),
            gripper_right=bool(right[i]),
            asked=meant,
            took=took,
        )


def _choices(shard: Shard, row: int, reached: Float[np.ndarray, "3"]) -> tuple[str, str]:
    """Sizes of the candidates that the demo and the network reach for; empty for none."""
    candidates, target = shard.columns["candidate_in_base"][row], shard.columns["target_index"][row]
    sizes_m = shard.episodes[shard.columns["episode_id"][row]].sizes_m
    labels = [LABELS[rank] for rank in np.argsort(np.argsort(sizes_m))]
    if target < 0 or nearest(candidates, shard.columns["keyframe_in_base"][row, :3]) != target:
        return "", ""
    found = nearest(candidates, reached)
    return labels[target], "" if found is None else labels[found]


def grip_angle_deg(first: Float[np.ndarray, "4"], second: Float[np.ndarray, "4"]) -> float:
    """Angle between two grasps: q and -q are one, and so are the twins half a turn apart."""
    twin = multiply(first, np.array([0.0, 0.0, 0.0, 1.0]))
    cosine = max(abs(first @ second), abs(twin @ second))
    return float(np.degrees(2 * np.arccos(min(cosine, 1.0))))


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(ValidateConfig, description=__doc__)))
