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

from leaderboard import metrics
from leaderboard.records import BROKE_OFF, INVALID_ACTION, LIMIT, SUCCEEDED, EpisodeRecord
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
        **{f"ended_{end}": _ended(cell, end) for end in _ENDS},
        **{f"outcome_{code.lower()}": _count(cell, code) for code in OUTCOMES},
        **_choices(cell),
        **_words(cell),
        **_matrix(cell),
        **_per_size(cell),
        "mean_keyframes": f"{fmean(record.keyframes for record in cell.records):.2f}",
        "mean_seconds": f"{fmean(record.seconds.total for record in cell.records):.2f}",
        "checkpoint": (one.checkpoint or "")[:HASH_LENGTH],
        "protocol": one.protocol,
        "scenes": cell.scenes[:HASH_LENGTH],
    }


def write_summary(path: Path, records: Iterable[EpisodeRecord]) -> None:
    """Write the CSV atomically.

    Raises:
        UsageError: the file cannot be written.
    """
    text = summary_text(records)
    with atomic_path(path) as draft:
        draft.write_text(text, encoding="utf-8", newline="")


def summary_text(records: Iterable[EpisodeRecord]) -> str:
    r"""The CSV, lines ending in `\n`."""
    rows = [row(cell) for cell in cells(records)]
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def console_table(records: Iterable[EpisodeRecord]) -> str:
    """The same cells as aligned text: what worked, then what was chosen and why it ended."""
    found = cells(records)
    return "\n\n".join(_aligned(columns, found) for columns in (_CONSOLE, _CHOICES))


def _aligned(columns: Mapping[str, Callable[[Cell], str]], found: Sequence[Cell]) -> str:
    lines = [tuple(columns), *(tuple(show(cell) for show in columns.values()) for cell in found)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        "  ".join(text.ljust(width) for text, width in zip(line, widths, strict=True)).rstrip()
        for line in lines
    )


def _interval(cell: Cell) -> str:
    interval = wilson(cell.successes)
    return f"{_percent(interval.low)}-{_percent(interval.high)}"


_ENDS = (SUCCEEDED, LIMIT, INVALID_ACTION, BROKE_OFF)

_NAMES: Mapping[str, Callable[[Cell], str]] = {
    "agent": lambda cell: cell.records[0].agent + "*" * cell.records[0].privileged,
    "task": lambda cell: cell.records[0].task,
    "split": lambda cell: cell.records[0].split,
}

_CONSOLE: Mapping[str, Callable[[Cell], str]] = {
    **_NAMES,
    "success": lambda cell: str(cell.successes),
    "%": lambda cell: _percent(cell.successes.rate),
    "95% interval": _interval,
    "lenient": lambda cell: str(Tally.of(record.success_lenient for record in cell.records)),
    "wrong size": lambda cell: str(metrics.size_confusions(cell.records)),
    "errors": lambda cell: str(sum(record.errored for record in cell.records)),
    "keyframes": lambda cell: f"{fmean(record.keyframes for record in cell.records):.1f}",
    "s/episode": lambda cell: f"{fmean(record.seconds.total for record in cell.records):.2f}",
}

_CHOICES: Mapping[str, Callable[[Cell], str]] = {
    **_NAMES,
    "chose right": lambda cell: str(metrics.selections(cell.records, 0)),
    "then right": lambda cell: _if_any(metrics.selections(cell.records, 1)),
    "skill": lambda cell: _if_any(metrics.skill(cell.records)),
    "bias": lambda cell: _signed(metrics.Bias.of(cell.records).share),
    "absolute": lambda cell: _signed(metrics.AbsoluteBias.of(cell.records).index),
    "words matter": lambda cell: _if_any(metrics.sensitive_scenes(cell.records)),
    "all words right": lambda cell: str(metrics.understood_scenes(cell.records)),
    "ended": lambda cell: ", ".join(
        f"{end} {_ended(cell, end)}" for end in _ENDS if _ended(cell, end)
    ),
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


def _ended(cell: Cell, end: str) -> int:
    return sum(record.end == end for record in cell.records)


def _choices(cell: Cell) -> dict[str, str | int]:
    """What was chosen, slot by slot, and which way it erred."""
    wrong_sizes = metrics.size_confusions(cell.records)
    first, second = (metrics.selections(cell.records, slot) for slot in (0, 1))
    skill, aims = metrics.skill(cell.records), metrics.aims(cell.records)
    bias = metrics.Bias.of(cell.records)
    return {
        "decisive": wrong_sizes.episodes,
        "size_confusions": wrong_sizes.successes,
        "size_confusion_percent": _percent(wrong_sizes.rate),
        "first_right": first.successes,
        "first_right_percent": _percent(first.rate),
        "first_other_named": first.episodes - first.successes - wrong_sizes.successes,
        "second_right": second.successes,
        "second_decisive": second.episodes,
        "second_right_percent": _percent(second.rate),
        "skill_successes": skill.successes,
        "skill_percent": _percent(skill.rate),
        "aimed_right": aims.successes,
        "aimed": aims.episodes,
        "chose_smaller": bias.smaller,
        "chose_bigger": bias.bigger,
        "chose_extreme": bias.extreme,
        "size_bias": _signed(bias.share),
    }


def _words(cell: Cell) -> dict[str, str | int]:
    """Whether trained sizes or ranks decided, and whether words did at all."""
    absolute = metrics.AbsoluteBias.of(cell.records)
    sensitive = metrics.sensitive_scenes(cell.records)
    understood = metrics.understood_scenes(cell.records)
    return {
        "absolute_choices": absolute.absolute,
        "relative_choices": absolute.relative,
        "absolute_decisive": absolute.decisive,
        "absolute_bias_index": _signed(absolute.index),
        "sensitive_scenes": sensitive.successes,
        "telling_scenes": sensitive.episodes,
        "understood_scenes": understood.successes,
        "scenes_played": understood.episodes,
    }


def _matrix(cell: Cell) -> dict[str, int]:
    return {
        f"asked_{asked}_took_{handled}": metrics.confusions(cell.records, asked, handled)
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


def _signed(value: float | None) -> str:
    return "" if value is None else f"{value:+.2f}"


def _if_any(tally: Tally) -> str:
    return str(tally) if tally.episodes else ""
