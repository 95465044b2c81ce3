"""A copy of `metrics.jsonl` for TensorBoard: train with `--tensorboard`, then
`tensorboard --logdir runs/train`.
"""

import importlib.util
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sacil_tasks.errors import UsageError

EVENTS = "events"
"""Folder of event files in that of a run."""


def require_tensorboard() -> None:
    """Check that event files can be written.

    Raises:
        UsageError: tensorboardX is not installed.
    """
    if importlib.util.find_spec("tensorboardX") is None:
        raise UsageError(
            "--tensorboard needs the package tensorboardX. Install it, or leave the flag out: "
            "metrics.jsonl has the same numbers, and `python -m baselines.plot` draws them."
        )


@contextmanager
def event_log(folder: Path, *, after_step: int) -> Iterator[Callable[[Mapping[str, Any]], None]]:
    """What writes rows of metrics into a run's event files, within a few seconds or at the end."""
    from tensorboardX import SummaryWriter  # optional: `require_tensorboard`

    # A resumed run logs again what came after its last save: events from there on are hidden.
    writer = SummaryWriter(str(folder / EVENTS), purge_step=after_step + 1, flush_secs=5)

    def write(row: Mapping[str, Any]) -> None:
        for name, value in _scalars(row["kind"], row):
            writer.add_scalar(name, value, row["step"])

    try:
        yield write
    finally:
        writer.close()


def _scalars(name: str, value: Any) -> Iterator[tuple[str, float]]:
    """The numbers of a row under names like `val/all/position_mm`; of [right, of] the share."""
    match value:
        case bool() | str() | None:
            return
        case int() | float():
            yield name, value
        case [int(right), int(of)]:
            yield name, right / max(of, 1)
        case Mapping():
            for key, branch in value.items():
                if key != "step":
                    yield from _scalars(f"{name}/{key}", branch)
