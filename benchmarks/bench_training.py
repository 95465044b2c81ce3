"""How fast do the agents train? Whole steps: loading, views, losses, optimiser.

    python benchmarks/bench_training.py --data data [--agent sacil rvt ...] [--steps 20 ...]

Without `--agent`, all of them. Takes the flags of `baselines.train` (`--steps` says how many steps
are timed) and writes nothing but the embeddings into the keyframe files. Every agent has a process
of its own, so that its memory is its own; they take their steps in turns, so that a busy machine
disturbs all alike. Medians over steps; the first two, which compile, are left out. A loaded
machine shows in samples a second, not in samples a core-second.
"""

import argparse
import resource
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache
from multiprocessing import get_context
from statistics import median
from unittest.mock import patch

import torch
from torch import Tensor

from baselines.agent import agent_modules
from baselines.material import Material
from baselines.options import Job, parse
from baselines.scene.sight import Views, ZoomScene
from baselines.trainer import Trainer
from sacil_tasks.errors import run_command

WARM_UP = 2
STEPS = 20


@dataclass(frozen=True)
class Step:
    """What one step took."""

    wall_s: float
    core_s: float
    parts_s: dict[str, float]
    """Of the wall time."""


@dataclass(frozen=True)
class Size:
    """What an agent weighs."""

    parameters: int
    peak_gib: float


@cache
def trainer(args: tuple[str, ...]) -> Trainer:
    """This process's only trainer."""
    job = parse(args)
    torch.set_num_threads(job.options.threads)
    return Material.load(job).trainer(sys.maxsize)


def advance(args: tuple[str, ...]) -> Step:
    """Take and time one step; views drawn within the network (RVT-2's zoom) count as loading."""
    running, zooms_s = trainer(args), list[float]()

    def timed_closer(scene: ZoomScene, centers: Tensor, zoom: float) -> Views:
        start = time.perf_counter()
        views = closer(scene, centers, zoom)
        zooms_s.append(time.perf_counter() - start)
        return views

    closer = ZoomScene.closer
    wall, core = time.perf_counter(), time.process_time()
    with patch.object(ZoomScene, "closer", timed_closer):
        terms = running.advance()
    parts = {n.removeprefix("seconds_"): s for n, s in terms.items() if n.startswith("seconds_")}
    parts["loading"] += sum(zooms_s)
    parts["network"] -= sum(zooms_s)
    return Step(time.perf_counter() - wall, time.process_time() - core, parts)


def weigh(args: tuple[str, ...]) -> Size:
    """Look at the process after its steps."""
    parameters = sum(p.numel() for p in trainer(args).network.parameters())
    return Size(parameters, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20)


def line(job: Job, size: Size, steps: list[Step]) -> str:
    """One row of the table."""
    batch = job.config.recipe.batch
    paces = [batch / median(step.core_s for step in steps), batch / median(s.wall_s for s in steps)]
    shares = [median(step.parts_s[n] / step.wall_s for step in steps) for n in steps[0].parts_s]
    return (
        f"{job.options.agent:<14}{size.parameters:>13,}{batch:>7}"
        + "".join(f"{pace:>10.1f}" for pace in paces)
        + "".join(f"{share:>11.1%}" for share in shares)
        + f"{size.peak_gib:>8.2f}"
    )


def measure(commands: list[tuple[str, ...]], jobs: list[Job]) -> None:
    """Round after round, one step of each agent; then the table."""
    spawn = get_context("spawn")
    pools = [ProcessPoolExecutor(1, spawn) for _ in commands]
    steps: list[list[Step]] = [[] for _ in commands]
    for _ in range(WARM_UP + (jobs[0].options.steps or STEPS)):
        for pool, command, taken in zip(pools, commands, steps, strict=True):
            taken.append(pool.submit(advance, command).result())
    parts = "".join(f"{name:>11}" for name in steps[0][0].parts_s)
    print(f"{'':<14}{'':>13}{'':>7}{'samples':>10}{'samples':>10}")
    print(f"{'agent':<14}{'parameters':>13}{'batch':>7}{'/core-s':>10}{'/s':>10}{parts}{'GiB':>8}")
    for pool, command, job, taken in zip(pools, commands, jobs, steps, strict=True):
        print(line(job, pool.submit(weigh, command).result(), taken[WARM_UP:]))
        pool.shutdown()


def main(args: list[str]) -> None:
    """Read the agents, and leave the other flags to `baselines.train`."""
    chooser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    chooser.add_argument("--agent", nargs="+", default=sorted(agent_modules()))
    choice, rest = chooser.parse_known_args(args)
    commands = [("--agent", name, *rest) for name in choice.agent]
    measure(commands, [parse(command) for command in commands])


if __name__ == "__main__":
    run_command(lambda: main(sys.argv[1:]))
