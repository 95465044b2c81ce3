"""What child processes do: look at the agent once, then play one scene after another.

`looker` and `Player` are handler factories for `sacil_tasks.workers.run_jobs`. Agents, torch and
ManiSkill are imported only in the children, so that a crash at import is a sentence and the parent
stays light.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from leaderboard.agents import AgentRef
from leaderboard.entry import Entry
from leaderboard.plan import SceneJob
from leaderboard.records import EpisodeRecord
from leaderboard.training import Training, training_behind
from sacil_tasks.files import content_hash, file_sha256


@dataclass(frozen=True, kw_only=True)
class Choice:
    """Which agent, with which weights, for which tasks."""

    agent: AgentRef
    checkpoint: Path | None
    tasks: tuple[str, ...]


@dataclass(frozen=True)
class Look:
    """What loading the agent told."""

    privileged: bool
    checkpoint: str | None
    training: Training | None


@dataclass(frozen=True)
class Player:
    """Plays the episodes of scenes."""

    choice: Choice
    entry: Entry
    videos: Path | None
    """Folder for one video per episode; None for none."""

    def __call__(self) -> Callable[[SceneJob], list[EpisodeRecord]]:
        """Load the agent; the stage is built for the first scene and kept while its task lasts.

        Raises:
            UsageError: the agent cannot be loaded.
        """
        from leaderboard.rollout import SceneRunner  # ManiSkill, in the child only

        policy = self.choice.agent.load(checkpoint=self.choice.checkpoint, tasks=self.choice.tasks)
        return SceneRunner(policy, self.entry, self.videos).play


def looker() -> Callable[[Choice], Look]:
    """Handler of the one job before any simulator starts: a bad checkpoint ends the run there."""
    return look_at


def look_at(choice: Choice) -> Look:
    """Load the agent and say what a record must know about it.

    Raises:
        UsageError: it cannot be loaded.
    """
    policy = choice.agent.load(checkpoint=choice.checkpoint, tasks=choice.tasks)
    weights = getattr(policy, "checkpoint_sha256", None)
    if weights is None and choice.checkpoint is not None:
        weights = hash_of(choice.checkpoint)
    return Look(
        privileged=bool(getattr(policy, "privileged", False)),
        checkpoint=weights,
        training=training_behind(choice.checkpoint, weights),
    )


def hash_of(checkpoint: Path) -> str:
    """SHA-256 of a file, or of names and contents of all files in a folder."""
    if checkpoint.is_file():
        return file_sha256(checkpoint)
    files = sorted(path for path in checkpoint.rglob("*") if path.is_file())
    return content_hash([(str(path.relative_to(checkpoint)), file_sha256(path)) for path in files])
