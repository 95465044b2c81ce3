"""One line of JSON per episode, appended as it ends and found again by its key.

`episodes.jsonl` is append-only. A process killed in the middle of a write leaves half a line; the
next one drops it and that episode runs again. `manifest.json` beside it says what the run is.
"""

import fcntl
import json
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self, TypeAlias

from pydantic import NonNegativeFloat, NonNegativeInt, PositiveFloat

from sacil_tasks.errors import UsageError
from sacil_tasks.files import unwritable, whole_lines
from sacil_tasks.outcomes import OUTCOMES
from sacil_tasks.typed import parsed

SCHEMA_VERSION = 1
EPISODES_FILE = "episodes.jsonl"

Labels: TypeAlias = tuple[str, ...]
"""Labels of sizes, in some order."""

ERROR = "ERROR"
"""Outcome of an episode that broke off; the other outcomes are those of `sacil_tasks.outcomes`."""

SUCCEEDED, LIMIT, INVALID_ACTION, BROKE_OFF = "success", "limit", "invalid_action", "error"
"""Why an episode ended: first lenient success, keyframes spent, action refused, exception."""
ENDS = (SUCCEEDED, LIMIT, INVALID_ACTION, BROKE_OFF)


_LATER = {"aimed"}
"""Fields that older records lack."""


class EpisodeKey(NamedTuple):
    """Which episode: the same key is the same scene and the same words, for every agent."""

    task: str
    split: str
    partition: str
    scene_set: int
    scene: int
    variation: int


@dataclass(frozen=True, kw_only=True)
class Seconds:
    """Where the time of an episode went; never part of a comparison of results."""

    total: NonNegativeFloat = 0.0
    setup: NonNegativeFloat = 0.0
    """Building the scene."""
    planning: NonNegativeFloat = 0.0
    """Of the policy's keyframes and, for a scene's first words, of the expert's under all words."""
    physics: NonNegativeFloat = 0.0
    rendering: NonNegativeFloat = 0.0
    inference: NonNegativeFloat = 0.0


@dataclass(frozen=True, kw_only=True)
class EpisodeRecord:
    """What happened in one episode. Everything but `seconds` and `renderer` is reproducible."""

    task: str
    split: str
    partition: str
    scene_set: NonNegativeInt
    scene: NonNegativeInt
    """Index of the scene within its task, partition and scene set."""
    variation: NonNegativeInt
    """Index of the words within the scene."""

    agent: str
    privileged: bool
    """The agent reads the simulator's state: a ceiling or a floor, not a contender."""
    checkpoint: str | None
    """SHA-256 of the weights, if there are any."""
    protocol: str
    """Hash of the `EvalProtocol`."""

    instruction: str = ""
    slots: Mapping[str, str]
    """The words filled into the instruction."""
    sizes_m: tuple[PositiveFloat, ...] = ()
    """Sizes of candidates 0, 1, 2."""
    fingerprint: str = ""
    """Hash of geometry, poses and words: equal on every machine."""
    pixels: str = ""
    """Hash of the first images; it may differ between renderers."""
    renderer: str = ""

    outcome: str
    """Why it ended as it did: an outcome code of `sacil_tasks.outcomes`, or `ERROR`."""
    success: bool = False
    """Strict: the named candidates only."""
    success_lenient: bool = False
    """The task's own predicate."""
    asked: Labels = ()
    """Size labels named, in order."""
    handled: Labels = ()
    """Size labels of the candidates acquired or pressed, in order; empty if none was."""
    aimed: str | None = None
    """Label of the candidate (or `clutter`) under the first keyframe that closes the gripper near
    one; empty if there was none, None in records written before this was noted."""
    end: str
    """`success`, `limit`, `invalid_action` or `error`."""
    reason: str = ""
    """Why an action was refused, or the error's text."""
    keyframes: NonNegativeInt = 0
    """Keyframes executed."""

    seconds: Seconds = Seconds()
    schema_version: int = SCHEMA_VERSION

    @property
    def key(self) -> EpisodeKey:
        """What resuming and pairing go by."""
        return EpisodeKey(*(getattr(self, name) for name in EpisodeKey._fields))

    @property
    def errored(self) -> bool:
        """Whether the episode broke off; it still counts as a failure."""
        return self.end == BROKE_OFF

    def to_json(self) -> str:
        """One line."""
        return json.dumps(asdict(self), separators=(",", ":"))

    @classmethod
    def from_json(cls, line: str) -> Self:
        """The record of one line.

        Raises:
            ValueError: not a record of this schema.
        """
        content = json.loads(line)
        if not isinstance(content, dict) or content.get("schema_version") != SCHEMA_VERSION:
            raise ValueError(f"expected an object with schema_version {SCHEMA_VERSION}")
        names = {field.name for field in fields(cls)}
        if wrong := (names ^ content.keys()) - (_LATER - content.keys()):
            raise ValueError(f"wrong or missing fields: {sorted(wrong)}")
        record = parsed(cls, line)
        if not record.consistent:
            raise ValueError(
                f"outcome {record.outcome}, end {record.end}, success {record.success} (lenient "
                f"{record.success_lenient}), asked {record.asked} and handled {record.handled} "
                "contradict each other"
            )
        return record

    @property
    def consistent(self) -> bool:
        """Whether verdict, outcome code, end and what was handled can stand beside each other."""
        return (
            self.outcome in (*OUTCOMES, ERROR)
            and self.success == (self.outcome == OUTCOMES[0])
            and self.success_lenient == (self.end == SUCCEEDED)
            and self.errored == (self.outcome == ERROR)
            and self.success_lenient >= self.success
            and self.end in ENDS
            and self._handled_fits
        )

    @property
    def _handled_fits(self) -> bool:
        """Whether what was handled allows the outcome code."""
        match self.outcome:
            case "SUCCESS":
                return set(self.handled) <= set(self.asked)
            case "ORDER_ERROR":
                return self.handled != self.asked[: len(self.handled)]
            case "NO_INTERACTION":
                return not self.handled
        return True


class EpisodeLog:
    """`episodes.jsonl`, open for appending by one process at a time."""

    def __init__(self, folder: Path) -> None:
        """Open, or create, the log in `folder`, and drop a line that was cut off.

        Raises:
            UsageError: the folder cannot be written, another run is writing there, or the file
                is not ours.
        """
        path = folder / EPISODES_FILE
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._stream = path.open("a+b", buffering=0)
        except OSError as error:
            raise unwritable(path, error) from error
        try:
            fcntl.flock(self._stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise UsageError(
                f"another run is writing {path}. Wait for it or choose another folder with --out."
            ) from error
        self.path = path
        self.records = read_records(path)
        self._drop_cut_line()

    def append(self, record: EpisodeRecord) -> None:
        """Write one line to disk.

        Raises:
            UsageError: the disk is full or gone.
        """
        line = record.to_json().encode() + b"\n"
        try:
            # An unbuffered write may be short on a full disk; the rest then says why.
            written = self._stream.write(line)
            while written < len(line):
                written += self._stream.write(line[written:])
        except OSError as error:
            raise unwritable(self.path, error) from error
        self.records.append(record)

    def _drop_cut_line(self) -> None:
        self._stream.seek(0)
        try:
            whole = whole_lines(self._stream.read(), b'{"task":"')
        except ValueError as error:  # a foreign file is left as it is
            raise UsageError(
                f"{self.path} is no episode log: {error}. Move it away, or choose another folder."
            ) from error
        self._stream.truncate(len(whole))

    def __enter__(self) -> Self:
        """Nothing to do: opening is the constructor's."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close and unlock."""
        self._stream.close()


def read_records(path: Path) -> list[EpisodeRecord]:
    """All records of a log, in the order written; a cut last line is left out.

    Raises:
        UsageError: a line is not a record, or a key occurs twice.
    """
    try:
        lines = path.read_text(encoding="utf-8").split("\n")[:-1]
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"cannot read {path} as an episode log: {error}.") from error
    records = [_parse(path, number, line) for number, line in enumerate(lines, start=1)]
    if len({record.key for record in records}) < len(records):
        raise UsageError(f"{path} holds an episode twice; it was not written by one run.")
    return records


def _parse(path: Path, number: int, line: str) -> EpisodeRecord:
    try:
        return EpisodeRecord.from_json(line)
    except (ValueError, RecursionError) as error:
        raise UsageError(
            f"{path} line {number} is not an episode record of schema {SCHEMA_VERSION} ({error}). "
            "The file is damaged or foreign: move it away, or choose another folder."
        ) from error


def reproducible(records: Iterable[EpisodeRecord]) -> dict[EpisodeKey, dict[str, Any]]:
    """What must be equal however many workers played the episodes, by key."""
    return {
        record.key: {name: value for name, value in asdict(record).items() if name != "seconds"}
        for record in records
    }


def doubts(records: Sequence[EpisodeRecord]) -> list[str]:
    """Reasons to distrust the images of a run, one sentence each."""
    seen = [record for record in records if record.pixels]
    found = []
    renderers = sorted({record.renderer for record in seen})
    if len(renderers) > 1:
        found.append(f"images come from different renderers: {'; '.join(renderers)}.")
    by_scene = defaultdict[tuple[Any, ...], set[str]](set)
    for record in seen:
        by_scene[(*record.key[:-1], record.renderer)].add(record.pixels)
    if unstable := sum(len(images) > 1 for images in by_scene.values()):
        found.append(f"{unstable} scenes did not look the same under all of their words.")
    return found
