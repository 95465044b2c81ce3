"""A table with its numbers, and the same as lines of CSV: wide as in the paper, and long."""

import csv
import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from leaderboard.layout import BEYOND, OTHER, PAPER, PROBE, Column, Layout
from leaderboard.paired import Comparison
from leaderboard.panel import Entrant, Panel, Rate, pooled
from leaderboard.scores import Scope, Score
from leaderboard.stats import wilson

Line = Mapping[str, str | int]

HASH_LENGTH = 12
"""Characters of a keyframe hash."""

BLOCKS = (PAPER, BEYOND, OTHER, PROBE)
"""In the order of their appearance."""


@dataclass(frozen=True)
class Sheet:
    """One table, filled."""

    layout: Layout
    scope: Scope
    panels: Mapping[str, Panel]
    """By suite."""

    comparisons: Sequence[Comparison]

    def rows(self, block: str) -> Iterator[dict[str, Entrant]]:
        """Each row of a block, as its entrants by suite."""
        first = next(iter(self.panels.values()))
        for name, entrant in first.entrants.items():
            if entrant.row.block == block:
                yield {suite: panel.entrants[name] for suite, panel in self.panels.items()}

    @property
    def protocols(self) -> dict[str, str]:
        """Task -> the protocol its episodes followed."""
        return {task: it for panel in self.panels.values() for task, it in panel.protocols.items()}

    def improvement(self, column: Column) -> Comparison | None:
        """What the last row of a table that has one shows in a column."""
        wanted = (self.layout.improvement, self.layout.against, column.name)
        found = (it for it in self.comparisons if (it.agent, it.against, it.column) == wanted)
        return next(found, None)


def notes(row: Mapping[str, Entrant]) -> list[str]:
    """What a reader of a row must know, each thing once."""
    return list(dict.fromkeys(note for entrant in row.values() for note in entrant.notes))


def wide(sheet: Sheet) -> list[Line]:
    """The table as the paper has it: rates in percent, and beside each where it comes from."""
    lines: list[Line] = []
    for block in BLOCKS:
        lines += [_wide_line(sheet.layout, row) for row in sheet.rows(block)]
        if block == PAPER and sheet.layout.improvement is not None:
            lines.append(_improvement_line(sheet, lines[0]))
    return lines


def long(sheet: Sheet) -> list[Line]:
    """Where every rate of one task comes from: a line for each training seed, and if there are
    several, one for all of them. The means of a table follow from these."""
    means_only = all(len(column.tasks) > 1 for column in sheet.layout.rates)
    return [
        _long_line(sheet, row[column.suite], column, scores)
        for block in BLOCKS
        for row in sheet.rows(block)
        for column in sheet.layout.rates
        for task in column.tasks
        if means_only or len(column.tasks) == 1
        for scores in _seed_by_seed(row[column.suite].scores.get(task, ()))
    ]


def compared(comparisons: Sequence[Comparison]) -> list[Line]:
    """Differences from the chosen row, in points of percent."""
    return [{name: show(one) for name, show in COMPARED.items()} for one in comparisons]


COMPARED: Mapping[str, Callable[[Comparison], str | int]] = {
    "table": lambda it: it.table,
    "agent": lambda it: it.agent,
    "against": lambda it: it.against,
    "column": lambda it: it.column,
    "tasks": lambda it: " ".join(it.tasks),
    "scenes": lambda it: it.scenes,
    "seeds": lambda it: it.seeds[0],
    "seeds_against": lambda it: it.seeds[1],
    "difference_points": lambda it: points(it.difference),
    "low_points": lambda it: points(it.interval.low),
    "high_points": lambda it: points(it.interval.high),
    "p": lambda it: f"{it.p_value:.4f}",
    "p_holm": lambda it: f"{it.p_holm:.4f}",
    "p_exact": lambda it: int(it.exact),
    "detectable_points": lambda it: "" if it.detectable is None else f"{100 * it.detectable:.1f}",
}
"""Columns of `comparisons.csv`."""

CELL = (
    *("table", "block", "row", "agent", "column", "task", "split", "partition", "scene_set"),
    *("seed", "successes", "episodes", "rate_percent", "low_percent", "high_percent"),
    *("checkpoint", "protocol", "run", "samples", "core_minutes", "preset", "text", "keyframes"),
)
"""Columns of `cells.csv`."""


def csv_text(lines: Sequence[Line], columns: Sequence[str]) -> str:
    r"""Lines as CSV, each ending in `\n`."""
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    return text.getvalue()


def percent(share: float) -> str:
    """A share of 1 as tables show it."""
    return f"{100 * share:.1f}"


def points(share: float) -> str:
    """A difference of shares; never `-0.0`."""
    return f"{round(100 * share, 1) + 0.0:+.1f}"


def _wide_line(layout: Layout, row: Mapping[str, Entrant]) -> Line:
    first = next(iter(row.values()))
    line: dict[str, str | int] = {"block": first.row.block}
    line |= dict(zip(layout.headings, first.row.labels, strict=True)) | {"agent": first.row.agent}
    for column in layout.columns:
        entrant = row[column.suite]
        if isinstance(column, Column):
            line |= _rate_fields(column.name, entrant.rate(column))
        else:
            line |= {column.prefix + name: text for name, text in budget(entrant).items()}
    return line | {"note": "; ".join(notes(row))}


def budget(entrant: Entrant) -> dict[str, str]:
    """What training an agent took, for one network; empty where there is none."""
    minutes, samples = entrant.core_minutes, entrant.samples
    return {
        "core_minutes": "" if minutes is None else f"{minutes:.1f}",
        "samples": "" if samples is None else str(samples),
        "seeds": " ".join(str(training.seed) for training in entrant.trainings),
    }


def _rate_fields(name: str, rate: Rate | None) -> dict[str, str | int]:
    fields = {f"{name}{end}": "" for end in ("", "_low", "_high", "_successes", "_episodes")}
    if rate is None:
        return dict(fields)
    total, interval = rate.total, rate.interval
    shown = (percent(rate.mean), percent(interval.low), percent(interval.high))
    return dict(zip(fields, (*shown, total.successes, total.episodes), strict=True))


def _improvement_line(sheet: Sheet, like: Line) -> Line:
    layout = sheet.layout
    line: dict[str, str | int] = dict.fromkeys(like, "")
    line |= {"block": PAPER, layout.headings[0]: "improvement"}
    line |= {"agent": f"{layout.improvement} - {layout.against}"}
    for column in layout.rates:
        gain = sheet.improvement(column)
        if gain is not None:
            line[column.name] = points(gain.difference)
            line[f"{column.name}_low"] = points(gain.interval.low)
            line[f"{column.name}_high"] = points(gain.interval.high)
    return line


def _seed_by_seed(scores: Sequence[Score]) -> list[Sequence[Score]]:
    alone: list[Sequence[Score]] = [(score,) for score in scores]
    return [*alone, scores] if len(scores) > 1 else alone


def _long_line(sheet: Sheet, entrant: Entrant, column: Column, scores: Sequence[Score]) -> Line:
    tally = pooled(score.tally for score in scores)
    interval = wilson(tally)
    shown: dict[str, str | int] = {
        "table": sheet.layout.name,
        "block": entrant.row.block,
        "row": " ".join(filter(None, entrant.row.labels)),
        "agent": entrant.row.agent,
        "column": column.name,
        "task": scores[0].task,
        "split": sheet.scope.split,
        "partition": sheet.scope.partition,
        "scene_set": sheet.scope.scene_set,
        "successes": tally.successes,
        "episodes": tally.episodes,
        "rate_percent": percent(tally.successes / tally.episodes),
        "low_percent": percent(interval.low),
        "high_percent": percent(interval.high),
        "checkpoint": "+".join(score.checkpoint or "" for score in scores),
        "protocol": scores[0].protocol,
        "run": " ".join(str(folder) for score in scores for folder in score.folders),
    }
    blank: dict[str, str | int] = dict.fromkeys(CELL, "")
    return blank | shown | _training_fields(scores)


def _training_fields(scores: Sequence[Score]) -> dict[str, str | int]:
    known = [score.training for score in scores if score.training]
    if len(known) < len(scores):
        return {}
    one = known[0]
    keyframes = (f"{task}:{sha256[:HASH_LENGTH]}" for task, sha256 in one.terms.keyframes)
    return {
        "seed": "+".join(str(it.seed) for it in known),
        "samples": one.samples,
        "core_minutes": "+".join(f"{it.core_minutes:.1f}" for it in known),
        "preset": one.preset,
        "text": one.text,
        "keyframes": " ".join(keyframes),
    }
