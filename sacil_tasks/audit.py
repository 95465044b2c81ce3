"""Prove that size is the only cue, and that the tasks can be done: `python -m sacil_tasks.audit`.

oracles    a policy that knows trained sizes is right in every canon scene and in exactly a third
           of the shifted ones; one that goes by rank is right in all scenes of all splits
shortcuts  nothing but images tells the named candidate: not place, colour, segmentation id, actor
           name, text or info; and no scene is solved from the start
looks      other words, the same pixels; any two sizes can be told apart in two views or more
scripts    mistakes made on purpose get the outcome code meant for them
expert     how often the motion planner succeeds, by task, split and size

Finished trials are kept in OUT, so the same command resumes. Exit code 0 only if all holds.
"""

import csv
import json
import os
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, fields
from functools import cache
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import tyro
from tqdm import tqdm

from sacil_tasks import verdicts
from sacil_tasks.catalog import suite_tasks, task_spec
from sacil_tasks.errors import UsageError, run_command
from sacil_tasks.files import (
    atomic_path,
    content_hash,
    file_sha256,
    sole_writer,
    unwritable,
    whole_lines,
)
from sacil_tasks.splits import plan_splits
from sacil_tasks.verdicts import Finding, Row
from sacil_tasks.workers import JobFailure, run_jobs

Check = Literal["oracles", "shortcuts", "looks", "scripts", "expert"]
SizeSplit = Literal["canon", "shift_down", "shift_up"]

TRIALS_FILE, FINDINGS_FILE = "trials.jsonl", "audit.csv"


class Trial(NamedTuple):
    """Some scenes of one check: what a worker is given at a time."""

    check: str
    task: str
    split: str
    start: int
    scenes: int


_PER_TRIAL = {"shortcuts": 100, "looks": 2, "scripts": 1, "expert": 2}


@dataclass(frozen=True, kw_only=True)
class AuditConfig:
    """What to check, and in how many scenes."""

    tasks: tuple[str, ...] = ()
    """Tasks by name; they override the suite."""

    suite: str = "all"
    """A group of tasks: slice, single, dual or all."""

    checks: tuple[Check, ...] = get_args(Check)
    """What to check; without it, everything."""

    splits: tuple[SizeSplit, ...] = ()
    """Size splits that are looked at and played; without it, all that a task has."""

    resets: int = 5000
    """Scenes that the shortcut classifiers see, per task."""

    looks: int = 20
    """Scenes to render under all words, per task and size split."""

    scripts: int = 6
    """Scenes in which to make mistakes on purpose, per task; 6 show every confusion of sizes."""

    scenes: int = 34
    """Scenes for the expert, each under all words, per task and size split."""

    workers: int = min(2, os.cpu_count() or 1)
    """Processes; findings do not depend on it."""

    out: Path = Path("runs", "audit")
    """Folder of trials and findings."""


def main(config: AuditConfig) -> None:
    """Run what is missing, write the findings and print them.

    Raises:
        UsageError: a name or number is wrong, another audit writes there, a trial broke off, or
            something does not hold.
    """
    trials = plan(config)
    with sole_writer(config.out):
        log = TrialLog(config.out)
        failures = _run([trial for trial in trials if trial not in log.rows], log, config.workers)
        found = findings(config, trials, log)
        _write(config.out / FINDINGS_FILE, found)
    print(_table(found))
    print(f"Written: {config.out / FINDINGS_FILE} and {TRIALS_FILE}")
    if failures:
        raise UsageError(
            f"{len(failures)} trials broke off, e.g. {failures[0]}; the others are kept and the "
            "same command tries again."
        )
    if wrong := sum(not finding.holds for finding in found):
        raise UsageError(f"{wrong} of {len(found)} findings do not hold (marked NO above).")


def plan(config: AuditConfig) -> list[Trial]:
    """All trials that the simulator is needed for.

    Raises:
        UsageError: a name or number is wrong, or a task that was named lacks a split.
    """
    if min(config.resets, config.looks, config.scripts, config.scenes, config.workers) < 1:
        raise UsageError("--resets, --looks, --scripts, --scenes and --workers are at least 1.")
    if not config.checks:
        raise UsageError(f"--checks names none. Name some of {', '.join(get_args(Check))}.")
    _size_splits(config)
    counts = {
        "shortcuts": config.resets,
        "looks": config.looks,
        "scripts": config.scripts,
        "expert": config.scenes,
    }
    return [
        Trial(check, task, split, start, min(_PER_TRIAL[check], counts[check] - start))
        for check in counts
        if check in config.checks
        for task in _tasks(config)
        for split in _splits(config, task, check)
        for start in range(0, counts[check], _PER_TRIAL[check])
    ]


def findings(config: AuditConfig, trials: Sequence[Trial], log: "TrialLog") -> list[Finding]:
    """What follows from the rows at hand; oracles are asked here and now."""
    found: list[Finding] = []
    if "oracles" in config.checks:
        for task in _tasks(config):
            found += verdicts.oracle_findings(task, scenes=200)
    groups = defaultdict[tuple[str, str, str], list[Row]](list)
    for trial in trials:
        groups[trial.check, trial.task, trial.split] += log.rows.get(trial, [])
    for (check, task, split), rows in groups.items():
        if rows:
            found += _JUDGES[check](task, split, rows)
    return found


class TrialLog:
    """`trials.jsonl`: one line a finished trial; lines of other code are not counted."""

    def __init__(self, folder: Path) -> None:
        """Read what is there; a line cut off by a kill is run again.

        Raises:
            UsageError: the folder cannot be written.
        """
        self._path = folder / TRIALS_FILE
        self.rows: dict[Trial, list[Row]] = {}
        try:
            folder.mkdir(parents=True, exist_ok=True)
            content = self._path.read_bytes() if self._path.exists() else b""
        except OSError as error:
            raise unwritable(self._path, error) from error
        self._cut(self._read(content))

    def append(self, trial: Trial, rows: list[Row]) -> None:
        """Keep a finished trial.

        Raises:
            UsageError: the disk is full or gone.
        """
        line = json.dumps({"code": code_hash(), "trial": trial, "rows": rows})
        try:
            with self._path.open("a") as stream:
                stream.write(line + "\n")
        except OSError as error:
            raise unwritable(self._path, error) from error
        self.rows[trial] = rows

    def _read(self, content: bytes) -> int:
        """Take in all whole lines; returns how many bytes they are."""
        try:
            whole = whole_lines(content, b'{"code": "')
            for line in map(json.loads, whole.splitlines()):
                if line["code"] == code_hash():
                    self.rows[Trial(*line["trial"])] = line["rows"]
        except (ValueError, KeyError, TypeError) as error:
            raise UsageError(
                f"{self._path} is not a log of this command ({error}). "
                "Move it away or choose another folder with --out."
            ) from error
        return len(whole)

    def _cut(self, length: int) -> None:
        """Only once the file is known to be ours."""
        try:
            with self._path.open("a+b") as stream:
                stream.truncate(length)
        except OSError as error:
            raise unwritable(self._path, error) from error


@cache
def code_hash() -> str:
    """Hash of the package's sources: trials of other code prove nothing."""
    folder = Path(__file__).parent
    sources = sorted(folder.rglob("*.py"))
    return content_hash([(str(it.relative_to(folder)), file_sha256(it)) for it in sources])[:12]


def _run(missing: Sequence[Trial], log: TrialLog, workers: int) -> list[str]:
    """Run trials and log them; returns what broke off and why."""
    failures = []
    bar = tqdm(total=sum(it.scenes for it in missing), unit="scene", disable=None)
    with bar, closing(run_jobs(missing, "sacil_tasks.trials:Auditor", workers)) as results:
        for trial, rows in results:
            bar.set_description(f"{trial.check} {trial.task}")
            if isinstance(rows, JobFailure):
                failures.append(f"{trial.check} {trial.task} {trial.split}: {rows.reason}")
            else:
                log.append(trial, rows)
            bar.update(trial.scenes)
    return failures


def _tasks(config: AuditConfig) -> tuple[str, ...]:
    names = config.tasks or suite_tasks(config.suite)
    return tuple(dict.fromkeys(task_spec(name).name for name in names))


def _splits(config: AuditConfig, task: str, check: str) -> tuple[str, ...]:
    if check in ("shortcuts", "scripts"):
        return ("canon",)
    return tuple(split for name, split in _size_splits(config) if name == task)


def _size_splits(config: AuditConfig) -> list[tuple[str, str]]:
    """Tasks with each of their splits.

    Raises:
        UsageError: a task and a split were named, but the task does not have it.
    """
    specs = [task_spec(name) for name in _tasks(config)]
    names = config.splits or get_args(SizeSplit)
    return plan_splits(specs, names, strict=bool(config.tasks and config.splits))[0]


_JUDGES: dict[str, Callable[[str, str, Sequence[Row]], list[Finding]]] = {
    "shortcuts": lambda task, _, rows: verdicts.shortcut_findings(task, rows),
    "looks": verdicts.look_findings,
    "scripts": verdicts.script_findings,
    "expert": verdicts.expert_findings,
}


def _write(path: Path, found: Sequence[Finding]) -> None:
    with atomic_path(path) as draft, draft.open("w", newline="") as stream:
        names = [field.name for field in fields(Finding)]
        writer = csv.DictWriter(stream, names, lineterminator="\n")
        writer.writeheader()
        writer.writerows(asdict(finding) for finding in found)


def _table(found: Sequence[Finding]) -> str:
    rows = [("check", "task", "split", "what", "measured", "needed", "holds"), *_cells(found)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    )


def _cells(found: Sequence[Finding]) -> Iterator[tuple[str, ...]]:
    for it in found:
        answer = "yes" if it.holds else "NO"
        yield (it.check, it.task, it.split, it.what, it.measured, it.needed, answer)


if __name__ == "__main__":
    run_command(
        lambda: main(tyro.cli(AuditConfig, prog="python -m sacil_tasks.audit", description=__doc__))
    )
