"""What an environment costs: `python benchmarks/bench_envs.py`.

Each task in a process of its own. Creation counts from `gym.make` in a process that has imported
neither torch nor ManiSkill; a reset builds new geometry. Processor time of all threads, so that a
busy machine disturbs little; medians where something happens often.
"""

import resource
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from statistics import median

import gymnasium as gym
import tyro

from sacil_tasks.catalog import env_id, task_names
from sacil_tasks.errors import run_command

SETTLED = 30
"""Episodes after which everything has been loaded that is loaded once."""


@dataclass(frozen=True, kw_only=True)
class BenchConfig:
    """What to time."""

    tasks: tuple[str, ...] = task_names()
    """One line each."""

    episodes: int = 300
    """Episodes over which memory may not grow; 30 more come before them."""

    steps: int = 3
    """Control steps of an episode."""

    render: bool = False
    """Observe RGB-D from all four cameras at every reset and step."""


@dataclass(frozen=True)
class Costs:
    """What one task takes."""

    create_s: float
    reset_ms: float
    step_ms: float
    settled_mb: float
    """Resident memory after the first 30 episodes."""

    growth_mb: float
    """How much more it is after all episodes."""


def main(config: BenchConfig) -> None:
    """Time and print."""
    print(f"{'task':<22}{'create s':>10}{'reset ms':>10}{'step ms':>10}{'MB':>8}{'growth MB':>11}")
    for task in config.tasks:
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            costs = pool.submit(measure, task, config).result()
        print(
            f"{task:<22}{costs.create_s:>10.2f}{costs.reset_ms:>10.1f}{costs.step_ms:>10.2f}"
            f"{costs.settled_mb:>8.0f}{costs.growth_mb:>11.1f}"
        )


def measure(task: str, config: BenchConfig) -> Costs:
    """Create one environment and play episodes of random actions, each in a scene of its own."""
    view = {"obs_mode": "rgbd" if config.render else "none"}
    if not config.render:
        view["render_backend"] = "none"
    made: list[gym.Env] = []
    create_s = cpu_s(lambda: made.append(gym.make(f"sacil_tasks:{env_id(task)}", **view)))
    (env,) = made
    env.action_space.seed(0)
    resets_s, steps_s, settled_mb = [], [], 0.0
    for seed in range(SETTLED + config.episodes):
        if seed == SETTLED:
            settled_mb = resident_mb()
        resets_s.append(cpu_s(lambda seed=seed: env.reset(seed=seed)))
        for _ in range(config.steps):
            action = env.action_space.sample()
            steps_s.append(cpu_s(lambda action=action: env.step(action)))
    growth_mb = resident_mb() - settled_mb
    env.close()
    return Costs(create_s, 1e3 * median(resets_s), 1e3 * median(steps_s), settled_mb, growth_mb)


def cpu_s(work: Callable[[], object]) -> float:
    """Processor time that `work` takes."""
    started = time.process_time()
    work()
    return time.process_time() - started


def resident_mb() -> float:
    """Memory of this process that is in use."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(BenchConfig, description=__doc__)))
