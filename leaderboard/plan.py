"""A number of episodes -> which episodes, and in which order workers get them.

Episode i of a task is scene i // V with words i % V, where V is the task's number of variations.
The words of one scene stay together, so that its worker plans and accepts the scene once
(D-episodes).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby

from leaderboard.records import EpisodeKey
from sacil_tasks.catalog import task_spec
from sacil_tasks.errors import UsageError, find_name
from sacil_tasks.instructions import variations
from sacil_tasks.sizes import SPLITS


@dataclass(frozen=True)
class SceneJob:
    """The episodes of one scene: what a worker is given at a time."""

    keys: tuple[EpisodeKey, ...]

    def singly(self) -> list["SceneJob"]:
        """The same episodes as jobs of their own: one of them killed the worker."""
        return [SceneJob((key,)) for key in self.keys]


def whole_scenes(task: str, episodes: int) -> int:
    """`episodes` rounded up, so that every scene is met under all of its words."""
    per_scene = len(variations(task_spec(task)))
    return -(-episodes // per_scene) * per_scene


def plan_episodes(
    tasks: Sequence[str], splits: Sequence[str], partition: str, scene_set: int, episodes: int
) -> list[EpisodeKey]:
    """Keys of at least `episodes` episodes for each task and split.

    Raises:
        UsageError: a name is unknown, a task has no such split, or the number is not positive.
    """
    if episodes < 1:
        raise UsageError(f"--episodes must be at least 1, but {episodes} came.")
    for split in splits:
        find_name(split, SPLITS, "split")
    for task in tasks:
        _check_splits(task, splits)
    return [
        EpisodeKey(task, split, partition, scene_set, *divmod(i, len(variations(task_spec(task)))))
        for task in dict.fromkeys(tasks)
        for split in dict.fromkeys(splits)
        for i in range(whole_scenes(task, episodes))
    ]


def scene_jobs(keys: Iterable[EpisodeKey]) -> list[SceneJob]:
    """Consecutive keys of the same scene as one job."""
    return [SceneJob(tuple(group)) for _, group in groupby(keys, key=lambda key: key[:-1])]


def _check_splits(task: str, splits: Sequence[str]) -> None:
    supported = task_spec(task).splits
    missing = [split for split in splits if split not in supported]
    if missing:
        raise UsageError(
            f"{task} has the splits {', '.join(supported)}, but not {', '.join(missing)}: "
            "its largest size would not fit the gripper. Leave the task or the split out."
        )
