"""How long the expert's keyframes take to plan: `python benchmarks/bench_planning.py`.

One core, nothing rendered. Medians of processor time, so that a busy machine disturbs little.
"""

import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median

import gymnasium as gym
import numpy as np
import tyro

from sacil_tasks.catalog import env_id, suite_tasks, task_spec
from sacil_tasks.demos import ENV_KWARGS
from sacil_tasks.errors import run_command
from sacil_tasks.motion.executor import KeyframeExecutor

CHECKS = 200


@dataclass(frozen=True, kw_only=True)
class BenchConfig:
    """What to time."""

    tasks: tuple[str, ...] = suite_tasks("slice")
    """One line each."""

    scenes: int = 20
    """Per task."""


def main(config: BenchConfig) -> None:
    """Time and print."""
    print(f"{'task':<16}{'begin ms':>12}{'plan ms':>12}{'p95':>8}{'chain ms':>12}{'check us':>12}")
    for task in config.tasks:
        spent = time_task(task, config.scenes)
        begin, plan, chain, check = (
            median(spent[name]) for name in ("begin", "plan", "chain", "check")
        )
        slow = np.percentile(spent["plan"], 95)
        print(f"{task:<16}{begin:12.1f}{plan:12.1f}{slow:8.1f}{chain:12.1f}{1000 * check:12.1f}")


def time_task(task: str, scenes: int) -> dict[str, list[float]]:
    """Milliseconds: scene set-up, a keyframe planned, one of a chain, one collision check."""
    env = gym.make(env_id(task), render_backend="none", **ENV_KWARGS)
    env.reset(seed=0)
    executor = KeyframeExecutor(env)
    spent = defaultdict(list)
    for seed in range(scenes):
        env.reset(seed=seed)
        spent["begin"].append(cpu_ms(executor.begin))
        base = env.unwrapped
        count, choice = task_spec(task).keyframes, base.target_order()
        keyframes = [base.expert_keyframe(index, choice) for index in range(count)]
        chain_ms = cpu_ms(lambda keyframes=keyframes: executor.plan_sequence(keyframes))
        spent["chain"].append(chain_ms / count)
        for keyframe in keyframes:
            spent["plan"].append(cpu_ms(lambda keyframe=keyframe: executor.plan(keyframe)))
            executor.execute(keyframe)
        spent["check"].append(cpu_ms(lambda: check_often(executor)) / CHECKS)
    env.close()
    return spent


def check_often(executor: KeyframeExecutor) -> None:
    """`CHECKS` collision checks around the present joints."""
    state = executor.state()
    executor.world.set_state(state)
    spread = np.random.default_rng(0).normal(scale=0.1, size=(CHECKS, len(state.joints)))
    for joints in state.joints + spread:
        executor.world.is_free(joints)


def cpu_ms(work: Callable[[], object]) -> float:
    """Processor time that `work` takes."""
    started = time.process_time()
    work()
    return 1000 * (time.process_time() - started)


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(BenchConfig)))
