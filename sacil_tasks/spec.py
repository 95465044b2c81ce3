"""What a task is, apart from its physics: words, size family, layout rule, keyframe count.

Pure, so that episodes can be planned and results tabulated without the simulator.
"""

from dataclasses import dataclass

from sacil_tasks.splits import SPLITS, why_not


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

    clutter_region_m: tuple[tuple[float, float], tuple[float, float]] | None = (
        (-0.22, 0.05),
        (-0.28, 0.28),
    )
    """x and y range in which the split `clutter` puts one more object; None: it has no room."""

    @property
    def splits(self) -> tuple[str, ...]:
        """Splits this task has, in the order of the registry."""
        return tuple(name for name in SPLITS if why_not(self, name) is None)
