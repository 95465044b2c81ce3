"""Run folders -> who did what on each task, checked so that a table can rely on it.

A `Score` is all episodes that one set of weights played of one task. The same episode found in two
folders (a copied run) counts once; two that disagree are an error.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from leaderboard.manifest import MANIFEST_FILE, Manifest, read_manifest
from leaderboard.protocol import protocol_name, protocol_of
from leaderboard.records import EPISODES_FILE, EpisodeKey, EpisodeRecord, read_records
from leaderboard.stats import Tally
from leaderboard.training import Training, training_behind
from sacil_tasks.errors import UsageError


@dataclass(frozen=True)
class EvalRun:
    """One folder of `python -m leaderboard.run`."""

    folder: Path
    manifest: Manifest
    records: Sequence[EpisodeRecord]


@dataclass(frozen=True, kw_only=True)
class Scope:
    """Which episodes a table is about; others never enter it."""

    partition: str
    split: str
    scene_set: int

    def holds(self, record: EpisodeRecord) -> bool:
        """Whether a record belongs here."""
        found = (record.partition, record.split, record.scene_set)
        return found == (self.partition, self.split, self.scene_set)


@dataclass(kw_only=True)
class Score:
    """The episodes of one set of weights on one task; filled run by run."""

    agent: str
    privileged: bool
    task: str
    checkpoint: str | None
    protocol: str
    training: Training | None
    test_runs: int
    """How often these weights have met the test."""

    records: dict[EpisodeKey, EpisodeRecord] = field(default_factory=dict)
    folders: list[Path] = field(default_factory=list)

    @property
    def tally(self) -> Tally:
        """Strict successes among episodes."""
        return Tally.of(record.success for record in self.records.values())

    @property
    def seed(self) -> int | None:
        """Training seed; None if the weights do not say."""
        return self.training.seed if self.training else None

    def add(self, run: EvalRun, record: EpisodeRecord) -> None:
        """Take an episode in.

        Raises:
            UsageError: another folder has it with another result.
        """
        known = self.records.setdefault(record.key, record)
        if (known.success, known.outcome) != (record.success, record.outcome):
            raise UsageError(
                f"{self.folders[0]} and {run.folder} hold episode {record.key} of the same "
                f"{self.agent} with different results. Name one of them with --runs."
            )
        if run.folder not in self.folders:
            self.folders.append(run.folder)
            self.test_runs = max(self.test_runs, run.manifest.test_runs)


def find_runs(places: Iterable[Path]) -> list[EvalRun]:
    """Read every run folder at or under `places`, ordered by path; empty ones are left out.

    Raises:
        UsageError: a place does not exist or holds no run, or a run is damaged.
    """
    folders = [folder for place in places for folder in _folders(place)]
    found = {folder.resolve(): folder for folder in folders}
    runs = [_read(folder) for folder in found.values()]
    return [run for run in runs if run.records]


def collect(runs: Iterable[EvalRun], scope: Scope) -> list[Score]:
    """Group the episodes of a scope by weights and task.

    Raises:
        UsageError: two folders disagree on an episode.
    """
    scores: dict[tuple[str, ...], Score] = {}
    for run in runs:
        for record in filter(scope.holds, run.records):
            name = (record.agent, record.task, record.checkpoint or "", record.protocol)
            if name not in scores:
                scores[name] = _started(run, record)
            scores[name].add(run, record)
    return list(scores.values())


def protocols(scores: Iterable[Score]) -> dict[str, str]:
    """The one protocol that a table may show of each task: this code's if any run has it, else the
    one that all runs have.

    Raises:
        UsageError: runs of a task follow different protocols, none of them this code's.
    """
    by_task = defaultdict[str, list[Score]](list)
    for score in scores:
        by_task[score.task].append(score)
    return {task: _protocol(group) for task, group in by_task.items()}


def outdated(followed: Mapping[str, str], scope: Scope) -> list[str]:
    """Tasks whose protocol is not this code's."""
    return [
        task
        for task, protocol in followed.items()
        if protocol != protocol_of(task, scope.partition, scope.scene_set, scope.split).hash
    ]


def check_scenes(scores: Iterable[Score]) -> None:
    """Agents may be compared only if a key was the same scene for all of them.

    Raises:
        UsageError: names two folders that differ.
    """
    shown: dict[EpisodeKey, tuple[str, Score]] = {}
    for score in scores:
        for key, record in score.records.items():
            if not record.fingerprint:
                continue  # it broke off before the scene stood
            fingerprint, first = shown.setdefault(key, (record.fingerprint, score))
            if fingerprint != record.fingerprint:
                raise UsageError(
                    f"{first.folders[0]} and {score.folders[0]} met different scenes as {key}. "
                    "They were played by different code: play one of them again."
                )


def _folders(place: Path) -> Iterator[Path]:
    if not place.is_dir():
        raise UsageError(f"there is no folder {place}; --runs names folders of leaderboard.run.")
    names = (MANIFEST_FILE, EPISODES_FILE)
    found = sorted({path.parent for name in names for path in place.rglob(name)})
    if not found:
        raise UsageError(
            f"no run in {place}: expected {MANIFEST_FILE} and {EPISODES_FILE} in it or below. "
            "Make one with `python -m leaderboard.run --agent NAME`."
        )
    yield from found


def _read(folder: Path) -> EvalRun:
    manifest = read_manifest(folder)
    log = folder / EPISODES_FILE
    if manifest is None or not log.is_file():
        raise UsageError(f"{folder} is half a run: expected {MANIFEST_FILE} and {EPISODES_FILE}.")
    records = read_records(log)
    for number, record in enumerate(records, start=1):
        wrong = _foreign(manifest, record)
        if wrong:
            raise UsageError(
                f"{log} line {number} is not of the run in {MANIFEST_FILE}: its {wrong} differs. "
                "The folder was mixed by hand: restore it, or play it again."
            )
    return EvalRun(folder, manifest, records)


def _foreign(manifest: Manifest, record: EpisodeRecord) -> str | None:
    """Name of a field in which a record is not of its manifest."""
    for name in ("agent", "privileged", "checkpoint", "partition", "scene_set"):
        if getattr(manifest, name) != getattr(record, name):
            return name
    protocol = manifest.protocols.get(protocol_name(record.task, record.split), {})
    return None if protocol.get("hash") == record.protocol else "protocol"


def _started(run: EvalRun, record: EpisodeRecord) -> Score:
    return Score(
        agent=record.agent,
        privileged=record.privileged,
        task=record.task,
        checkpoint=record.checkpoint,
        protocol=record.protocol,
        training=run.manifest.training or training_behind(None, record.checkpoint),
        test_runs=run.manifest.test_runs,
    )


def _protocol(scores: Sequence[Score]) -> str:
    found = {score.protocol for score in scores}
    if len(found) == 1:
        return found.pop()
    key = next(iter(scores[0].records))
    ours = protocol_of(key.task, key.partition, key.scene_set, key.split).hash
    if ours in found:
        return ours
    folders = {score.protocol: str(score.folders[0]) for score in scores}
    raise UsageError(
        f"runs of {key.task} follow different protocols ("
        + ", ".join(f"{protocol}: {folder}" for protocol, folder in sorted(folders.items()))
        + f"), and none this code's ({ours}). Name runs of one protocol with --runs."
    )
