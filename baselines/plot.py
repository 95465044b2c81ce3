"""Draw the curves of training runs beside each other: `python -m baselines.plot RUN [RUN ...]`."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import tyro
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from baselines.checkpoint import METRICS
from baselines.run import read_rows
from sacil_tasks.errors import UsageError, run_command
from sacil_tasks.files import atomic_path

Row: TypeAlias = Mapping[str, Any]


@dataclass(frozen=True)
class Panel:
    """One diagram: which rows of a run's metrics are drawn, and what of them."""

    title: str
    kind: str
    value: Callable[[Row], float | None]


def _selected(row: Row) -> float:
    right, of = row["all"]["selected_by_words"]
    return 100 * right / max(of, 1)


PANELS = (
    Panel("behaviour cloning: position loss", "train", lambda row: row.get("bc/position")),
    Panel("behaviour cloning: rotation loss", "train", lambda row: row.get("bc/rotation")),
    Panel("val: named candidate chosen, %", "val", _selected),
    Panel("val: position error, mm (median)", "val", lambda row: row["all"]["position_mm"]),
    Panel("Image-Text Contrast", "train", lambda row: row.get("itc/loss")),
    Panel("Current-Goal Contrast", "train", lambda row: row.get("cgc/loss")),
)


@dataclass(frozen=True, kw_only=True)
class PlotConfig:
    """Draw the curves of training runs over core-minutes, into one picture."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders written by `python -m baselines.train`, finished or not."""

    out: Path = Path("curves.png")
    """The picture."""


def main(config: PlotConfig) -> None:
    """Read all runs, then draw.

    Raises:
        UsageError: a folder holds no run, or the picture cannot be written.
    """
    curves = read_runs(config.runs)
    with atomic_path(config.out) as draft:
        draw(curves).savefig(draft, format="png", dpi=110)
    print(f"Written: {config.out}")


def read_runs(folders: Sequence[Path]) -> dict[str, list[Row]]:
    """The metrics of each run under its folder's name, or whole path where names are shared.

    Raises:
        UsageError: as `read_metrics`.
    """
    names = [folder.name for folder in folders]
    return {
        folder.name if names.count(folder.name) == 1 else str(folder): read_metrics(folder)
        for folder in folders
    }


def read_metrics(folder: Path) -> list[Row]:
    """The rows of a run's metrics with their time as `core_min`, oldest first.

    Raises:
        UsageError: there are none, or none of training.
    """
    rows = read_rows(folder / METRICS)
    if not rows:
        raise UsageError(
            f"no training run in {folder}: expected {METRICS} with at least one line in it. "
            "Name the --out folders of `python -m baselines.train`."
        )
    # A validation has the time of the training row of its step.
    minutes = {row["step"]: row["cpu_s"] / 60 for row in rows if row["kind"] == "train"}
    if not minutes:
        raise UsageError(f"{folder} has no line of training yet. Try again a little later.")
    return [{**row, "core_min": minutes[row["step"]]} for row in rows if row["step"] in minutes]


def draw(curves: Mapping[str, Sequence[Row]]) -> Figure:
    """One line a run in each diagram; diagrams for which no run has a value stay away."""
    panels = [p for p in PANELS if any(_points(rows, p) for rows in curves.values())]
    figure = Figure(figsize=(11, 3 * ((len(panels) + 1) // 2)), layout="constrained")
    for place, panel in enumerate(panels):
        axes = figure.add_subplot((len(panels) + 1) // 2, 2, place + 1)
        for name, rows in curves.items():
            _line(axes, name, _points(rows, panel))
        axes.set(title=panel.title, xlabel="core-minutes")
        axes.grid(alpha=0.3)
    figure.axes[0].legend()
    return figure


def _points(rows: Sequence[Row], panel: Panel) -> list[tuple[float, float]]:
    found = [(row["core_min"], panel.value(row)) for row in rows if row["kind"] == panel.kind]
    return [(minutes, value) for minutes, value in found if value is not None]


def _line(axes: Axes, name: str, points: Sequence[tuple[float, float]]) -> None:
    # Drawn even without points, so that a run has the same colour in every diagram.
    axes.plot([x for x, _ in points], [y for _, y in points], label=name, marker=".", markersize=3)


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(PlotConfig)))
