"""Episode records -> one row per agent, task and split: CSV for people and programs, console table.

Counts travel, rates are computed here. An errored episode is a failure and an error and never
leaves the denominator.
"""

import csv
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from statistics import fmean

from leaderboard.records import INVALID_ACTION, EpisodeRecord
from leaderboard.stats import Tally, wilson
from sacil_tasks.files import atomic_path, content_hash
from sacil_tasks.outcomes import OUTCOMES
from sacil_tasks.sizes import LABELS

HASH_LENGTH = 12
"""Characters of a hash that tables show."""


@dataclass(frozen=True)
class Cell:
    """The episodes of one agent on one task and split, under one protocol."""

    records: Sequence[EpisodeRecord]

    @property
    def successes(self) -> Tally:
        """Strict success: the headline."""
        return Tally.of(record.success for record in self.records)

    @property
    def decisive(self) -> list[EpisodeRecord]:
        """Episodes in which a candidate was chosen, rightly or wrongly."""
        return [record for record in self.records if record.handled]

    @property
    def size_confusions(self) -> Tally:
        """First choices of a size that the words do not name, among decisive episodes.

        The other named object is an error of order, not of size.
        """
        return Tally.of(record.handled[0] not in record.asked for record in self.decisive)

    def confusions(self, asked: str, handled: str) -> int:
        """Episodes whose first named size is `asked` and whose first choice is `handled`."""
        return sum(
            record.asked[0] == asked and record.handled[0] == handled for record in self.decisive
        )

    def asked_for(self, label: str) -> Tally:
        """Strict success of the episodes whose first named size is `label`."""
        first = [record for record in self.records if next(iter(record.slots.values())) == label]
        return Tally.of(record.success for record in first)

    @property
    def scenes(self) -> str:
        """Hash of what was shown: equal for agents that met the same scenes and words."""
        return content_hash(sorted((*record.key, record.fingerprint) for record in self.records))


def cells(records: Iterable[EpisodeRecord]) -> list[Cell]:
    """Group records and put them in the order of tables."""
    ordered = sorted(records, key=_place)
    return [Cell(tuple(group)) for _, group in groupby(ordered, key=lambda it: _place(it)[:-1])]


def row(cell: Cell) -> dict[str, str | int]:
    """One line of the summary, columns in their fixed order; empty where there is no episode."""
    one = cell.records[0]
    interval = wilson(cell.successes)
    return {
        "agent": one.agent,
        "privileged": int(one.privileged),
        "task": one.task,
        "split": one.split,
        "partition": one.partition,
        "scene_set": one.scene_set,
        "successes": cell.successes.successes,
        "episodes": cell.successes.episodes,
        "rate_percent": _percent(cell.successes.rate),
        "low_percent": _percent(interval.low),
        "high_percent": _percent(interval.high),
        "lenient_successes": sum(record.success_lenient for record in cell.records),
        "errors": sum(record.errored for record in cell.records),
        "invalid_actions": sum(record.end == INVALID_ACTION for record in cell.records),
        **{f"outcome_{code.lower()}": _count(cell, code) for code in OUTCOMES},
        "decisive": cell.size_confusions.episodes,
        "size_confusions": cell.size_confusions.successes,
        "size_confusion_percent": _percent(cell.size_confusions.rate),
        **_matrix(cell),
        **_per_size(cell),
        "mean_keyframes": f"{fmean(record.keyframes for record in cell.records):.2f}",
        "mean_seconds": f"{fmean(record.seconds.total for record in cell.records):.2f}",
        "checkpoint": (one.checkpoint or "")[:HASH_LENGTH],
        "protocol": one.protocol,
        "scenes": cell.scenes[:HASH_LENGTH],
    }


def write_summary(path: Path, records: Iterable[EpisodeRecord]) -> None:
    r"""Write the CSV atomically, lines ending in `\n`.

    Raises:
        UsageError: the file cannot be written.
    """
    rows = [row(cell) for cell in cells(records)]
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    with atomic_path(path) as draft:
        draft.write_text(text.getvalue(), encoding="utf-8", newline="")


def console_table(records: Iterable[EpisodeRecord]) -> str:
    """The same cells as aligned text, the few columns that fit a terminal."""
    lines = [
        tuple(_CONSOLE),
        *(tuple(show(cell) for show in _CONSOLE.values()) for cell in cells(records)),
    ]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        "  ".join(text.ljust(width) for text, width in zip(line, widths, strict=True)).rstrip()
        for line in lines
    )


def _interval(cell: Cell) -> str:
    interval = wilson(cell.successes)
    return f"{_percent(interval.low)}-{_percent(interval.high)}"


_CONSOLE: Mapping[str, Callable[[Cell], str]] = {
    "agent": lambda cell: cell.records[0].agent + "*" * cell.records[0].privileged,
    "task": lambda cell: cell.records[0].task,
    "split": lambda cell: cell.records[0].split,
    "success": lambda cell: str(cell.successes),
    "%": lambda cell: _percent(cell.successes.rate),
    "95% interval": _interval,
    "lenient": lambda cell: str(Tally.of(record.success_lenient for record in cell.records)),
    "wrong size": lambda cell: str(cell.size_confusions),
    "errors": lambda cell: str(sum(record.errored for record in cell.records)),
    "keyframes": lambda cell: f"{fmean(record.keyframes for record in cell.records):.1f}",
    "s/episode": lambda cell: f"{fmean(record.seconds.total for record in cell.records):.2f}",
}


def _place(record: EpisodeRecord) -> tuple[object, ...]:
    return (
        record.agent,
        record.task,
        record.split,
        record.partition,
        record.scene_set,
        record.protocol,
        record.checkpoint or "",
        (record.scene, record.variation),
    )


def _count(cell: Cell, code: str) -> int:
    return sum(record.outcome == code for record in cell.records)


def _matrix(cell: Cell) -> dict[str, int]:
    return {
        f"asked_{asked}_took_{handled}": cell.confusions(asked, handled)
        for asked in LABELS
        for handled in LABELS
    }


def _per_size(cell: Cell) -> dict[str, int]:
    return {
        f"{label}_{what}": getattr(cell.asked_for(label), what)
        for label in LABELS
        for what in ("successes", "episodes")
    }


def _percent(share: float | None) -> str:
    return "" if share is None else f"{100 * share:.1f}"
