"""Evaluate an agent on the official scenes: `python -m leaderboard.run --agent sacil`.

Every agent meets the same scenes and words. Each episode becomes a line of OUT/episodes.jsonl as
it ends and OUT/summary.csv is the table. The same command again runs what is missing, and nothing
if nothing is.

Agents: oracle, hold, random and blind are built in; a file in baselines/agents or
sacil_agent/agents goes by its name (sacil, rvt, sacil:no_queries), an installed one by its entry
point (group sacil.agents), and any other as my_package.policy:load.
"""

import os
import shlex
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal, cast

import tyro
from tqdm import tqdm

from leaderboard import manifest as manifests
from leaderboard.agents import find_agent
from leaderboard.entry import Entry
from leaderboard.plan import SceneJob, plan_episodes, scene_jobs, whole_scenes
from leaderboard.protocol import EvalProtocol, protocol_name, protocol_of
from leaderboard.records import EpisodeKey, EpisodeLog, EpisodeRecord, doubts
from leaderboard.summary import console_table, write_summary
from leaderboard.training import Training
from leaderboard.worker import Choice, Look, Player
from sacil_tasks.catalog import suite_tasks, task_spec
from sacil_tasks.errors import UsageError, run_command
from sacil_tasks.splits import plan_splits
from sacil_tasks.workers import JobFailure, run_jobs

SUMMARY_FILE = "summary.csv"
VIDEO_FOLDER = "videos"


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """What to evaluate, on which scenes, and where to put the results."""

    agent: str
    """Name of the agent, `name:variant`, or `my_package.policy:load`."""

    suite: str = "slice"
    """Tasks to run: `slice` (the first three), `single`, `dual` or `all`."""

    tasks: tuple[str, ...] = ()
    """Tasks by name, e.g. `pick_and_lift push_buttons`; they replace the suite."""

    split: tuple[str, ...] = ("canon",)
    """Splits, e.g. `canon shift_down shift_up`, or `fine` for its series of ratios; an unknown name
    lists all. A split that a task lacks is n/a under a suite and refused with --tasks."""

    partition: Literal["test", "val"] = "test"
    """`val` is for decisions; `test` is for the one run whose numbers are reported."""

    episodes: int = 25
    """Episodes per task and split, rounded up to whole scenes (each scene under all its words)."""

    checkpoint: Path | None = None
    """Folder with trained weights; without it, the agent's released ones."""

    seed: int = 0
    """Scene set: 0 is the official one, any other an independent draw."""

    workers: int = min(2, os.cpu_count() or 1)
    """Processes that play episodes; results do not depend on it."""

    out: Path | None = None
    """Folder of the results; without it, one under runs/eval named after the choices above."""

    video: bool = False
    """Also film every episode, to OUT/videos (slow)."""


@dataclass(frozen=True)
class Job:
    """A checked configuration: every name is known and every task has every split."""

    choice: Choice
    keys: tuple[EpisodeKey, ...]
    protocols: dict[str, EvalProtocol]
    folder: Path
    missing: dict[tuple[str, str], str]
    """Task and split -> why there is no such pair."""

    @classmethod
    def of(cls, config: RunConfig) -> "Job":
        """Check a configuration; starts nothing.

        Raises:
            UsageError: a name is unknown, a task lacks a split, or a number makes no sense.
        """
        if config.workers < 1:
            raise UsageError(f"--workers must be at least 1, but {config.workers} came.")
        if config.checkpoint is not None and not config.checkpoint.exists():
            raise UsageError(f"there is no checkpoint at {config.checkpoint}.")
        agent = find_agent(config.agent)
        specs = [task_spec(task) for task in config.tasks or suite_tasks(config.suite)]
        pairs, missing = plan_splits(specs, config.split, strict=bool(config.tasks))
        keys = plan_episodes(pairs, config.partition, config.seed, config.episodes)
        protocols = {
            protocol_name(task, split): protocol_of(task, config.partition, config.seed, split)
            for task, split in pairs
        }
        tasks = tuple(dict.fromkeys(task for task, _ in pairs))
        choice = Choice(agent=agent, checkpoint=config.checkpoint, tasks=tasks)
        folder = config.out or default_folder(config)
        return cls(choice, tuple(keys), protocols, folder, missing)

    @property
    def splits(self) -> list[str]:
        """Splits of any task."""
        return sorted({key.split for key in self.keys})

    @property
    def not_there(self) -> list[str]:
        """One line for each pair that does not exist."""
        return [f"n/a  {task} {split}: {why}." for (task, split), why in self.missing.items()]


def default_folder(config: RunConfig) -> Path:
    """Where results go without --out; more tasks or episodes join the same folder."""
    agent = config.agent.replace(":", "-").replace(".", "-")
    weights = [config.checkpoint.resolve().name] if config.checkpoint else []
    splits = "+".join(dict.fromkeys(config.split))
    name = "-".join([agent, *weights, config.partition, splits, f"seed{config.seed}"])
    return Path("runs", "eval", name)


def command_line(config: RunConfig) -> str:
    """The command that asks for `config`, as a user would type it."""
    words = ["python", "-m", "leaderboard.run"]
    for field in fields(config):
        value = getattr(config, field.name)
        if value != field.default:
            values = value if isinstance(value, tuple) else () if value is True else (value,)
            words += [f"--{field.name}", *map(str, values)]
    return shlex.join(words).encode(errors="backslashreplace").decode()  # paths hold any bytes


def main(config: RunConfig) -> None:
    """Run what is missing, write the summary and print the table.

    Raises:
        UsageError: nothing can be run as asked; what is on disk stays as it was.
    """
    job = Job.of(config)
    _announce(config, job)
    look = _look(job)
    entry = Entry(
        agent=job.choice.agent.name,
        privileged=look.privileged,
        checkpoint=look.checkpoint,
        protocols={name: protocol.hash for name, protocol in job.protocols.items()},
    )
    ours = _manifest(config, job, entry, look.training)
    theirs = manifests.read_manifest(job.folder)
    if theirs is not None:
        manifests.check_same_run(job.folder, ours, theirs)
    with EpisodeLog(job.folder) as log:
        missing = _missing(job, log)
        if missing:
            manifests.write_manifest(job.folder, theirs.joined(ours) if theirs else ours)
            videos = job.folder / VIDEO_FOLDER if config.video else None
            _run(Player(job.choice, entry, videos), missing, log, config.workers)
        else:
            hint = " To film them, choose another folder with --out." if config.video else ""
            print(f"Nothing to do: all {len(job.keys)} episodes are in {job.folder}.{hint}")
        _report(job, log)
    if ours.test_runs > 1:
        print(
            f"note: {ours.test_runs} folders beside and including this one hold test episodes of "
            "these weights; numbers for a report come from one."
        )


def _announce(config: RunConfig, job: Job) -> None:
    rounded = {
        (key.task, whole_scenes(key.task, key.split, config.episodes)): None for key in job.keys
    }
    for task, whole in rounded:
        if whole != config.episodes:
            print(f"{task}: {config.episodes} episodes are rounded up to {whole}, whole scenes.")
    for line in job.not_there:
        print(line)


def _look(job: Job) -> Look:
    """Load the agent in a child process: its crash is a sentence, and torch stays out of here.

    Raises:
        UsageError: the agent cannot be loaded.
    """
    ((_, look),) = run_jobs([job.choice], "leaderboard.worker:looker", workers=1)
    if isinstance(look, JobFailure):
        raise UsageError(
            f"agent '{job.choice.agent.name}' failed while loading ({look.reason}); "
            f"nothing was run.\n{look.details}".rstrip()
        )
    return cast(Look, look)


def _manifest(
    config: RunConfig, job: Job, entry: Entry, training: Training | None
) -> manifests.Manifest:
    ours = manifests.Manifest(
        agent=entry.agent,
        privileged=entry.privileged,
        checkpoint=entry.checkpoint,
        partition=config.partition,
        scene_set=config.seed,
        splits=job.splits,
        protocols={name: protocol.described() for name, protocol in job.protocols.items()},
        commands=[command_line(config)],
        versions=manifests.installed_versions(),
        training=training,
    )
    return manifests.counted(job.folder, ours)


def _missing(job: Job, log: EpisodeLog) -> list[EpisodeKey]:
    done = {record.key for record in log.records}
    return [key for key in job.keys if key not in done]


def _run(player: Player, missing: Sequence[EpisodeKey], log: EpisodeLog, workers: int) -> None:
    successes = 0
    with tqdm(total=len(missing), unit="ep", disable=not sys.stderr.isatty()) as bar:
        for record in play(player, scene_jobs(missing), workers):
            log.append(record)
            successes += record.success
            bar.set_description(record.task)
            bar.update()
            bar.set_postfix_str(f"success {successes}/{bar.n}")


def play(player: Player, jobs: Sequence[SceneJob], workers: int) -> Iterator[EpisodeRecord]:
    """Records as they come. The episode that kills a worker is found and becomes an error.

    Raises:
        UsageError: no episode can run on this machine.
    """
    suspects: list[SceneJob] = []
    for job, result in run_jobs(jobs, player, workers):
        if not isinstance(result, JobFailure):
            yield from result
        elif result.died and len(job.keys) > 1:
            suspects += job.singly()
        else:
            yield from (player.entry.lost(key, result.reason) for key in job.keys)
    if suspects:
        yield from play(player, suspects, workers)


def _report(job: Job, log: EpisodeLog) -> None:
    write_summary(job.folder / SUMMARY_FILE, log.records)
    wanted = set(job.keys)
    ours = [record for record in log.records if record.key in wanted]
    print(console_table(ours))
    for line in job.not_there:
        print(line)
    errors = sum(record.errored for record in ours)
    if errors:
        example = next(record for record in ours if record.errored)
        print(f"{errors} episodes broke off and count as failures, e.g. {example.reason}")
    for warning in doubts(ours):
        print(f"warning: {warning}")
    if any(record.privileged for record in ours):
        print("* reads the simulator's state: a ceiling or a floor, not a contender.")
    print(f"Written: {job.folder / SUMMARY_FILE} and {log.path.name}")


if __name__ == "__main__":
    run_command(
        lambda: main(tyro.cli(RunConfig, prog="python -m leaderboard.run", description=__doc__)),
        after_stop="The same command again runs the missing episodes.",
    )
