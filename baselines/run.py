"""A training run in its folder: steps, log, validation, saves, a clean stop."""

import json
import logging
import math
import signal
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any, Literal, TypeAlias

import torch
from tqdm import tqdm

from baselines.agent import Network, find_agent
from baselines.checkpoint import METRICS, PROVENANCE, Plan, Progress, TrainState, save_weights
from baselines.distributed import anywhere, averaged, device_name, rank, ranks, wait_for_all
from baselines.trainer import Trainer
from sacil_tasks.errors import UsageError
from sacil_tasks.files import atomic_path, code_version, content_hash, unwritable, write_json
from sacil_tasks.typed import parsed

log = logging.getLogger(__name__)

HASH_LENGTH = 8

LOG_EVERY = 50
"""Steps of one line of `metrics.jsonl`."""

SAVE_EVERY_S = 60.0
"""Seconds of work a kill may cost."""

Row: TypeAlias = dict[str, Any]
Validator: TypeAlias = Callable[[Network], Row]


@dataclass(frozen=True)
class AnyRow:
    """What every line of `metrics.jsonl` has."""

    kind: Literal["train", "val"]
    step: int


@dataclass(frozen=True)
class TrainRow(AnyRow):
    """What lines about training have, among other means."""

    loss: float
    samples_per_s: float
    cpu_s: float


@dataclass(frozen=True)
class Scores:
    """What a validation says of all keyframes, among other scores."""

    position_mm: float
    selected_by_words: tuple[int, int]


@dataclass(frozen=True)
class ValRow(AnyRow):
    """What lines about validation have, among scores of tasks."""

    all: Scores


ROWS: Mapping[str, type[AnyRow]] = {"train": TrainRow, "val": ValRow}


@dataclass
class Means:
    """Averages of named scalars, each over the steps on which it existed (was not NaN)."""

    sums: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    counts: dict[str, int] = field(default_factory=lambda: defaultdict(int))

    def add(self, values: Mapping[str, float]) -> None:
        """Take in one step's values."""
        for name, value in values.items():
            if not math.isnan(value):
                self.sums[name] += value
                self.counts[name] += 1

    def take(self) -> dict[str, float]:
        """The averages so far; starts again at nothing."""
        means = {name: total / self.counts[name] for name, total in self.sums.items()}
        self.sums.clear()
        self.counts.clear()
        return means


class Run:
    """A trainer and its folder: carries a run to its end, or as far as it is let.

    Every rank has one; the first alone writes.
    """

    def __init__(
        self, trainer: Trainer, folder: Path, plan: Plan, *, validate: Validator | None
    ) -> None:
        """`plan` is what a resumed run must agree with; `validate` gives a row of metrics."""
        self.listeners: list[Callable[[Row], None]] = []
        """Told of every line of `metrics.jsonl`; on the first rank alone."""
        self.trainer = trainer
        self.folder = folder
        self.plan = plan
        self.wall_s = 0.0
        self.cpu_s = 0.0
        self._validate = validate
        self._means = Means()

    def resume(self, state: TrainState) -> None:
        """Take over from a saved state, and forget metrics that were logged after it.

        Raises:
            UsageError: the state is one of another network.
        """
        try:
            self.trainer.restore(state.tensors, state.progress.step)
        except ValueError as error:
            raise UsageError(
                f"{self.folder} holds the state of another network. Choose another --out."
            ) from error
        self.wall_s, self.cpu_s = state.progress.wall_s, state.progress.cpu_s
        if rank() == 0:
            trim_metrics(self.folder / METRICS, state.progress.step)

    def save(self) -> None:
        """Save the weights to evaluate and what is behind them, then the state.

        The state comes last: a run that says it is complete has its final weights.

        Raises:
            UsageError: a weight is not finite, or the folder cannot be written.
        """
        trainer = self.trainer
        trainer.check_finite()
        if rank() > 0:
            return
        save_weights(self.folder, trainer.averaged)
        write_json(self.folder / PROVENANCE, self._provenance())
        progress = Progress(step=trainer.step, wall_s=self.wall_s, cpu_s=self.cpu_s)
        TrainState(tensors=trainer.state(), progress=progress, plan=self.plan).save(self.folder)

    def finish(self, *, validate_every: int) -> None:
        """Train to the last step.

        Raises:
            KeyboardInterrupt: stopped by a signal, after saving.
            UsageError: loss or weights are not finite, or the folder cannot be written.
        """
        trainer, saved = self.trainer, time.monotonic()
        bar = tqdm(
            initial=trainer.step, total=trainer.steps, unit="step", mininterval=1.0, disable=None
        )
        done = trainer.step == trainer.steps
        with bar, deferred_signals() as signals:
            stopped = False
            while not (done or stopped):
                self._advance()
                bar.update()
                done = trainer.step == trainer.steps
                if validate_every and (done or trainer.step % validate_every == 0):
                    self._log_validation()
                stopped = anywhere(bool(signals))
                # State is saved only where a line is logged, so that the lines of a killed and
                # resumed run are those of an unbroken one.
                if done or stopped or trainer.step % LOG_EVERY == 0:
                    bar.set_postfix(loss=f"{self._log():.3f}")
                    if done or stopped or time.monotonic() - saved > SAVE_EVERY_S:
                        self.save()
                        saved = time.monotonic()
            if not done:
                log.info("saved step %d of %d in %s", trainer.step, trainer.steps, self.folder)
            wait_for_all()  # torchrun ends all ranks as soon as one leaves a stopped run
        if not done:
            raise KeyboardInterrupt

    def _advance(self) -> None:
        wall, cpu = time.perf_counter(), time.process_time()
        own = self.trainer.advance()
        terms = averaged(own | {"cpu_s": time.process_time() - cpu})
        self.cpu_s += ranks() * terms.pop("cpu_s")
        self._means.add(terms)
        self.wall_s += time.perf_counter() - wall

    def _provenance(self) -> Row:
        trainer, request = self.trainer, self.plan.request
        return {
            "agent": request["agent"],
            "preset": preset_name(request),
            "seed": request["seed"],
            "text": request["config"]["recipe"]["text"],
            "steps": trainer.step,
            "samples": trainer.step * trainer.recipe.batch,
            "complete": trainer.step == trainer.steps,
            "wall_minutes": round(self.wall_s / 60, 2),
            "core_minutes": round(self.cpu_s / 60, 2),
            "ranks": ranks(),
            "device": device_name(trainer.device),
            "keyframes_sha256": self.plan.keyframes,
            "code_version": code_version(),
            "torch": torch.__version__,
        }

    def _log(self) -> float:
        means = self._means.take()
        parts = {name: means.pop(name) for name in list(means) if name.startswith("seconds_")}
        total = sum(parts.values())
        shares = {n.replace("seconds", "share"): round(s / total, 4) for n, s in parts.items()}
        row = {"kind": "train", "step": self.trainer.step, "lr": self.trainer.lr, **means}
        pace = round(self.trainer.recipe.batch / total, 2)
        timing = {"samples_per_s": pace, "cpu_s": round(self.cpu_s, 1)}
        if rank() == 0:
            self._tell(row | timing | shares)
        return means["loss"]

    def _log_validation(self) -> None:
        if self._validate is None:
            return
        network = self.trainer.network
        raw = {name: tensor.clone() for name, tensor in network.state_dict().items()}
        network.load_state_dict(self.trainer.averaged)
        row = {"kind": "val", "step": self.trainer.step, **self._validate(network.eval())}
        network.load_state_dict(raw)
        network.train()
        self._tell(row)

    def _tell(self, row: Row) -> None:
        append_row(self.folder / METRICS, row)
        for listener in self.listeners:
            listener(row)


def preset_name(request: Mapping[str, Any]) -> str:
    """The preset of a run; where flags have changed its config, with that config's hash behind it.

    Tables put runs of one preset side by side and pool their seeds.
    """
    spec, variant = find_agent(request["agent"])
    config = asdict(spec.config(request["preset"], variant))
    del config["recipe"]["samples"]  # the budget is told apart
    if json.loads(json.dumps(config)) == request["config"]:
        return request["preset"]
    return f"{request['preset']}+{content_hash(request['config'])[:HASH_LENGTH]}"


def append_row(path: Path, row: Row) -> None:
    """Append one line of JSON.

    Raises:
        UsageError: the disk is full or gone.
    """
    try:
        with path.open("a") as file:
            file.write(json.dumps(row) + "\n")
    except OSError as error:
        raise unwritable(path, error) from error


def read_rows(path: Path) -> list[Row]:
    """All whole lines of a metrics file; a line cut off by a kill is left out.

    Raises:
        UsageError: a line is not one of ours.
    """
    if not path.is_file():
        return []
    lines = path.read_text(errors="replace").split("\n")[:-1]
    return [_row(path, number, line) for number, line in enumerate(lines, start=1)]


def _row(path: Path, number: int, line: str) -> Row:
    try:
        parsed(ROWS[parsed(AnyRow, line, extra="ignore").kind], line, extra="ignore")
    except ValueError as error:
        raise UsageError(
            f"{path} line {number} is not a line of training ({error}). The file is damaged or "
            "foreign: move it away."
        ) from error
    return json.loads(line)


def trim_metrics(path: Path, step: int) -> None:
    """Drop what was logged after `step`; a resumed run logs it again."""
    rows = [row for row in read_rows(path) if row["step"] <= step]
    with atomic_path(path) as draft:
        draft.write_text("".join(json.dumps(row) + "\n" for row in rows))


@contextmanager
def deferred_signals() -> Iterator[list[int]]:
    """Collect Ctrl-C and SIGTERM instead of raising in the middle of a step; the second raises.

    Not so under torchrun: it hands on what it gets, so a scheduler's signal can come twice, and it
    kills whoever takes too long.
    """
    received: list[int] = []

    def receive(number: int, _: FrameType | None) -> None:
        if received and ranks() == 1:
            raise KeyboardInterrupt
        received.append(number)

    before = {number: signal.signal(number, receive) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
