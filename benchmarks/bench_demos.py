"""How fast demos are made, by worker count: `python benchmarks/bench_demos.py --workers 1 2`.

Twice: over all, start of the processes included, and once every worker has made its second demo.
Keyframes (four RGB-D cameras) are included. Nothing is kept.
"""

import resource
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import tyro

from sacil_tasks.demos import DemoJob
from sacil_tasks.errors import run_command
from sacil_tasks.gen_demos import EXPERT, GenConfig, plan
from sacil_tasks.workers import JobFailure, run_jobs


@dataclass(frozen=True, kw_only=True)
class BenchConfig:
    """What to time."""

    task: str = "pick_and_lift"
    """Whose demos."""

    demos: int = 60
    """For each number of workers."""

    workers: tuple[int, ...] = (1, 2)
    """Numbers of processes, one after the other."""


def main(config: BenchConfig) -> None:
    """Time and print; the ratio is of the running rates, against the first number of workers."""
    print(f"{config.task}, {config.demos} demos\nworkers  all/s  running/s  ratio")
    first = 0.0
    for workers in config.workers:
        done_s = finish_times_s(config.task, config.demos, workers)
        warm = 2 * workers
        running = (len(done_s) - warm) / (done_s[-1] - done_s[warm - 1])
        first = first or running
        overall = len(done_s) / done_s[-1]
        print(f"{workers:>7}  {overall:5.2f}  {running:9.2f}  {running / first:5.2f}")
    peak_mib = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    print(f"largest worker: {peak_mib:.0f} MiB")


def finish_times_s(task: str, count: int, workers: int) -> list[float]:
    """When each demo was ready, in seconds since the workers were asked for."""
    with tempfile.TemporaryDirectory() as folder:
        (demos,) = plan(GenConfig(tasks=(task,), out=Path(folder)))
        jobs = [DemoJob(demos, index) for index in range(count)]
        started = time.perf_counter()
        results = run_jobs(jobs, EXPERT, workers)
        return [
            time.perf_counter() - started
            for _, result in results
            if not isinstance(result, JobFailure)
        ]


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(BenchConfig, description=__doc__)))
