"""Checkpoint folders: what a training run leaves behind, and what an agent is loaded from.

```
model.safetensors        averaged weights: the ones that are evaluated
config.json              agent, preset, config, tasks, text encoder
text.safetensors         embeddings of the official sentences
provenance.json          data, budget, code and versions behind the weights
train_state.safetensors  everything a resumed run needs, in one file and so always consistent
metrics.jsonl            one line an event
```

No pickle: a checkpoint of a stranger can run no code. A released checkpoint is the first four
files in half precision, kept inside the package of its agent.
"""

import importlib.util
import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save

from baselines.agent import Network, agent_modules, find_agent
from baselines.configs import restore
from baselines.optim import TensorTable
from baselines.text import SentenceTable, TextSpec
from sacil_tasks.errors import UsageError
from sacil_tasks.files import atomic_path, content_hash, file_sha256, write_json
from sacil_tasks.typed import parsed

MODEL, CONFIG, TEXT = "model.safetensors", "config.json", "text.safetensors"
PROVENANCE, STATE, METRICS = "provenance.json", "train_state.safetensors", "metrics.jsonl"

KIND = "sacil-checkpoint"
SCHEMA_VERSION = 1


@dataclass(frozen=True, kw_only=True)
class Identity:
    """What a network is and what it was trained for: the content of `config.json`."""

    agent: str
    variant: str | None
    preset: str
    tasks: tuple[str, ...]
    text: TextSpec
    config: Any
    """The agent's own config dataclass."""

    @property
    def name(self) -> str:
        """The agent as on command lines, `agent` or `agent:variant`."""
        return f"{self.agent}:{self.variant}" if self.variant else self.agent

    def create(self) -> Network:
        """A freshly initialised network; draws from torch's global generator."""
        spec, _ = find_agent(self.agent)
        return spec.create(self.config, self.text)

    def save(self, folder: Path) -> None:
        """Write `config.json`."""
        head = {"kind": KIND, "schema_version": SCHEMA_VERSION}
        write_json(folder / CONFIG, head | asdict(self))

    @classmethod
    def load(cls, folder: Path) -> "Identity":
        """Read `config.json`.

        Raises:
            UsageError: no checkpoint, one of another version, or with fields that do not fit.
        """
        content = _read_json(folder / CONFIG)
        if content.pop("kind", None) != KIND:
            raise UsageError(f"{folder / CONFIG} is not the config of a checkpoint.")
        version = content.pop("schema_version", None)
        if version != SCHEMA_VERSION:
            raise UsageError(
                f"{folder} has checkpoint version {version}, this code reads {SCHEMA_VERSION}. "
                "Train again, or use the code that wrote it."
            )
        spec, _ = find_agent(str(content.get("agent")))
        kinds = {"config": type(next(iter(spec.presets.values())))}
        identity = restore(cls, content, str(folder / CONFIG), kinds)
        spec.check_variant(identity.variant, identity.config)
        return identity


@dataclass(frozen=True, kw_only=True)
class Checkpoint:
    """A trained network, ready to act."""

    identity: Identity
    network: Network
    text: SentenceTable
    sha256: str


def load(folder: Path, *, agent: str, tasks: Sequence[str] = ()) -> Checkpoint:
    """Load the network of `agent` (or `agent:variant`) for `tasks`.

    Raises:
        UsageError: missing, truncated or foreign files, another agent, a task it was not trained
            on, another text encoder, or a config that does not fit the weights.
    """
    identity = Identity.load(folder)
    _check_fit(identity, folder, agent=agent, tasks=tasks)
    text = SentenceTable.load(folder / TEXT)
    if text.spec != identity.text:
        raise UsageError(
            f"{folder / TEXT} was made by the text encoder {text.spec.short}, but the network was "
            f"trained on {identity.text.short}. Copy the checkpoint again."
        )
    with _readable(folder / MODEL):
        weights = load_file(folder / MODEL)
    network = identity.create().eval()
    fill(network, weights, folder / MODEL)
    return Checkpoint(identity=identity, network=network, text=text, sha256=sha256(folder))


def sha256(folder: Path) -> str:
    """Names the checkpoint in results: a hash of weights and config."""
    return content_hash([file_sha256(folder / name) for name in (MODEL, CONFIG)])


def save_weights(folder: Path, weights: TensorTable) -> None:
    """Write `model.safetensors`."""
    content = save({name: tensor.contiguous() for name, tensor in weights.items()})
    with atomic_path(folder / MODEL) as draft:
        draft.write_bytes(content)


def fill(network: Network, weights: TensorTable, source: Path) -> None:
    """Copy `weights` into `network`, in the network's precision.

    Raises:
        UsageError: a tensor is missing, unknown or of another shape.
    """
    try:
        network.load_state_dict(weights)
    except RuntimeError as error:
        first = str(error).splitlines()[1:2] or [str(error)]
        raise UsageError(
            f"{source} does not fit its config ({first[0].strip()}). "
            "Train again, or use the code that wrote it."
        ) from error


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What was agreed when a run began, and a resumed one must agree with."""

    steps: int

    request: Mapping[str, Any]
    """What was asked for, apart from the budget."""

    keyframes: Mapping[str, str]
    """Task -> content hash of its keyframes."""

    text: TextSpec
    """By which words are read."""


@dataclass(frozen=True, kw_only=True)
class Progress:
    """How far a run has come."""

    step: int
    wall_s: float
    cpu_s: float


@dataclass(frozen=True, kw_only=True)
class TrainState:
    """Where a run stands: all tensors, how far it has come, and what was agreed at its start."""

    tensors: TensorTable
    progress: Progress
    plan: Plan

    def save(self, folder: Path) -> None:
        """Write `train_state.safetensors`."""
        metadata = {name: json.dumps(asdict(getattr(self, name))) for name in ("progress", "plan")}
        with atomic_path(folder / STATE) as draft:
            draft.write_bytes(save(self.tensors, metadata))

    @classmethod
    def load(cls, folder: Path) -> "TrainState | None":
        """Read the state of the run in `folder`, or None where no run has begun.

        Raises:
            UsageError: truncated or foreign file.
        """
        path = folder / STATE
        if not path.is_file():
            return None
        with _readable(path), safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
            progress = parsed(Progress, metadata["progress"])
            plan = parsed(Plan, metadata["plan"])
            if not 0 <= progress.step <= plan.steps >= 1:
                raise ValueError(f"step {progress.step} of {plan.steps}")
            if not (progress.wall_s >= 0 and progress.cpu_s >= 0):  # NaN is neither
                raise ValueError(f"{progress.wall_s} s on {progress.cpu_s} s of a core")
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        return cls(tensors=tensors, progress=progress, plan=plan)


@dataclass(frozen=True)
class _Seen:
    """What `provenance.json` says of the samples behind weights."""

    samples: int | None = None


def trained_samples(folder: Path) -> int:
    """Samples that the weights in `folder` have seen; 0 where there are none, or untrained ones."""
    if not (folder / MODEL).is_file() or not (folder / PROVENANCE).is_file():
        return 0
    with _readable(folder / PROVENANCE):
        seen = parsed(_Seen, (folder / PROVENANCE).read_text(), extra="ignore")
    return seen.samples or 0


def export_release(run: Path, target: Path) -> None:
    """Copy the checkpoint of a finished run in half precision, without its training state.

    Raises:
        UsageError: `run` holds no finished checkpoint, or one that does not load; nothing has been
            written then. Or `target` cannot be written.
    """
    identity = Identity.load(run)
    if _read_json(run / PROVENANCE).get("complete") is not True:
        raise UsageError(f"the run in {run} is not finished. Complete it with --resume first.")
    weights = load(run, agent=identity.name).network.state_dict()
    halves = {n: t.half() if t.is_floating_point() else t for n, t in weights.items()}
    if not all(bool(half.isfinite().all()) for half in halves.values()):
        raise UsageError(f"weights in {run} are too large for half precision. Train again.")
    identity.save(target)
    for name in (TEXT, PROVENANCE):
        with atomic_path(target / name) as draft:
            shutil.copyfile(run / name, draft)
    save_weights(target, halves)


def find_released(agent: str, tasks: Sequence[str]) -> Path:
    """The released checkpoint of `agent` (or `agent:variant`) that covers `tasks`.

    Raises:
        UsageError: none does.
    """
    spec, _ = find_agent(agent)
    for config in sorted(released_folder(spec.name).glob(f"*/{CONFIG}")):
        identity = Identity.load(config.parent)
        if identity.name == agent and set(tasks) <= set(identity.tasks):
            return config.parent
    raise UsageError(
        f"no released checkpoint of {agent} covers {', '.join(tasks)}. Train one with "
        f"`python -m baselines.train --agent {agent} --tasks {' '.join(tasks)}` "
        "and pass its folder with --checkpoint."
    )


def released_folder(agent: str) -> Path:
    """Where the package of `agent` keeps its released checkpoints, one folder a suite."""
    package = importlib.util.find_spec(agent_modules()[agent].partition(".")[0])
    if package is None or package.origin is None:
        raise UsageError(f"the package of the agent {agent} has no folder.")
    return Path(package.origin).parent / "released" / agent


def _check_fit(identity: Identity, folder: Path, *, agent: str, tasks: Sequence[str]) -> None:
    if identity.name != agent:
        raise UsageError(
            f"{folder} is a checkpoint of {identity.name}, not of {agent}. "
            f"Pass --agent {identity.name}, or another --checkpoint."
        )
    unseen = [task for task in tasks if task not in identity.tasks]
    if unseen:
        raise UsageError(
            f"{folder} was trained on {', '.join(identity.tasks)}, not on {', '.join(unseen)}. "
            "Choose its tasks with --tasks, or pass another --checkpoint."
        )


def _read_json(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise UsageError(f"no checkpoint in {path.parent}: expected {path.name} there.")
    with _readable(path):
        content = json.loads(path.read_text())
        if not isinstance(content, dict):
            raise ValueError("not an object")
    return content


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Turn what goes wrong while reading `path` into one sentence."""
    try:
        yield
    except (OSError, SafetensorError, KeyError, ValueError, RecursionError) as error:
        reason = "missing" if not path.is_file() else f"truncated or foreign ({error})"
        raise UsageError(
            f"{path} is {reason}. Copy the checkpoint again, or train again."
        ) from error
