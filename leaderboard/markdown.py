"""A table for people: percent with interval and count, notes, and what differences are worth."""

from collections.abc import Iterator, Mapping, Sequence

from leaderboard.layout import BEYOND, OTHER, PAPER, PROBE, Budget, Column, Layout
from leaderboard.paired import Comparison
from leaderboard.panel import Entrant, Rate
from leaderboard.scores import outdated
from leaderboard.sheets import BLOCKS, Sheet, budget, notes, percent, points

_HEADINGS = {
    PAPER: "",
    BEYOND: "## Beside the paper's rows",
    OTHER: "## Other agents",
    PROBE: "## Ceiling and floors\n\n\\* reads the simulator's state: not a contender.",
}

_ON_RATES = (
    "Success in percent (strict), its 95 % interval (Wilson; of a mean by adding squares), "
    "successes/episodes of all training seeds. Training time and samples are one network's."
)

_ON_DIFFERENCES = (
    "Differences are paired over the scenes that both agents met. Interval: bootstrap over "
    "training seeds, then scenes within tasks; with one seed each it says nothing of another "
    "training. p: sign-flip test on scenes, beside it adjusted (Holm) for the rows of this table. "
    "Detectable: the smallest true difference that would be found in 80 % of such experiments, at "
    "5 % over all rows."
)


def markdown(sheet: Sheet) -> str:
    """The whole page of one table."""
    parts = [f"# {sheet.layout.title}", _about(sheet), _ON_RATES]
    for block in BLOCKS:
        rows = list(sheet.rows(block))
        if rows:
            parts += filter(None, [_HEADINGS[block], _block(sheet, block, rows)])
    parts += _differences(sheet)
    remarks = list(_remarks(sheet))
    if remarks:
        parts += ["## Notes", "\n".join(remarks)]
    return "\n\n".join(parts) + "\n"


def _about(sheet: Sheet) -> str:
    scope = sheet.scope
    lines = [f"Partition {scope.partition}, split {scope.split}, scene set {scope.scene_set}."]
    if scope.partition != "test":
        lines += ["**Not test scenes: for decisions, never for a report.**"]
    for suite, panel in sheet.panels.items():
        lines += [f"Every network of the suite {suite}: {panel.terms}."] if panel.terms else []
    named = ", ".join(f"{task} {protocol}" for task, protocol in sheet.protocols.items())
    lines += [f"Protocols: {named or 'none'}."]
    if older := outdated(sheet.protocols, scope):
        lines += [f"**Not this code's protocol: {', '.join(older)}.**"]
    return " ".join(lines)


def _block(sheet: Sheet, block: str, rows: Sequence[Mapping[str, Entrant]]) -> str:
    lines = [[text for _, text in _cells(sheet.layout, row)] for row in rows]
    if block == PAPER and sheet.layout.improvement:
        lines.append(_improvement(sheet))
    return _grid([name for name, _ in _cells(sheet.layout, rows[0])], lines)


def _cells(layout: Layout, row: Mapping[str, Entrant]) -> Iterator[tuple[str, str]]:
    """Headings and texts of a line."""
    first = next(iter(row.values()))
    yield from zip(map(_title, layout.headings), map(_escaped, first.row.labels), strict=True)
    if not layout.named:
        yield "agent", first.row.agent + r"\*" * (first.row.block == PROBE)
    for column in layout.columns:
        if isinstance(column, Column):
            yield _title(column.name), _rate(row[column.suite].rate(column))
        else:
            yield from _budget(column, row[column.suite])


def _budget(column: Budget, entrant: Entrant) -> Iterator[tuple[str, str]]:
    for name, text in budget(entrant).items():
        yield _title(column.prefix + name), f"{int(text):,}" if text and name == "samples" else text


def _improvement(sheet: Sheet) -> list[str]:
    texts = ["improvement"]
    for column in sheet.layout.columns:
        if isinstance(column, Budget):
            texts += [""] * 3
            continue
        gain = sheet.improvement(column)
        texts.append("" if gain is None else f"{points(gain.difference)} ({_range(gain)})")
    return texts


def _differences(sheet: Sheet) -> Iterator[str]:
    """The block of comparisons: means over tasks only, the rest is in `comparisons.csv`."""
    shown = [it for it in sheet.comparisons if len(it.tasks) > 1]
    if not shown:
        return
    lines = [
        [
            it.agent,
            ", ".join(map(_title, it.tasks)),
            points(it.difference),
            _range(it),
            f"{it.p_value:.4f}",
            f"{it.p_holm:.4f}",
            "" if it.detectable is None else f"{100 * it.detectable:.1f}",
            str(it.scenes),
            f"{it.seeds[0]} and {it.seeds[1]}",
        ]
        for it in shown
    ]
    against = shown[0].against
    names = ["row", "tasks", f"minus {against}, points", "95 % interval", "p", "p (Holm)"]
    yield f"## Differences from {against}"
    yield _grid([*names, "detectable, points", "scenes", "seeds"], lines)
    yield _ON_DIFFERENCES


def _remarks(sheet: Sheet) -> Iterator[str]:
    for block in BLOCKS:
        for row in sheet.rows(block):
            found = [note for note in notes(row) if note != "no run"]
            if found:
                yield f"- {next(iter(row.values())).row.agent}: {'; '.join(found)}."


def _rate(rate: Rate | None) -> str:
    if rate is None:
        return ""
    low, high = rate.interval.low, rate.interval.high
    return f"{percent(rate.mean)} ({percent(low)}-{percent(high)}), {rate.total}"


def _range(comparison: Comparison) -> str:
    return f"{points(comparison.interval.low)} to {points(comparison.interval.high)}"


def _grid(names: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    rows = [names, ["---"] * len(names), *lines]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def _title(name: str) -> str:
    return name.replace("_", " ").replace("core minutes", "core-minutes")


def _escaped(label: str) -> str:
    return label.replace("*", r"\*").replace("|", r"\|")
