"""Rows of a table -> differences from one of them, over the scenes that both have met."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from leaderboard import stats
from leaderboard.layout import PROBE, Column, Layout
from leaderboard.panel import Entrant, Panel
from leaderboard.scores import Score
from leaderboard.stats import Interval, Paired

SHARED = "shared_tasks"
"""The column of a comparison over some of the tasks of a mean, where others are missing."""


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """One row minus another in one column."""

    table: str
    agent: str
    against: str
    column: str
    tasks: tuple[str, ...]
    scenes: int
    seeds: tuple[int, int]
    """Networks of the row and of the one compared with."""

    difference: float
    """Of success rates, each task counting alike."""

    interval: Interval
    """95 % of a bootstrap over training seeds and scenes."""

    p_value: float
    """Of the sign-flip test on scenes."""

    exact: bool
    """All sign patterns were tried."""

    standard_error: float
    p_holm: float = 1.0
    """Adjusted for all rows of the column."""

    detectable: float | None = None
    """The smallest true difference that would be found in 80 % of such experiments at 5 % over all
    rows of the column (Bonferroni); None where no scene tells the two agents apart."""


def compare_rows(layout: Layout, panels: dict[str, Panel], against: str) -> list[Comparison]:
    """Every comparable row minus `against` in every column, adjusted within each column."""
    found = []
    for column in layout.rates:
        entrants = panels[column.suite].entrants
        first = entrants.get(against)
        if first is None or not first.comparable:
            continue
        rows = [it for it in entrants.values() if it.comparable and it.row.block != PROBE]
        made = [_compare(layout, column, it, first) for it in rows if it is not first]
        # Means over other sets of tasks are other families of comparisons.
        families = defaultdict[tuple[str, ...], list[Comparison]](list)
        for one in filter(None, made):
            families[one.tasks].append(one)
        found += [one for family in families.values() for one in _adjusted(family)]
    return found


def pair(ours: Sequence[Score], theirs: Sequence[Score]) -> Paired | None:
    """Two agents on the scenes of one task that every network of both has met; None without any.

    A scene counts by the words that all have been told.
    """
    shared = set.intersection(*(set(score.records) for score in (*ours, *theirs)))
    scenes = defaultdict(list)
    for key in sorted(shared):
        scenes[key.scene].append(key)
    if not scenes:
        return None

    def shares(score: Score) -> list[float]:
        return [
            float(np.mean([score.records[key].success for key in keys])) for keys in scenes.values()
        ]

    return Paired(np.array([shares(it) for it in ours]), np.array([shares(it) for it in theirs]))


def _compare(layout: Layout, column: Column, row: Entrant, against: Entrant) -> Comparison | None:
    tasks = tuple(task for task in column.tasks if task in row.scores and task in against.scores)
    ours, theirs = _same_seeds(row, tasks), _same_seeds(against, tasks)
    pairs = {task: pair(ours[task], theirs[task]) for task in tasks if ours and theirs}
    known = {task: it for task, it in pairs.items() if it is not None}
    if len(known) < min(2, len(column.tasks)):  # a mean over one task is that task's column
        return None
    paired = list(known.values())
    drawn, flipped = stats.bootstrap(paired), stats.sign_flip(paired)
    return Comparison(
        table=layout.name,
        agent=row.row.agent,
        against=against.row.agent,
        column=column.name if len(known) == len(column.tasks) else SHARED,
        tasks=tuple(known),
        scenes=sum(it.differences.size for it in paired),
        seeds=(len(paired[0].ours), len(paired[0].theirs)),
        difference=stats.mean_difference(paired),
        interval=stats.percentiles(drawn),
        p_value=flipped.p_value,
        exact=flipped.exact,
        standard_error=float(drawn.std()),
    )


def _same_seeds(entrant: Entrant, tasks: Iterable[str]) -> dict[str, list[Score]]:
    """The scores of those networks that played all of `tasks`; empty if there is none."""
    scores = {task: entrant.scores[task] for task in tasks}
    if not scores:
        return {}
    seeds = set.intersection(*({score.seed for score in it} for it in scores.values()))
    return {t: [s for s in it if s.seed in seeds] for t, it in scores.items()} if seeds else {}


def _adjusted(family: Sequence[Comparison]) -> list[Comparison]:
    adjusted = stats.holm([one.p_value for one in family])
    level = stats.LEVEL / len(family)
    return [
        replace(
            one,
            p_holm=p_holm,
            detectable=stats.detectable(one.standard_error, level=level)
            if one.standard_error
            else None,
        )
        for one, p_holm in zip(family, adjusted, strict=True)
    ]
