"""A number of episodes -> which episodes, and in which order workers get them.

Episode i of a task is scene i // V with words i % V, where V is the task's number of variations.
The words of one scene stay together, so that its worker plans and accepts the scene once
(D-episodes).
"""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import groupby

from leaderboard.records import EpisodeKey
from sacil_tasks.catalog import task_spec
from sacil_tasks.errors import UsageError
from sacil_tasks.instructions import variations


@dataclass(frozen=True)
class SceneJob:
    """The episodes of one scene: what a worker is given at a time."""

    keys: tuple[EpisodeKey, ...]

    def singly(self) -> list["SceneJob"]:
        """The same episodes as jobs of their own: one of them killed the worker."""
        return [SceneJob((key,)) for key in self.keys]


def words_per_scene(task: str, split: str) -> int:
    """How many episodes a scene is."""
    return len(variations(task_spec(task), split))


def whole_scenes(task: str, split: str, episodes: int) -> int:
    """`episodes` rounded up, so that every scene is met under all of its words."""
    return -(-episodes // words_per_scene(task, split)) * words_per_scene(task, split)


def plan_episodes(
    pairs: Iterable[tuple[str, str]], partition: str, scene_set: int, episodes: int
) -> list[EpisodeKey]:
    """Keys of at least `episodes` episodes for each pair of a task and a split that it has.

    Raises:
        UsageError: the number is not positive.
    """
    if episodes < 1:
        raise UsageError(f"--episodes must be at least 1, but {episodes} came.")
    return [
        EpisodeKey(task, split, partition, scene_set, *divmod(i, words_per_scene(task, split)))
        for task, split in pairs
        for i in range(whole_scenes(task, split, episodes))
    ]


def scene_jobs(keys: Iterable[EpisodeKey]) -> list[SceneJob]:
    """Consecutive keys of the same scene as one job."""
    return [SceneJob(tuple(group)) for _, group in groupby(keys, key=lambda key: key[:-1])]
