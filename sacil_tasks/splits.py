"""How a scene differs from training: every split, and which task has which. Pure.

A split changes sizes, objects on the table or words; it never moves a candidate. `canon` is what
training shows. The task x split matrix is `why_not`: a new task is in it as soon as its file is.
"""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Literal

from sacil_tasks.errors import UsageError, find_name
from sacil_tasks.sizes import FAMILIES, GRASPABLE_M, LABELS, largest_m

if TYPE_CHECKING:
    from sacil_tasks.spec import TaskSpec

Phrases = Mapping[str, str]
"""Size label -> how it is said of a `{noun}`."""

TRAINED: Phrases = {label: f"{label} {{noun}}" for label in LABELS}

_HELD_OUT: tuple[Phrases, ...] = (
    {"small": "little {noun}", "medium": "mid-sized {noun}", "large": "big {noun}"},
    {"small": "smallest {noun}", "medium": "middle-sized {noun}", "large": "biggest {noun}"},
    {
        "small": "smallest {noun}",
        "medium": "{noun} that is neither the biggest nor the smallest",
        "large": "biggest {noun}",
    },
)
"""Sets of size words that training never says; a scene uses one of them."""

_COMPARATIVES: Phrases = {"small": "smaller {noun}", "large": "larger {noun}"}

_FAR_COLOURS = ("red", "yellow", "green", "cyan", "blue", "magenta")
"""Names of `scenes.COLOURS` that nobody takes for each other."""


@dataclass(frozen=True, kw_only=True)
class Split:
    """The rules of one split; what is not said is as in `canon`."""

    use: str
    """What it is for, in a line."""

    first_rungs: tuple[int, ...] = (1,)
    """Rungs that the small object may have; drawn per scene if there are several. Rungs that would
    lead beyond the end of a family's ladder are left out."""

    ratio: float | None = None
    """Exact ratio of neighbouring sizes around the middle rung, instead of the ladder's."""

    objects: Literal["all", "two", "named"] = "all"
    """Candidates on the table: all, two of different sizes, or only what the words name."""

    clutter: tuple[str, ...] = ()
    """Families of which one more object stands there, of any rung and never of the task's own."""

    colours: tuple[str, ...] = ()
    """Every candidate has another of these colours, and the words name the colour."""

    phrases: tuple[Phrases, ...] = (TRAINED,)
    """Sets of size words; a scene uses one of them."""

    held_out_templates: bool = False
    """Sentences are drawn from those that training never says."""

    speech: Literal["asked", "blank", "other"] = "asked"
    """What is heard: the sentence asked for, nothing, or one drawn without regard to what is
    asked for (over the words of a scene, each sentence is heard once)."""

    def rules(self) -> dict[str, Any]:
        """What defines scenes and words, for the hash of a protocol."""
        return {name: value for name, value in asdict(self).items() if name != "use"}


FINE_RATIOS = (1.10, 1.15, 1.20, 1.25, 1.31, 1.50)

_FINE = {
    f"fine_{ratio * 100:.0f}": Split(use=f"neighbouring sizes differ by {ratio:.2f}", ratio=ratio)
    for ratio in FINE_RATIOS
}

SPLITS: dict[str, Split] = {
    "canon": Split(use="sizes and words as trained"),
    "shift_down": Split(use="one rung smaller: absolute size misleads", first_rungs=(0,)),
    "shift_up": Split(use="one rung larger: absolute size misleads", first_rungs=(2,)),
    "mixed": Split(use="any three neighbouring rungs: a training set", first_rungs=(0, 1, 2)),
    **_FINE,
    "clutter": Split(use="one object of another kind beside", clutter=("block", "cup")),
    "pair": Split(use="two objects, smaller and larger", objects="two", phrases=(_COMPARATIVES,)),
    "para_size": Split(use="size words never heard", phrases=_HELD_OUT),
    "para_verb": Split(use="sentences never heard", held_out_templates=True),
    "para_both": Split(
        use="size words and sentences never heard", phrases=_HELD_OUT, held_out_templates=True
    ),
    "unique_colour": Split(use="control: the colour is named instead", colours=_FAR_COLOURS),
    "blank_text": Split(use="control: no words", speech="blank"),
    "shuffled_text": Split(use="control: words of another episode", speech="other"),
    "single_object": Split(use="control: nothing to confuse", objects="named"),
}
"""Every split that a command line can name."""

GROUPS: dict[str, tuple[str, ...]] = {"fine": tuple(_FINE)}
"""Names that stand for several splits: the psychometric series, on the same scenes."""


def expand(names: Iterable[str]) -> tuple[str, ...]:
    """Splits behind the names on a command line, each once.

    Raises:
        UsageError: there is no such split.
    """
    found: list[str] = []
    for name in names:
        find_name(name, [*SPLITS, *GROUPS], "split")
        found += GROUPS.get(name, (name,))
    return tuple(dict.fromkeys(found))


def why_not(task: "TaskSpec", name: str) -> str | None:
    """Why a task does not have a known split; None if it has it."""
    split = SPLITS[name]
    if split.objects == "named" and len(task.slots) > 1:
        return "its words name two objects"
    if split.held_out_templates and not task.held_out_templates:
        return "it has no held-out sentences"
    if split.clutter and task.fixture is not None and task.clutter_region_m is None:
        return "one more object has no room beside its furniture"
    family = FAMILIES[task.family]
    if split.ratio is None and not family.first_rungs(split.first_rungs):
        return "its largest size would not fit the gripper"
    if split.ratio is not None and largest_m(family, split.ratio) > GRASPABLE_M:
        return "its largest size would not fit the gripper"
    return None


def check_split(task: "TaskSpec", name: str) -> None:
    """Accept a split that the task has.

    Raises:
        UsageError: there is no such split, or the task does not have it.
    """
    find_name(name, SPLITS, f"split of {task.name}")
    reason = why_not(task, name)
    if reason is not None:
        raise UsageError(
            f"{task.name} has no split {name}: {reason}. It has {', '.join(task.splits)}; "
            "leave the task or the split out."
        )


def plan_splits(
    tasks: Iterable["TaskSpec"], names: Iterable[str], *, strict: bool
) -> tuple[list[tuple[str, str]], dict[tuple[str, str], str]]:
    """Pairs of task and split to run, and those that do not exist with the reason.

    `strict`: the tasks were named one by one, so that a pair that does not exist is a mistake.

    Raises:
        UsageError: a split is unknown or none is named, or a pair does not exist although it was
            asked for.
    """
    specs, splits = list(tasks), expand(names)
    if not splits:
        raise UsageError(f"no split is named. Name some of {', '.join(SPLITS)}.")
    reasons = {(spec.name, split): why_not(spec, split) for spec in specs for split in splits}
    missing = {pair: reason for pair, reason in reasons.items() if reason is not None}
    pairs = [pair for pair, reason in reasons.items() if reason is None]
    if missing and (strict or not pairs):
        (task, split), reason = next(iter(missing.items()))
        known = next(spec for spec in specs if spec.name == task).splits
        raise UsageError(
            f"{task} has no split {split}: {reason}. It has {', '.join(known)}; "
            "leave the task or the split out, or ask for a suite, which shows such pairs as n/a."
        )
    return pairs, missing
