"""The paper's tables 1 to 5 from whatever runs exist: `python -m leaderboard.tables`.

Each table is written as CSV and as Markdown, rows and columns as in the paper; behind them stand
agents that the paper does not list and the probes (oracle, hold, random, blind). A cell without a
run is empty. `cells.csv` traces each cell to its run, weights, protocol, keyframes and training
seed; `comparisons.csv` holds the paired differences from one row, with interval, test and the
smallest difference that could have been seen; `summary.csv` says of every task, split and partition
how episodes ended.

Rows of a table had equal training: the same samples, preset, text encoder and keyframes. What was
trained otherwise, or played under another protocol, is left out and the row's note says why. Only
episodes of one partition, split and scene set are shown; those of others are never mixed in.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from leaderboard import sheets
from leaderboard.layout import TABLES, Layout
from leaderboard.markdown import markdown
from leaderboard.paired import compare_rows
from leaderboard.panel import build_panel
from leaderboard.records import EpisodeRecord
from leaderboard.scores import (
    EvalRun,
    Scope,
    Score,
    check_scenes,
    collect,
    find_runs,
    outdated,
    protocols,
)
from leaderboard.sheets import Sheet
from leaderboard.summary import summary_text
from sacil_tasks.errors import UsageError, find_name, run_command
from sacil_tasks.files import atomic_path
from sacil_tasks.splits import SPLITS

DEFAULT_RUNS = (Path("results"), Path("runs", "eval"))
"""Where runs are looked for: those kept with the code, and new ones."""


@dataclass(frozen=True, kw_only=True)
class TablesConfig:
    """Which runs to put into tables, and where to write these."""

    runs: tuple[Path, ...] = ()
    """Run folders, or folders that hold some at any depth; without it, `results` and `runs/eval`,
    whichever exist. A run that is found twice counts once."""

    out: Path = Path("results")
    """Folder for the tables."""

    against: str | None = None
    """Agent that the others are compared with, e.g. `rvt`; without it `sacil`, in table 5 `rvt2`.
    A table that does not have it keeps to its own."""

    samples: int | None = None
    """Training budget of the tables' rows, where runs with several are found."""

    partition: Literal["test", "val"] = "test"
    """Tables of `val` are for decisions and named so."""

    split: str = "canon"
    """The paper's tables are `canon`; those of another split are named after it."""

    seed: int = 0
    """Scene set: 0 is the official one."""


def main(config: TablesConfig) -> None:
    """Read all runs, fill all tables, then write them.

    Raises:
        UsageError: a run is missing, damaged or cannot be compared; nothing has been written then.
    """
    scope = _scope(config)
    runs = find_runs(config.runs or _existing(DEFAULT_RUNS))
    scores = _scores(runs, scope)
    _check_budget(scores, config.samples)
    filled = fill(scores, scope, against=config.against, samples=config.samples)
    texts = _texts(filled, _suffix(scope)) | {"summary.csv": summary_text(_all_records(runs))}
    for name, text in texts.items():
        with atomic_path(config.out / name) as draft:
            draft.write_text(text, encoding="utf-8", newline="")
    _report(config, runs, filled)


def fill(
    scores: Sequence[Score], scope: Scope, *, against: str | None = None, samples: int | None = None
) -> list[Sheet]:
    """All five tables.

    Raises:
        UsageError: no row is called `against`, or budgets, protocols or scenes would be mixed.
    """
    if against is not None:
        find_name(against, {row.agent for layout in TABLES for row in layout.rows}, "row")
    followed = protocols(scores)
    check_scenes(score for score in scores if score.protocol == followed[score.task])
    return [_fill(layout, scores, scope, followed, against, samples) for layout in TABLES]


def _fill(
    layout: Layout,
    scores: Sequence[Score],
    scope: Scope,
    followed: Mapping[str, str],
    against: str | None,
    samples: int | None,
) -> Sheet:
    chosen = against if against in {row.agent for row in layout.rows} else None
    first = chosen or layout.against
    panels = {
        suite: build_panel(layout, suite, scores, followed, against=first, samples=samples)
        for suite in layout.suites
    }
    return Sheet(layout, scope, panels, compare_rows(layout, panels, first))


def _scope(config: TablesConfig) -> Scope:
    find_name(config.split, SPLITS, "split")
    return Scope(partition=config.partition, split=config.split, scene_set=config.seed)


def _existing(places: Sequence[Path]) -> list[Path]:
    found = [place for place in places if place.is_dir()]
    if not found:
        raise UsageError(
            f"neither {' nor '.join(map(str, places))} is here. Name folders with --runs, or make "
            "a run with `python -m leaderboard.run --agent NAME`."
        )
    return found


def _scores(runs: Sequence[EvalRun], scope: Scope) -> list[Score]:
    scores = collect(runs, scope)
    if not scores:
        raise UsageError(
            f"none of the {len(runs)} runs found has episodes of partition {scope.partition}, "
            f"split {scope.split}, scene set {scope.scene_set}."
        )
    return scores


def _check_budget(scores: Sequence[Score], samples: int | None) -> None:
    budgets = {score.training.samples for score in scores if score.training}
    if samples is not None and samples not in budgets:
        found = ", ".join(f"{budget:,}" for budget in sorted(budgets)) or "none"
        raise UsageError(f"no run was trained on {samples:,} samples. Budgets found: {found}.")


def _suffix(scope: Scope) -> str:
    """What tells tables of other episodes from the official ones."""
    official = Scope(partition="test", split="canon", scene_set=0)
    pairs = [
        (scope.partition, official.partition),
        (scope.split, official.split),
        (f"scenes{scope.scene_set}", f"scenes{official.scene_set}"),
    ]
    return "".join(f"-{ours}" for ours, standard in pairs if ours != standard)


def _texts(filled: Sequence[Sheet], suffix: str) -> dict[str, str]:
    texts = {}
    for sheet in filled:
        lines = sheets.wide(sheet)
        texts[f"{sheet.layout.name}{suffix}.csv"] = sheets.csv_text(lines, list(lines[0]))
        texts[f"{sheet.layout.name}{suffix}.md"] = markdown(sheet)
    cells = [line for sheet in filled for line in sheets.long(sheet)]
    differences = [it for sheet in filled for it in sheets.compared(sheet.comparisons)]
    texts[f"cells{suffix}.csv"] = sheets.csv_text(cells, sheets.CELL)
    texts[f"comparisons{suffix}.csv"] = sheets.csv_text(differences, list(sheets.COMPARED))
    return texts


def _all_records(runs: Sequence[EvalRun]) -> list[EpisodeRecord]:
    """Every episode once, whatever its partition and split."""
    found = {
        (it.agent, it.checkpoint, it.protocol, it.key): it for run in runs for it in run.records
    }
    return list(found.values())


def _report(config: TablesConfig, runs: Sequence[EvalRun], filled: Sequence[Sheet]) -> None:
    print(f"{len(runs)} runs read.")
    for task in outdated({t: it for s in filled for t, it in s.protocols.items()}, _scope(config)):
        print(f"warning: all runs of {task} follow a protocol that is not this code's.")
    for sheet in filled:
        rows = [row for block in sheets.BLOCKS for row in sheet.rows(block)]
        played = [row for row in rows if any(entrant.scores for entrant in row.values())]
        print(f"{sheet.layout.name}: {len(played)} of {len(rows)} rows have a run.")
        for row in rows:
            for note in sheets.notes(row):
                if note != "no run":
                    print(f"  {next(iter(row.values())).row.agent}: {note}")
    print(f"Written: {config.out}")


if __name__ == "__main__":
    run_command(
        lambda: main(
            tyro.cli(TablesConfig, prog="python -m leaderboard.tables", description=__doc__)
        )
    )
