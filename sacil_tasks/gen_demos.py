"""Generate motion-planned demonstrations: `python -m sacil_tasks.gen_demos`.

Demo i shows scene i with variation i mod V. Where the expert fails, the demo is drawn again with
the same variation in another scene, so that the words stay balanced; every failure is stored.
Demos do not depend on the number of workers. Killed at any instant, the same command resumes;
a larger `--demos` extends what is there.
"""

import os
import sys
import time
from collections.abc import Generator, Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Literal

import tyro
from tqdm import tqdm

from sacil_tasks.catalog import suite_tasks, task_spec
from sacil_tasks.demos import (
    MAX_FAILURES,
    DemoJob,
    DemoSet,
    count_merged,
    drop_parts,
    expert_summary,
    has_part,
    merge,
    read_records,
)
from sacil_tasks.errors import UsageError, run_command
from sacil_tasks.files import atomic_path, code_version, sole_writer
from sacil_tasks.splits import plan_splits
from sacil_tasks.workers import JobFailure, run_jobs

EXPERT = "sacil_tasks.expert:Demonstrator"
"""What works in the worker processes; it imports the simulator."""


@dataclass(frozen=True, kw_only=True)
class GenConfig:
    """Generate demonstrations, and from them the keyframes that training reads.

    Killed or stopped, the same command resumes; a larger --demos extends what is there.
    """

    tasks: tuple[str, ...] = ()
    """Tasks by name; they override the suite."""

    suite: str = "all"
    """A group of tasks: slice, single, dual or all."""

    demos: int = 100
    """Demos per task."""

    split: str = "canon"
    """Split, e.g. canon, shift_down or mixed; fine for its series of ratios. An unknown name lists
    all. A split that a task lacks is n/a under a suite and refused with --tasks."""

    partition: Literal["train", "val"] = "train"
    """Scenes to draw from; there are no demos of test scenes."""

    seed: int = 0
    """Scene set; 0 is the official one."""

    out: Path = Path("data")
    """Folder of all data."""

    workers: int = os.cpu_count() or 1
    """Processes; the demos are the same for any number."""


def main(config: GenConfig) -> None:
    """Make what is missing, merge it and print how the expert fared.

    Raises:
        UsageError: a name is unknown, files are in the way, or demos could not be made.
    """
    sets = plan(config)
    with ExitStack() as held:
        for demos in sets:
            held.enter_context(sole_writer(demos.folder))
        lost = make(sets, config)
    _report([demos for demos in sets if demos not in {job.demos for job in lost}])
    if lost:
        raise UsageError(
            f"{len(lost)} demos could not be made in {MAX_FAILURES} scenes each; the first is "
            f"demo {lost[0].index} of {lost[0].demos.task} ({lost[0].failures[-1].reason}). "
            "The others are kept and the same command tries again."
        )


def plan(config: GenConfig) -> list[DemoSet]:
    """Resolve names and folders, before any simulator starts.

    Raises:
        UsageError: a name or number is wrong, or the output folder cannot be written.
    """
    specs = [task_spec(task) for task in config.tasks or suite_tasks(config.suite)]
    pairs, missing = plan_splits(specs, [config.split], strict=bool(config.tasks))
    for (task, split), reason in missing.items():
        print(f"n/a  {task} {split}: {reason}.")
    if config.demos < 1 or config.workers < 1:
        raise UsageError(
            f"--demos and --workers are at least 1, but {config.demos} and {config.workers} came."
        )
    _check_writable(config.out)
    return [
        DemoSet(
            out=config.out,
            task=task,
            split=split,
            partition=config.partition,
            scene_set=config.seed,
            code_version=code_version(),
        )
        for task, split in pairs
    ]


def make(sets: Sequence[DemoSet], config: GenConfig) -> list[DemoJob]:
    """Make what is missing, merging each task as soon as it has all; return the jobs given up.

    Raises:
        UsageError: nothing can be made on this machine, or files are in the way.
    """
    missing = {demos: missing_jobs(demos, config.demos) for demos in sets}
    left = {demos: len(jobs) for demos, jobs in missing.items()}
    for demos in sets:
        if not left[demos]:  # stopped between the last demo and the merge, or finished before
            finish(demos, config.demos)
    jobs, lost = list(chain.from_iterable(missing.values())), []
    started = time.perf_counter()
    with closing(generate(jobs, config.workers)) as ended:
        for job in ended:
            left[job.demos] -= not job.given_up
            if job.given_up:
                lost.append(job)
            elif not left[job.demos]:
                finish(job.demos, config.demos)
    if jobs:
        seconds = time.perf_counter() - started
        print(f"{len(jobs)} demos in {seconds:.0f} s: {len(jobs) / seconds:.2f} demos/s")
    return lost


def missing_jobs(demos: DemoSet, count: int) -> list[DemoJob]:
    """Demos that are neither merged nor waiting as parts."""
    wanted = range(count_merged(demos), count)
    return [DemoJob(demos, index) for index in wanted if not has_part(demos, index)]


def generate(jobs: Sequence[DemoJob], workers: int) -> Generator[DemoJob, None, None]:
    """Make the parts of all jobs; yield each job when its part is there or it is given up.

    Raises:
        UsageError: nothing can be made on this machine.
    """
    made, trials = 0, 0
    with tqdm(total=len(jobs), unit="demo", disable=not sys.stderr.isatty()) as bar:
        while jobs:
            again = []
            for job, failure in _tried(jobs, workers):
                if failure is None:
                    made, trials = made + 1, trials + 1 + len(job.failures)
                    bar.set_postfix_str(f"expert {made}/{trials}", refresh=False)
                    bar.update()
                else:
                    bar.write(f"demo {job.index} of {job.demos.task}: {failure}", sys.stderr)
                if failure is None or job.given_up:
                    yield job
                else:
                    again.append(job)
            jobs = again


def finish(demos: DemoSet, count: int) -> None:
    """Merge the parts, unless they have been merged already."""
    if count_merged(demos) < count:
        merge(demos, count)
    drop_parts(demos)


def _tried(jobs: Sequence[DemoJob], workers: int) -> Iterator[tuple[DemoJob, str | None]]:
    """Run all jobs once; yield each with the scenes it failed in, and why it is not made yet."""
    with closing(run_jobs(jobs, EXPERT, workers)) as results:
        for job, result in results:
            if isinstance(result, JobFailure):
                yield job.after(result), result.reason
            else:
                tried = replace(job, failures=result)
                yield tried, f"given up ({result[-1].reason})" if tried.given_up else None


def _report(sets: Sequence[DemoSet]) -> None:
    """Print one row a task: how the expert fared, in all and by size, and what it takes on disk."""
    for demos in sets:
        expert = expert_summary(read_records(demos.folder))
        by_size = ", ".join(
            f"{size} {tally['successes']}/{tally['trials']}"
            for size, tally in expert["by_size"].items()
        )
        print(
            f"{demos.task:18} {demos.split} {demos.partition}: {expert['successes']} demos, "
            f"expert {expert['successes']}/{expert['trials']} ({by_size}), "
            f"scenes accepted {expert['scenes_accepted']}/{expert['scenes_drawn']}, "
            f"{demos.keyframes.stat().st_size / 1e6:.1f} MB in {demos.keyframes}"
        )


def _check_writable(folder: Path) -> None:
    probe = folder / ".writable"
    with atomic_path(probe) as draft:
        draft.touch()
    probe.unlink()


if __name__ == "__main__":
    run_command(
        lambda: main(tyro.cli(GenConfig)),
        after_stop="The same command again makes the missing demos.",
    )
