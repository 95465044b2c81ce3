"""One episode: a stage, an agent and an episode key -> an `EpisodeRecord`.

Whatever the agent does ends as a record: an exception is an error, a keyframe that is not finite,
out of reach or in collision is an invalid action. Both count as failures.
"""

import hashlib
import time
import traceback
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np
import sapien

from leaderboard.entry import Entry
from leaderboard.film import Film
from leaderboard.plan import SceneJob
from leaderboard.probes import Probe
from leaderboard.records import (
    BROKE_OFF,
    ERROR,
    INVALID_ACTION,
    LIMIT,
    SUCCEEDED,
    EpisodeKey,
    EpisodeRecord,
    Seconds,
)
from sacil_tasks.aim import nearest
from sacil_tasks.episode import SceneKey, Stage
from sacil_tasks.errors import UsageError
from sacil_tasks.interface import MAX_KEYFRAMES, Keyframe, Memory, Policy


@dataclass
class _Course:
    """How far an episode has come; filled as it goes, so that an exception loses nothing."""

    end: str = LIMIT
    reason: str = ""
    keyframes: int = 0
    success: bool = False
    success_lenient: bool = False
    aimed: str = ""
    pixels: str = ""
    renderer: str = ""
    inference_s: float = 0.0


class Witness(Protocol):
    """Sees an episode as it is played; changes nothing."""

    def begun(self, stage: Stage) -> None:
        """The scene stands."""

    def moved(self, stage: Stage, keyframe: Keyframe, refusal: str | None) -> None:
        """A keyframe was executed, or refused."""


class SceneRunner:
    """Plays scene after scene with one agent; keeps a stage while its task lasts."""

    def __init__(self, policy: Policy | Probe, entry: Entry, videos: Path | None) -> None:
        """Nothing is started yet; `videos` is the folder for one video per episode, or None."""
        self._policy, self._entry, self._videos = policy, entry, videos
        self._stage: Stage | None = None
        self._film: Film | None = None

    def play(self, job: SceneJob) -> list[EpisodeRecord]:
        """The records of one scene.

        Raises:
            UsageError: this machine cannot run the simulator.
        """
        return [self._play_one(key) for key in job.keys]

    def _play_one(self, key: EpisodeKey) -> EpisodeRecord:
        record = run_episode(self._stage_for(key.task), self._policy, self._entry, key)
        if self._film is not None:
            self._film.save(record)
        return record

    def _stage_for(self, task: str) -> Stage:
        if self._stage is None or self._stage.task != task:
            if self._stage is not None:
                self._stage.close()
            # Probes do not look, so they run where nothing can render.
            render = self._videos is not None or not self._entry.privileged
            self._stage = Stage(task, render=render)
            self._film = Film.of(self._stage, self._videos) if self._videos else None
        return self._stage


def run_episode(
    stage: Stage,
    policy: Policy | Probe,
    entry: Entry,
    key: EpisodeKey,
    witness: Witness | None = None,
) -> EpisodeRecord:
    """Play one episode; an exception on the way becomes part of the record.

    Raises:
        UsageError: this machine cannot run the simulator.
    """
    started, before = time.perf_counter(), stage.seconds
    course, facts = _Course(), dict[str, Any]()
    try:
        facts |= _set(stage, key)
        if witness is not None:
            witness.begun(stage)
        memory = _begin(stage, policy, entry, key, facts["instruction"])
        for keyframe in _play(stage, policy, memory, course, privileged=entry.privileged):
            if witness is not None:
                witness.moved(stage, keyframe, course.reason or None)
        facts |= _judge(stage)
    except UsageError:
        raise
    except Exception as error:
        course.end, course.reason = BROKE_OFF, describe(error)
        course.success = course.success_lenient = False
        facts |= {"outcome": ERROR, "asked": (), "handled": ()}
    seconds = _seconds(started, before, stage.seconds, course)
    return EpisodeRecord(**entry.identity(key), **facts, **_result(course), seconds=seconds)


def describe(error: Exception) -> str:
    """One line: what was raised and where."""
    frames = traceback.extract_tb(error.__traceback__)
    place = f" ({Path(frames[-1].filename).name}:{frames[-1].lineno})" if frames else ""
    words = f"{type(error).__name__}: {' '.join(str(error).split())}{place}"
    return words.encode(errors="backslashreplace").decode()  # file names may hold any bytes


@cache
def renderer() -> str:
    """Name of the Vulkan device that draws."""
    lines = sapien.render.get_device_summary().splitlines()
    return "; ".join(line.removeprefix("GPU: ") for line in lines if line.startswith("GPU: "))


def episode_rng(agent: str, key: EpisodeKey) -> np.random.Generator:
    """The random stream of an agent in one episode, a function of their names."""
    name = "/".join(map(str, (agent, *key)))
    return np.random.default_rng(list(hashlib.sha256(name.encode()).digest()))


def _set(stage: Stage, key: EpisodeKey) -> dict[str, Any]:
    scene = SceneKey(key.task, key.partition, key.scene_set, key.scene)
    return {
        "instruction": stage.begin(scene, variation=key.variation, split=key.split),
        "sizes_m": tuple(round(float(size), 6) for size in np.ravel(stage.env.sizes_m)),
        "fingerprint": stage.fingerprint(),
    }


def _begin(
    stage: Stage, policy: Policy | Probe, entry: Entry, key: EpisodeKey, instruction: str
) -> Memory:
    if entry.privileged:
        return cast(Probe, policy).begin_on(stage, episode_rng(entry.agent, key))
    return cast(Policy, policy).begin(instruction)


def _play(
    stage: Stage, policy: Policy | Probe, memory: Memory, course: _Course, *, privileged: bool
) -> Iterator[Keyframe]:
    """Yield keyframe after keyframe, each when it has been executed or refused, until the first
    lenient success, a refusal or the limit."""
    for _ in range(MAX_KEYFRAMES):
        if privileged:
            move = cast(Probe, policy).act_on(stage, memory)
        else:
            move = _look_and_act(stage, cast(Policy, policy), memory, course)
        if move is None:
            return
        keyframe, memory = move
        course.aimed = course.aimed or aim(stage, keyframe)
        result = stage.execute(keyframe)
        if result.refusal is not None:
            course.end, course.reason = INVALID_ACTION, result.refusal
            yield keyframe
            return
        course.keyframes += 1
        course.success, course.success_lenient = result.success, result.success_lenient
        if result.success_lenient:
            course.end = SUCCEEDED
        yield keyframe
        if result.success_lenient:
            return


def aim(stage: Stage, keyframe: Keyframe) -> str:
    """Label of what a closing keyframe is near to, `clutter`, or nothing."""
    if keyframe.gripper_open:
        return ""
    clutter = stage.env.clutter_in_base()
    names = (*stage.env.candidate_labels, *["clutter"] * len(clutter))
    objects = np.concatenate([stage.env.candidate_in_base(), clutter])
    found = nearest(objects, np.asarray(keyframe.position_m))
    return "" if found is None else names[found]


def _look_and_act(
    stage: Stage, policy: Policy, memory: Memory, course: _Course
) -> tuple[Keyframe, Memory]:
    observation = stage.observe()
    if not course.pixels:
        course.pixels = hashlib.sha256(observation.rgb.tobytes()).hexdigest()
        course.renderer = renderer()
    started = time.perf_counter()
    (keyframe,), (memory,) = policy.act([observation], [memory])  # official: a batch of one
    course.inference_s += time.perf_counter() - started
    return keyframe, memory


def _judge(stage: Stage) -> dict[str, Any]:
    outcome = stage.outcome()
    return {"outcome": outcome.code, "asked": outcome.asked, "handled": outcome.handled}


def _result(course: _Course) -> dict[str, Any]:
    return {field.name: getattr(course, field.name) for field in fields(course)[:-1]}


def _seconds(
    started: float, before: Mapping[str, float], after: Mapping[str, float], course: _Course
) -> Seconds:
    spent = {phase: round(after[phase] - before.get(phase, 0.0), 4) for phase in after}
    return Seconds(
        total=round(time.perf_counter() - started, 4),
        setup=spent.get("scenes", 0.0),
        planning=spent.get("planning", 0.0),
        physics=spent.get("physics", 0.0),
        rendering=spent.get("rendering", 0.0),
        inference=round(course.inference_s, 4),
    )
