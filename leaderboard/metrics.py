"""Episode records -> what a policy chose, and whether its words had anything to do with it.

All of it is read from the records, so that old results can be summarised anew. The first choice
is the first candidate acquired or pressed; episodes in which there is none are not decisive.
"""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Self

from leaderboard.records import EpisodeRecord
from leaderboard.stats import Tally
from sacil_tasks.catalog import task_spec
from sacil_tasks.sizes import LABELS, absolute_choice
from sacil_tasks.splits import SPLITS


def decisive(records: Iterable[EpisodeRecord]) -> list[EpisodeRecord]:
    """Episodes in which a candidate was chosen, rightly or wrongly."""
    return [record for record in records if record.handled]


def size_confusions(records: Iterable[EpisodeRecord]) -> Tally:
    """First choices of a size that the words do not name, among decisive episodes.

    The other named object is an error of order, not of size.
    """
    return Tally.of(record.handled[0] not in record.asked for record in decisive(records))


def selections(records: Iterable[EpisodeRecord], slot: int) -> Tally:
    """Right choices in a slot, among episodes that got so far and chose rightly before."""
    reached = [
        record
        for record in records
        if slot < min(len(record.asked), len(record.handled))
        and record.handled[:slot] == record.asked[:slot]
    ]
    return Tally.of(record.handled[slot] == record.asked[slot] for record in reached)


def skill(records: Iterable[EpisodeRecord]) -> Tally:
    """Successes among episodes whose first choice was right: the hands, apart from the words."""
    right = [record for record in decisive(records) if record.handled[0] == record.asked[0]]
    return Tally.of(record.success for record in right)


def aims(records: Iterable[EpisodeRecord]) -> Tally:
    """Right aims of the first closing keyframe, among episodes with one near an object.

    It also counts grasps that failed; records of older versions do not tell.
    """
    aimed = [record for record in records if record.aimed]
    return Tally.of(record.aimed == record.asked[0] for record in aimed if record.asked)


def confusions(records: Iterable[EpisodeRecord], asked: str, handled: str) -> int:
    """Episodes whose first named size is `asked` and whose first choice is `handled`."""
    return sum(r.asked[0] == asked and r.handled[0] == handled for r in decisive(records))


@dataclass(frozen=True)
class Bias:
    """Which way first choices err in size."""

    smaller: int
    bigger: int
    extreme: int
    """Errors by two ranks, either way."""

    decisive: int

    @classmethod
    def of(cls, records: Iterable[EpisodeRecord]) -> Self:
        """Count errors of the first choice by sign and width."""
        chosen = decisive(records)
        steps = [LABELS.index(r.handled[0]) - LABELS.index(r.asked[0]) for r in chosen]
        return cls(
            smaller=sum(step < 0 for step in steps),
            bigger=sum(step > 0 for step in steps),
            extreme=sum(abs(step) == 2 for step in steps),
            decisive=len(steps),
        )

    @property
    def share(self) -> float | None:
        """Bigger minus smaller, of all decisive episodes: 0 is unbiased."""
        return (self.bigger - self.smaller) / self.decisive if self.decisive else None


@dataclass(frozen=True)
class AbsoluteBias:
    """Does a policy go by trained sizes or by rank, where the two name different objects?"""

    absolute: int
    """First choices of the object nearest to the size that the word had in training."""

    relative: int
    """First choices of the named rank."""

    decisive: int
    """Decisive episodes in which the two differ."""

    @classmethod
    def of(cls, records: Iterable[EpisodeRecord]) -> Self:
        """Count the episodes that tell."""
        telling = [
            (record, word)
            for record in decisive(records)
            if (word := absolute_label(record)) not in (None, record.asked[0])
        ]
        return cls(
            absolute=sum(record.handled[0] == word for record, word in telling),
            relative=sum(record.handled[0] == record.asked[0] for record, _ in telling),
            decisive=len(telling),
        )

    @property
    def index(self) -> float | None:
        """1 goes by absolute size, -1 by rank."""
        return (self.absolute - self.relative) / self.decisive if self.decisive else None


def absolute_label(record: EpisodeRecord) -> str | None:
    """What a policy takes first that knows trained sizes only; None where it is not defined."""
    if SPLITS[record.split].objects != "all" or not record.sizes_m:
        return None
    family = task_spec(record.task).family
    return LABELS[absolute_choice(family, record.asked[0], sorted(record.sizes_m))]


def sensitive_scenes(records: Iterable[EpisodeRecord]) -> Tally:
    """Scenes in which other words led to another first choice, among those that can tell.

    Zero for a policy that does not listen. One that chooses at random looks sensitive too: read
    it beside `understood_scenes`.
    """
    scenes = [decisive(scene) for scene in _scenes(records)]
    telling = [scene for scene in scenes if len({record.asked[0] for record in scene}) > 1]
    return Tally.of(len({record.handled[0] for record in scene}) > 1 for scene in telling)


def understood_scenes(records: Iterable[EpisodeRecord]) -> Tally:
    """Scenes in which every first choice was right, whatever the words: by chance 1 in 27 where
    there are three."""
    return Tally.of(
        all(record.handled[:1] == record.asked[:1] != () for record in scene)
        for scene in _scenes(records)
    )


def _scenes(records: Iterable[EpisodeRecord]) -> list[Sequence[EpisodeRecord]]:
    """Episodes of the same scene, which differ in words only."""
    scenes = defaultdict[tuple[object, ...], list[EpisodeRecord]](list)
    for record in records:
        scenes[record.key[:-1]].append(record)
    return list(scenes.values())
