"""The paper's tables 1 to 5: which agents are rows, which tasks are columns, in which order.

Rows and columns are the paper's. Behind them stand agents that the paper does not have in a table,
and the probes, each in a block of its own.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from leaderboard.agents import PROBES

SUITES: Mapping[str, tuple[str, ...]] = {
    "single": (
        "pick_and_lift",
        "pick_up_cup",
        "place_cup",
        "put_item_in_drawer",
        "take_off_pepper",
    ),
    "dual": ("place_cups", "push_buttons", "put_items_in_drawer", "take_off_peppers"),
}
"""Tasks in the order of the paper's columns."""

PAPER, BEYOND, OTHER, PROBE = "paper", "beyond", "other", "probe"
"""Blocks of rows: in the paper's table; ours beside them; anyone else's; ceilings and floors."""

EQUAL_COMPUTE = "rvt:equal_compute"
"""RVT trained for as many core-minutes as SACIL: the one row that may have other samples."""

FROM_SCRATCH = "image trunk trained from scratch, not CLIP's"


@dataclass(frozen=True)
class Row:
    """One agent in a table."""

    agent: str
    labels: tuple[str, ...]
    """What the paper prints in front."""

    block: str = PAPER
    remarks: Mapping[str, str] = field(default_factory=dict)
    """Preset -> what must be said of the row."""


@dataclass(frozen=True)
class Column:
    """A success rate: of one task, or the mean over several, each counting alike."""

    name: str
    suite: str
    tasks: tuple[str, ...]


@dataclass(frozen=True)
class Budget:
    """Where the training of a suite's networks is shown."""

    suite: str
    prefix: str = ""


@dataclass(frozen=True, kw_only=True)
class Layout:
    """One table."""

    name: str
    """File name without its ending."""

    title: str
    headings: tuple[str, ...]
    """Names of the rows' labels."""

    columns: tuple[Column | Budget, ...]
    rows: tuple[Row, ...]
    against: str
    """Agent that the others are compared with, unless another is chosen."""

    open_to_others: bool = False
    """Agents that are in no row are shown too."""

    improvement: str | None = None
    """Agent whose difference from `against` is a last row."""

    @property
    def rates(self) -> tuple[Column, ...]:
        """Columns that are success rates."""
        return tuple(column for column in self.columns if isinstance(column, Column))

    @property
    def suites(self) -> tuple[str, ...]:
        """Suites whose networks are compared."""
        return tuple(dict.fromkeys(column.suite for column in self.columns))

    @property
    def named(self) -> bool:
        """Rows are labelled by names; in an ablation, by what they have."""
        return self.headings[0] in ("model", "method")

    def labels_of(self, name: str) -> tuple[str, ...]:
        """Labels of a row that has only a name."""
        return (name,) if self.named else ("",) * len(self.headings)


def _average(suite: str, name: str = "average") -> Column:
    return Column(name, suite, SUITES[suite])


def _each(suite: str) -> tuple[Column, ...]:
    return tuple(Column(task, suite, (task,)) for task in SUITES[suite])


_BASELINES = (
    Row("hiveformer", ("HiveFormer",)),
    Row("polarnet", ("PolarNet",)),
    Row("act3d", ("Act3D",), remarks={"cpu": FROM_SCRATCH}),
    Row("rvt", ("RVT",)),
    Row("sacil", ("SACIL",)),
    Row(EQUAL_COMPUTE, ("RVT, equal core-minutes",), BEYOND),
    Row("rvt2", ("RVT-2",), BEYOND),
    Row("sacil_rvt2", ("SACIL-RVT-2",), BEYOND),
)

_TABLES = (
    Layout(
        name="table1_single",
        title="Table 1: single-target tasks",
        headings=("model",),
        columns=(_average("single"), Budget("single"), *_each("single")),
        rows=_BASELINES,
        against="sacil",
        open_to_others=True,
    ),
    Layout(
        name="table2_dual",
        title="Table 2: sequential dual-target tasks",
        headings=("model",),
        columns=(_average("dual"), Budget("dual"), *_each("dual")),
        rows=_BASELINES,
        against="sacil",
        open_to_others=True,
    ),
    Layout(
        name="table3_queries",
        title="Table 3: size-aware query tokens, sequential dual-target tasks",
        headings=("query_tokens",),
        columns=(*_each("dual"), _average("dual"), Budget("dual")),
        rows=(Row("sacil:no_queries", ("no",)), Row("sacil", ("yes",))),
        against="sacil",
    ),
    Layout(
        name="table4_contrasts",
        title="Table 4: contrastive imitation learning, single-target tasks",
        headings=("image_text_contrast", "current_goal_contrast"),
        columns=(*_each("single"), _average("single"), Budget("single")),
        # The paper's first row is its RVT; without contrasts ours still has its queries.
        rows=(
            Row("sacil:no_contrast", ("no", "no")),
            Row("rvt", ("no", "no")),
            Row("sacil:image_text", ("yes", "no")),
            Row("sacil", ("yes", "yes")),
        ),
        against="sacil",
    ),
    Layout(
        name="table5_rvt2",
        title="Table 5: dual contrastive learning in RVT-2",
        headings=("method",),
        columns=(
            _average("single", "single_average"),
            _average("dual", "dual_average"),
            Budget("single", "single_"),
            Budget("dual", "dual_"),
        ),
        rows=(Row("rvt2", ("RVT-2",)), Row("sacil_rvt2", ("SACIL-RVT-2",))),
        against="rvt2",
        improvement="sacil_rvt2",
    ),
)


def _with_probes(layout: Layout) -> Layout:
    probes = tuple(Row(name, layout.labels_of(f"{name}*"), PROBE) for name in PROBES)
    return replace(layout, rows=(*layout.rows, *probes))


TABLES = tuple(map(_with_probes, _TABLES))
