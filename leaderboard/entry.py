"""Who is evaluated under which rules: the part of a record that is known before its episode."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from leaderboard.protocol import protocol_name
from leaderboard.records import BROKE_OFF, ERROR, EpisodeKey, EpisodeRecord
from sacil_tasks.catalog import task_spec
from sacil_tasks.instructions import variations


@dataclass(frozen=True, kw_only=True)
class Entry:
    """An agent on the leaderboard."""

    agent: str
    """Its name as typed."""

    privileged: bool
    """It reads the simulator's state: a ceiling or a floor, not a contender."""

    checkpoint: str | None
    """SHA-256 of its weights; None for agents without."""

    protocols: Mapping[str, str]
    """Short hash of the `EvalProtocol` of each task, or of task and split (`protocol_name`)."""

    def identity(self, key: EpisodeKey) -> dict[str, Any]:
        """Fields of the record of `key` that do not depend on what happens in it."""
        return key._asdict() | {
            "agent": self.agent,
            "privileged": self.privileged,
            "checkpoint": self.checkpoint,
            "protocol": self.protocols[protocol_name(key.task, key.split)],
            "slots": variations(task_spec(key.task), key.split)[key.variation],
        }

    def lost(self, key: EpisodeKey, reason: str) -> EpisodeRecord:
        """The record of an episode that took its worker down."""
        return EpisodeRecord(**self.identity(key), outcome=ERROR, end=BROKE_OFF, reason=reason)
