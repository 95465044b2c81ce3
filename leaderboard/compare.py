"""Watch agents at work in one scene: `python -m leaderboard.compare --agents sacil rvt`.

As figure 3 of the paper: a strip of photographs for each agent, one after each keyframe, and how
far the keyframe is from the expert's, in millimetres and degrees. White cross: the expert's
position; disc: the agent's, green where the two are aligned (20 mm, 15 degrees and the same
gripper) and red where not. Keyframes are compared by their number.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import tyro

from leaderboard.agents import find_agent
from leaderboard.plan import words_per_scene
from leaderboard.protocol import protocol_name
from leaderboard.records import EpisodeKey
from leaderboard.retrace import Case, Traced
from leaderboard.strip import Course, Image, draw
from leaderboard.worker import Choice
from sacil_tasks.catalog import task_spec
from sacil_tasks.errors import UsageError, run_command
from sacil_tasks.files import atomic_path
from sacil_tasks.splits import check_split
from sacil_tasks.workers import JobFailure, run_jobs


@dataclass(frozen=True, kw_only=True)
class CompareConfig:
    """Which agents to watch, in which scene."""

    agents: tuple[str, ...] = ("sacil", "rvt")
    """Names as in `leaderboard.run`, a row each; probes (oracle, blind) too."""

    task: str = "pick_and_lift"
    """Task by name."""

    scene: int = 0
    """Index of the scene, as in `episodes.jsonl`."""

    variation: int = 0
    """Index of the words within the scene, as in `episodes.jsonl`."""

    split: str = "canon"
    """Split by name."""

    partition: Literal["test", "val"] = "val"
    """`val`, unless a strip of a reported episode is wanted."""

    seed: int = 0
    """Scene set: 0 is the official one."""

    checkpoints: tuple[Path, ...] = ()
    """Folders with trained weights, one for each agent; without them, the released ones."""

    workers: int = 1
    """Agents that play at the same time."""

    out: Path | None = None
    """PNG to write; without it, one under runs/compare named after the choices above."""


def main(config: CompareConfig) -> None:
    """Play the scene with every agent, print the deviations and draw the strips.

    Raises:
        UsageError: a name or number is wrong, or an agent cannot be loaded.
    """
    cases = cases_of(config)
    traced = _play(cases, config.workers)
    for one in traced:
        if one.course is None:
            raise UsageError(f"{one.record.agent} broke off at once: {one.record.reason}")
    courses = [one.course for one in traced if one.course is not None]
    key = cases[0].key
    words = traced[0].record.instruction
    print(f"{key.task}, {key.split}, {key.partition} scene {key.scene}: {words}")
    for line in deviations(courses):
        print(line)
    path = config.out or default_path(config)
    _save(path, draw(f"{words} ({key.partition} scene {key.scene})", courses))
    print(f"Written: {path}")


def cases_of(config: CompareConfig) -> list[Case]:
    """A checked case for each agent; starts nothing.

    Raises:
        UsageError: a name is unknown, or a number makes no sense.
    """
    spec = task_spec(config.task)
    check_split(spec, config.split)
    words = words_per_scene(config.task, config.split)
    if not 0 <= config.variation < words:
        raise UsageError(
            f"--variation must be 0 to {words - 1} for {config.task}, but {config.variation} came."
        )
    if config.scene < 0 or config.workers < 1 or not config.agents:
        raise UsageError("--scene starts at 0, --workers at 1, and --agents names at least one.")
    checkpoints = config.checkpoints or (None,) * len(config.agents)
    if len(checkpoints) != len(config.agents):
        raise UsageError(
            f"--checkpoints names {len(checkpoints)} folders for {len(config.agents)} agents; "
            "name one for each, in their order, or none."
        )
    where = (config.task, config.split, config.partition, config.seed)
    key = EpisodeKey(*where, config.scene, config.variation)
    name = protocol_name(config.task, config.split)
    return [
        Case(Choice(agent=find_agent(agent), checkpoint=folder, tasks=(config.task,)), key, name)
        for agent, folder in zip(config.agents, checkpoints, strict=True)
    ]


def deviations(courses: Sequence[Course]) -> Iterator[str]:
    """Lines that say, agent by agent, how far each keyframe is from the expert's."""
    for course in courses:
        yield course.title
        for number, step in enumerate(course.steps):
            deviation = course.deviation(number)
            text = "beyond the expert's last" if deviation is None else str(deviation)
            verdict = "" if deviation is None else "aligned" if deviation.aligned else "DEVIATES"
            refused = f"refused: {step.refusal}" if step.refusal else ""
            yield f"  keyframe {number + 1:2}  {text:<36}  {verdict:<8}  {refused}".rstrip()


def default_path(config: CompareConfig) -> Path:
    """Where the picture goes without --out."""
    agents = "-".join(agent.replace(":", "_").replace(".", "_") for agent in config.agents)
    where = f"{config.task}-{config.split}-{config.partition}{config.seed}"
    return Path("runs", "compare", f"{where}-{config.scene:04d}-{config.variation}-{agents}.png")


def _play(cases: Sequence[Case], workers: int) -> list[Traced]:
    """What each agent did, in the order of `cases`.

    Raises:
        UsageError: an agent cannot be loaded, or its process died.
    """
    found = {}
    for case, result in run_jobs(cases, "leaderboard.retrace:tracer", min(workers, len(cases))):
        if isinstance(result, JobFailure):
            raise UsageError(
                f"{case.choice.agent.name} failed ({result.reason}).\n{result.details}".rstrip()
            )
        found[id(case)] = result
    return [found[id(case)] for case in cases]


def _save(path: Path, picture: Image) -> None:
    encoded = cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1]
    with atomic_path(path) as draft:
        draft.write_bytes(encoded.tobytes())


if __name__ == "__main__":
    run_command(
        lambda: main(
            tyro.cli(CompareConfig, prog="python -m leaderboard.compare", description=__doc__)
        )
    )
