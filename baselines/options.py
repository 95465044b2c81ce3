"""The command line of training: shared flags first, then every field of the agent's config."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from baselines.agent import find_agent
from baselines.distributed import Device
from baselines.tensorboard import require_tensorboard
from sacil_tasks.catalog import suite_tasks, task_names
from sacil_tasks.errors import UsageError, find_name

DEFAULT_SUITE = "slice"

ABOUT = """Train an agent on keyframe files, or complete a run that was stopped.

Reads data/canon/train/keyframes/<task>.h5 and writes a checkpoint folder. Where
data/canon/val/keyframes exists, scores on its demos go into metrics.jsonl. Every field of the
agent's config is a flag: `--agent NAME --help` lists them. The simulator is never started.

`torchrun --nproc_per_node N -m baselines.train ...` shares every batch among N processes."""


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """What to train, on what, for how long."""

    agent: str
    """Agent, or `agent:variant`."""

    preset: str = "cpu"
    """Named config of the agent: `cpu` (two cores) or `paper` (the published sizes)."""

    suite: str | None = None
    """Train on all tasks of a suite; `slice` unless tasks are given."""

    tasks: tuple[str, ...] = ()
    """Train on these tasks."""

    minutes: float | None = None
    """Budget in minutes on this machine: the first steps are timed, the number of steps kept."""

    steps: int | None = None
    """Budget in steps."""

    samples: int | None = None
    """Budget in samples; the preset's unless another budget is given."""

    data: Path = Path("data")
    """Folder that `sacil_tasks.gen_demos` wrote."""

    out: Path | None = None
    """Checkpoint folder; by default under runs/train, named after agent, tasks, preset, seed."""

    seed: int = 0
    """Seed of initial weights, sampling, augmentation and dropout."""

    resume: bool = False
    """Go on with the unfinished run in the folder; a finished one has nothing to do."""

    threads: int = 1
    """Threads of torch; two runs with one thread each do more than one run with two."""

    device: Device = "auto"
    """Where to train; `auto` takes a GPU where there is one, under torchrun one a process."""

    validate_every: int = 1000
    """Steps between validations; 0 for none."""

    tensorboard: bool = False
    """Copy the metrics for TensorBoard into the folder's `events` (needs tensorboardX)."""

    def __post_init__(self) -> None:
        """Reject contradictions.

        Raises:
            UsageError: says which flags exclude each other, or which values they may have.
        """
        budgets = [self.minutes, self.steps, self.samples]
        if sum(budget is not None for budget in budgets) > 1:
            raise UsageError("--minutes, --steps and --samples exclude each other; give one.")
        if any(budget is not None and not 0 < budget < math.inf for budget in budgets):
            raise UsageError("--minutes, --steps and --samples must be above 0, and finite.")
        if self.threads < 1 or self.seed < 0 or self.validate_every < 0:
            raise UsageError("--threads must be above 0, --seed and --validate-every not below 0.")
        if self.seed >= 2**63:
            raise UsageError(f"--seed must be below 2^63, not {self.seed}.")
        if self.tensorboard:
            require_tensorboard()
        if self.suite is not None and self.tasks:
            raise UsageError("--suite and --tasks exclude each other; give one.")

    @property
    def chosen_tasks(self) -> tuple[str, ...]:
        """Tasks to train on.

        Raises:
            UsageError: no such task or suite.
        """
        for task in self.tasks:
            find_name(task, task_names(), "task")
        return tuple(dict.fromkeys(self.tasks)) or suite_tasks(self.suite or DEFAULT_SUITE)

    @property
    def folder(self) -> Path:
        """Checkpoint folder."""
        words = "+".join(self.tasks) or self.suite or DEFAULT_SUITE
        name = f"{self.agent.replace(':', '.')}-{words}-{self.preset}-seed{self.seed}"
        return self.out or Path("runs/train") / name


@dataclass(frozen=True)
class Job:
    """A command line that was understood: what to do, and the agent's config."""

    options: TrainConfig
    config: Any


def parse(args: Sequence[str]) -> Job:
    """Read a command line in two passes: `--agent` and `--preset` choose the other defaults.

    Raises:
        UsageError: unknown agent, variant or preset, or contradicting flags.
    """

    @dataclass
    class Choice:
        agent: str | None = None
        preset: str = "cpu"

    choice, _ = tyro.cli(Choice, args=args, return_unknown_args=True, add_help=False)
    if choice.agent is None:
        tyro.cli(TrainConfig, args=args, description=ABOUT)
        raise UsageError("--agent is required.")
    spec, variant = find_agent(choice.agent)
    config = spec.config(choice.preset, variant)
    flat = tyro.conf.arg(name="")
    job = dataclasses.make_dataclass(
        "Command",
        [
            ("options", Annotated[TrainConfig, flat]),
            ("config", Annotated[type(config), flat], field(default=config)),
        ],
        frozen=True,
    )
    command: Any = tyro.cli(job, args=args, description=ABOUT)
    spec.check_variant(variant, command.config)
    return Job(command.options, with_samples(command.config, command.options.samples))


def with_samples(config: Any, samples: int | None) -> Any:
    """An agent's config with another budget, or as it is."""
    if samples is None:
        return config
    return replace(config, recipe=replace(config.recipe, samples=samples))
