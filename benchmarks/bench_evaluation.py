"""Where the time of an evaluated episode goes, and what a second worker adds.

    python benchmarks/bench_evaluation.py --agent rvt [--tasks pick_and_lift ...] [--rounds 3]
    python benchmarks/bench_evaluation.py --records results/test/rvt/episodes.jsonl

Plays the same episodes of `val` with one worker and with two, by turns, and keeps nothing. The
split is that of one worker: `setup` builds the scene, `planning` includes the expert's plans by
which a scene is accepted, `rest` is the harness itself. With `--records` nothing is played: the
split is that of episodes played before.
"""

import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean, median

import tyro

from leaderboard import run
from leaderboard.records import EPISODES_FILE, EpisodeRecord, Seconds, read_records
from sacil_tasks.errors import run_command

PHASES = ("setup", "planning", "physics", "rendering", "inference")


@dataclass(frozen=True, kw_only=True)
class BenchConfig:
    """What to time."""

    agent: str = "oracle"
    """As for leaderboard.run; oracle neither looks nor thinks."""

    checkpoint: Path | None = None
    """As for leaderboard.run."""

    tasks: tuple[str, ...] = ("pick_and_lift",)
    """Two lines each."""

    episodes: int = 30
    """Per task and round."""

    rounds: int = 1
    """With one worker, and with two."""

    records: Path | None = None
    """File of episodes whose seconds to split instead."""


@dataclass(frozen=True)
class Round:
    """The episodes of one run."""

    workers: int
    records: list[EpisodeRecord]

    wall_s: float
    """Of the whole command, start of the simulator included."""


def main(config: BenchConfig) -> None:
    """Time and print."""
    if config.records is not None:
        print_split(read_records(config.records))
        return
    pairs = [(play(config, 1), play(config, 2)) for _ in range(config.rounds)]
    alone, together = zip(*pairs, strict=True)
    print_split([record for played in alone for record in played.records])
    print("episodes a second       one worker  two workers")
    for name, speed in (("while they play", playing), ("with the start", whole)):
        one, two = median(map(speed, alone)), median(map(speed, together))
        print(f"{name:<22}{one:>12.2f}{two:>13.2f}{two / one:>8.2f}x")


def print_split(records: Sequence[EpisodeRecord]) -> None:
    """Two lines a task: milliseconds and shares."""
    print(f"\n{'':<30}" + "".join(f"{name:>11}" for name in (*PHASES, "rest", "total")))
    for task in dict.fromkeys(record.task for record in records):
        spent = [record.seconds for record in records if record.task == task]
        print(f"{task:<20}{'median ms':<10}{medians(spent)}")
        print(f"{'':<20}{'share':<10}{shares(spent)}")
    keyframes = sum(record.keyframes for record in records)
    inference = sum(record.seconds.inference for record in records)
    print(f"inference per keyframe: {1000 * inference / max(keyframes, 1):.1f} ms")


def play(config: BenchConfig, workers: int) -> Round:
    """All episodes once."""
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        run.main(
            run.RunConfig(
                agent=config.agent,
                checkpoint=config.checkpoint,
                tasks=config.tasks,
                episodes=config.episodes,
                partition="val",
                workers=workers,
                out=Path(folder),
            )
        )
        wall_s = time.perf_counter() - start
        return Round(workers, read_records(Path(folder, EPISODES_FILE)), wall_s)


def medians(spent: Sequence[Seconds]) -> str:
    """Milliseconds of each phase."""
    columns = [*zip(*map(phases, spent), strict=True), [seconds.total for seconds in spent]]
    return "".join(f"{1000 * median(column):>11.1f}" for column in columns)


def shares(spent: Sequence[Seconds]) -> str:
    """Each phase's part of the whole time."""
    total = sum(seconds.total for seconds in spent)
    sums = [sum(column) for column in zip(*map(phases, spent), strict=True)]
    return "".join(f"{phase / total:>11.1%}" for phase in (*sums, total))


def phases(seconds: Seconds) -> list[float]:
    """Seconds of each phase, and of what is outside all of them."""
    parts = [getattr(seconds, name) for name in PHASES]
    return [*parts, seconds.total - sum(parts)]


def playing(played: Round) -> float:
    """Episodes a second once all workers play."""
    return played.workers / mean(record.seconds.total for record in played.records)


def whole(played: Round) -> float:
    """Episodes a second of the whole command."""
    return len(played.records) / played.wall_s


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(BenchConfig, description=__doc__)))
