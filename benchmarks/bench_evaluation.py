"""Where the time of an evaluated episode goes: `python benchmarks/bench_evaluation.py --agent rvt`.

One worker plays episodes of `val`; medians over episodes, so that a busy machine disturbs little.
Nothing is kept.
"""

import tempfile
from dataclasses import dataclass
from pathlib import Path
from statistics import median

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
    """One line each."""

    episodes: int = 30
    """Per task."""


def main(config: BenchConfig) -> None:
    """Time and print, in milliseconds."""
    with tempfile.TemporaryDirectory() as folder:
        run.main(
            run.RunConfig(
                agent=config.agent,
                checkpoint=config.checkpoint,
                tasks=config.tasks,
                episodes=config.episodes,
                partition="val",
                workers=1,
                out=Path(folder),
            )
        )
        records = read_records(Path(folder, EPISODES_FILE))
    print(f"\n{'median ms':<20}" + "".join(f"{name:>11}" for name in (*PHASES, "rest", "total")))
    for task in config.tasks:
        print(line(task, [record for record in records if record.task == task]))
    keyframes = sum(record.keyframes for record in records)
    inference = sum(record.seconds.inference for record in records)
    print(f"inference per keyframe: {1000 * inference / max(keyframes, 1):.1f} ms")


def line(task: str, records: list[EpisodeRecord]) -> str:
    """Medians of one task; `rest` is what the harness itself takes."""
    spent = [record.seconds for record in records]
    phases = [median(getattr(seconds, name) for seconds in spent) for name in PHASES]
    times = [*phases, median(map(rest, spent)), median(seconds.total for seconds in spent)]
    return f"{task:<20}" + "".join(f"{1000 * seconds:>11.1f}" for seconds in times)


def rest(seconds: Seconds) -> float:
    """Seconds of an episode outside all phases."""
    return seconds.total - sum(getattr(seconds, name) for name in PHASES)


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(BenchConfig, description=__doc__)))
