"""Scores -> the rows of one table, on equal terms.

All rows of a suite have the same samples, preset, text encoder and keyframes: those of the agent
that the others are compared with. Networks trained on other terms are left out and the row says
why, so that a missing number is never mistaken for a bad one.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from statistics import fmean

from leaderboard.layout import EQUAL_COMPUTE, OTHER, PROBE, SUITES, Column, Layout, Row
from leaderboard.scores import Score
from leaderboard.stats import Interval, Tally, wilson_of_mean
from leaderboard.training import Terms, Training
from sacil_tasks.errors import UsageError


@dataclass(frozen=True)
class Rate:
    """A success rate in a table: of one task, or the mean over several."""

    tallies: tuple[Tally, ...]
    """Of each task, all training seeds together."""

    @property
    def mean(self) -> float:
        """Each task counts alike."""
        return fmean(tally.successes / tally.episodes for tally in self.tallies)

    @property
    def total(self) -> Tally:
        """All successes among all episodes."""
        return pooled(self.tallies)

    @property
    def interval(self) -> Interval:
        """Wilson's, of a mean by adding squares."""
        return wilson_of_mean(self.tallies)


def pooled(tallies: Iterable[Tally]) -> Tally:
    """All of them together."""
    counted = tuple(tallies)
    return Tally(sum(it.successes for it in counted), sum(it.episodes for it in counted))


@dataclass(frozen=True)
class Entrant:
    """One agent in one suite."""

    row: Row
    scores: Mapping[str, tuple[Score, ...]]
    """Task -> one score for each training seed, in the order of seeds."""

    notes: tuple[str, ...] = ()
    comparable: bool = False
    """It was trained on the table's terms."""

    def rate(self, column: Column) -> Rate | None:
        """What the table shows in a column; None unless all of its tasks were played."""
        if any(task not in self.scores for task in column.tasks):
            return None
        return Rate(tuple(self.tally(task) for task in column.tasks))

    def tally(self, task: str) -> Tally:
        """Successes on a task, all training seeds together."""
        return pooled(score.tally for score in self.scores[task])

    @property
    def trainings(self) -> list[Training]:
        """What is behind each network, in the order of seeds."""
        scores = (score for group in self.scores.values() for score in group)
        found = {it.training.seed: it.training for it in scores if it.training}
        return [found[seed] for seed in sorted(found)]

    @property
    def samples(self) -> int | None:
        """Behaviour-cloning samples of each network."""
        return next((training.samples for training in self.trainings), None)

    @property
    def core_minutes(self) -> float | None:
        """Mean over the networks."""
        minutes = [training.core_minutes for training in self.trainings]
        return fmean(minutes) if minutes else None


@dataclass(frozen=True)
class Panel:
    """One suite in one table."""

    terms: Terms | None
    """What all comparable rows have in common; None without a trained agent."""

    protocols: Mapping[str, str]
    """Task -> the protocol that all of its episodes followed."""

    entrants: Mapping[str, Entrant]
    """By agent, in the order of rows."""


def build_panel(
    layout: Layout,
    suite: str,
    scores: Sequence[Score],
    protocols: Mapping[str, str],
    *,
    against: str,
    samples: int | None,
) -> Panel:
    """Choose the terms of a suite and put every row's scores on them.

    `samples` narrows the choice.

    Raises:
        UsageError: terms differ and nothing says which are meant, or two networks of an agent
            have the same training seed.
    """
    mine = [score for score in scores if score.task in SUITES[suite]]
    rows = (*layout.rows, *(_others(layout, mine) if layout.open_to_others else ()))
    blocks = {row.agent: row.block for row in rows if row.agent != EQUAL_COMPUTE}
    current = [it for it in mine if it.protocol == protocols[it.task] and it.agent in blocks]
    groups = (
        [score for score in current if score.agent == against],
        [score for score in current if blocks[score.agent] != OTHER],
        current,
    )
    terms = _choose_terms(layout.name, set(SUITES[suite]), groups, samples)
    entrants = {row.agent: _entrant(row, mine, terms, protocols) for row in rows}
    most = {
        task: max(len(score.records) for e in entrants.values() for score in e.scores.get(task, ()))
        for task in {task for e in entrants.values() for task in e.scores}
    }
    doubted = {name: _with_doubts(it, most) for name, it in entrants.items()}
    followed = {task: protocols[task] for task in SUITES[suite] if task in most}
    return Panel(terms, followed, doubted)


def _others(layout: Layout, scores: Iterable[Score]) -> tuple[Row, ...]:
    known = {row.agent for row in layout.rows}
    names = sorted({score.agent for score in scores} - known)
    return tuple(Row(name, layout.labels_of(name), OTHER) for name in names)


def _choose_terms(
    table: str, tasks: set[str], groups: Iterable[Sequence[Score]], samples: int | None
) -> Terms | None:
    """Those of the first group of scores that has any; of networks trained on just `tasks`, if
    there are some. None without a trained network.

    Raises:
        UsageError: there are several.
    """
    for group in groups:
        found = {
            score.training.terms: score
            for score in group
            if score.training and samples in (None, score.training.samples)
        }
        exact = {it: score for it, score in found.items() if set(it.tasks) == tasks}
        options = exact or found
        if len(options) == 1:
            return next(iter(options))
        if options:
            listed = "; ".join(f"{s.agent} in {s.folders[0]}: {it}" for it, s in options.items())
            raise UsageError(
                f"{table} would mix budgets ({listed}). Its rows must have equal samples and "
                "keyframes: choose with --samples, or name the runs with --runs."
            )
    return None


def _entrant(
    row: Row, scores: Sequence[Score], terms: Terms | None, protocols: Mapping[str, str]
) -> Entrant:
    """A row's scores, without those that are on other terms or under another protocol."""
    mine = [score for score in scores if score.agent == row.agent]
    reasons = [_unfit(row, score, terms, protocols[score.task]) for score in mine]
    kept = [score for score, reason in zip(mine, reasons, strict=True) if not reason]
    notes = dict.fromkeys(
        f"left out: {reason} ({score.folders[0]})"
        for score, reason in zip(mine, reasons, strict=True)
        if reason
    )
    comparable = bool(kept) and all(score.training for score in kept)
    if kept and not comparable and row.block == OTHER:
        notes["not comparable: its training budget is unknown"] = None
    if row.agent == EQUAL_COMPUTE and kept:
        notes["equal core-minutes, not samples"] = None
    if kept and terms and terms.preset in row.remarks:
        notes[row.remarks[terms.preset]] = None
    if not mine:
        notes["no run"] = None
    return Entrant(row, _by_task(kept), tuple(notes), comparable)


def _unfit(row: Row, score: Score, terms: Terms | None, protocol: str) -> str:
    """Why a score may not stand in its row; empty if it may."""
    if score.protocol != protocol:
        return f"{score.task} under protocol {score.protocol}, not {protocol}"
    if row.block == PROBE:
        return ""
    if score.training is None:
        return "" if row.block == OTHER else "its training budget is unknown"
    theirs = score.training.terms
    if terms is None:
        return f"{theirs.samples:,} samples, and no row has the table's budget"
    if row.agent == EQUAL_COMPUTE:
        theirs = replace(theirs, samples=terms.samples)
    return theirs.unlike(terms)


def _by_task(scores: Iterable[Score]) -> dict[str, tuple[Score, ...]]:
    """One score for each task and training seed.

    Raises:
        UsageError: two networks have the same seed, be it on different tasks.
    """
    ordered = sorted(scores, key=lambda score: (score.task, _order(score.seed)))
    first_of_seed: dict[int | None, Score] = {}
    for two in ordered:
        one = first_of_seed.setdefault(two.seed, two)
        if (two.checkpoint, two.privileged) != (one.checkpoint, one.privileged):
            raise UsageError(
                f"{one.folders[0]} and {two.folders[0]} hold {one.task} and {two.task} of two "
                f"networks of {one.agent} with the same training seed. Name one of them with "
                "--runs."
            )
    return {task: tuple(group) for task, group in groupby(ordered, key=lambda it: it.task)}


def _with_doubts(entrant: Entrant, most: Mapping[str, int]) -> Entrant:
    """Say what a reader of the numbers must know."""
    doubts = []
    for task, scores in entrant.scores.items():
        fewest = min(len(score.records) for score in scores)
        if fewest < most[task]:
            doubts.append(f"{task}: {fewest} of {most[task]} episodes that others have")
    seeds = {task: [score.seed for score in scores] for task, scores in entrant.scores.items()}
    for task, found in seeds.items():
        if len(found) < max(map(len, seeds.values())):
            doubts.append(f"{task}: {len(found)} of several training seeds")
    records = [r for scores in entrant.scores.values() for s in scores for r in s.records.values()]
    if broken := sum(record.errored for record in records):
        doubts.append(f"{broken} episodes broke off and count as failures")
    test_runs = max((s.test_runs for it in entrant.scores.values() for s in it), default=0)
    if test_runs > 1:
        doubts.append(f"these weights have met the test {test_runs} times")
    return replace(entrant, notes=(*entrant.notes, *doubts))


def _order(seed: int | None) -> int:
    return -1 if seed is None else seed
