"""What a task is, apart from its physics: words, size family, layout rule, keyframe count.

Pure, so that episodes can be planned and results tabulated without the simulator.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TypeAlias

from sacil_tasks.sizes import LABELS
from sacil_tasks.splits import SPLITS, why_not

Range: TypeAlias = tuple[float, float]
"""Lower and upper end."""

REGION_M: tuple[Range, Range] = ((-0.22, 0.05), (-0.28, 0.28))
"""x and y range of candidate centres in the world (table) frame; the arm reaches all of it."""


@dataclass(frozen=True, kw_only=True)
class Fixture:
    """Furniture of a task, and where it may stand."""

    xy_m: tuple[float, float]
    """Mean position of its origin in the world (table) frame."""

    shift_m: float
    """It is moved by up to this much along x and along y."""

    yaw_deg: tuple[Range, ...]
    """Ranges of its heading, each as likely as the others."""

    spots_m: tuple[tuple[float, float], ...] = ()
    """Where candidates stand on it, in its own frame; empty: they do not stand on it."""

    spot_shift_m: float = 0.0
    """Each candidate is moved by up to this much along either axis."""


@dataclass(frozen=True, kw_only=True)
class TaskSpec:
    """Declared once, as the literal `SPEC = TaskSpec(...)` of the task's file."""

    name: str
    """Name on command lines, the same as the file's."""

    suites: tuple[str, ...]
    """Groups of tasks that are trained together."""

    family: str
    """Size family of the three candidates (`sizes.FAMILIES`)."""

    slots: tuple[str, ...]
    """Blanks of the templates, each filled with a size word; two slots never share a word."""

    receptacles: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Further blanks, which name a place, and the words for each."""

    templates: tuple[str, ...]
    """Sentences seen in training."""

    held_out_templates: tuple[str, ...] = ()
    """Sentences never seen in training; their indices follow those of `templates`."""

    keyframes: int
    """Keyframes of the expert."""

    spacing_m: float
    """Least distance between candidate centres, whatever their sizes."""

    yaw_limit_deg: float
    """Candidates are turned by up to this much, either way."""

    region_m: tuple[Range, Range] = REGION_M
    """x and y range of candidate centres, unless they stand on the fixture."""

    fixture: Fixture | None = None
    """What else stands on the table."""

    clutter_region_m: tuple[Range, Range] | None = None
    """x and y range of the one more object of the split `clutter`; a task with a fixture has that
    split only if it says where there is room, others put it among the candidates."""

    @property
    def blanks(self) -> dict[str, tuple[str, ...]]:
        """Every blank of the templates, sizes first, and the words it may be filled with."""
        return dict.fromkeys(self.slots, LABELS) | dict(self.receptacles)

    def size_words(self, slots: Mapping[str, str]) -> tuple[str, ...]:
        """The sizes that `slots` ask for, in the order named."""
        return tuple(slots[name] for name in self.slots)

    @property
    def splits(self) -> tuple[str, ...]:
        """Splits this task has, in the order of the registry."""
        return tuple(name for name in SPLITS if why_not(self, name) is None)
