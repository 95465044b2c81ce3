"""Play one episode as the evaluation does, and photograph every keyframe. Runs in a child process.

`tracer` is a handler factory for `sacil_tasks.workers.run_jobs`; the simulator is imported there.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from leaderboard.entry import Entry
from leaderboard.records import EpisodeKey, EpisodeRecord
from leaderboard.strip import Camera, Course, Image, Step, columns_of
from leaderboard.worker import Choice
from sacil_tasks.interface import Keyframe

if TYPE_CHECKING:
    from sacil_tasks.episode import Stage


@dataclass(frozen=True)
class Case:
    """An agent in a scene."""

    choice: Choice
    key: EpisodeKey
    protocol: str


@dataclass(frozen=True)
class Traced:
    """What came of a case."""

    record: EpisodeRecord
    course: Course | None
    """None if it broke off before the scene stood."""


@dataclass
class Photographer:
    """Watches an episode: a photograph before the first keyframe and after each that is shown."""

    start: Image | None = None
    steps: list[Step] = field(default_factory=list)
    expert: list[Keyframe] = field(default_factory=list)
    camera: Camera | None = None

    def begun(self, stage: "Stage") -> None:
        """Ask the expert for its plan and photograph the start."""
        self.expert = [stage.expert_keyframe(k) for k in range(stage.spec.keyframes)]
        self.camera = _camera(stage)
        self.start = _photo(stage)

    def moved(self, stage: "Stage", keyframe: Keyframe, refusal: str | None) -> None:
        """Note what the agent asked for and photograph what came of it."""
        shown = len(self.steps) < columns_of(self.expert)
        self.steps.append(Step(keyframe, refusal, _photo(stage) if shown else None))

    def course(self, record: EpisodeRecord) -> Course | None:
        """What was seen."""
        if self.camera is None or self.start is None:
            return None
        took = ", ".join(record.handled) or "nothing"
        title = f"{record.agent}: {record.outcome}, took {took}"
        return Course(title, self.start, self.steps, self.expert, self.camera)


def tracer() -> Callable[[Case], Traced]:
    """Handler of cases."""
    return trace


def trace(case: Case) -> Traced:
    """Play a case.

    Raises:
        UsageError: the agent cannot be loaded, or nothing here can render.
    """
    from leaderboard.rollout import run_episode  # the simulator, in the child only
    from sacil_tasks.episode import Stage

    choice = case.choice
    policy = choice.agent.load(checkpoint=choice.checkpoint, tasks=choice.tasks)
    entry = Entry(
        agent=choice.agent.name,
        privileged=bool(getattr(policy, "privileged", False)),
        checkpoint=getattr(policy, "checkpoint_sha256", None),
        protocols={case.protocol: case.protocol},
    )
    stage, photographer = Stage(case.key.task), Photographer()
    record = run_episode(stage, policy, entry, case.key, photographer)
    stage.close()
    return Traced(record, photographer.course(record))


def _photo(stage: "Stage") -> Image:
    image: Image = stage.env.render_rgb_array()[0].cpu().numpy()
    return image


def _camera(stage: "Stage") -> Camera:
    """The spectator's camera."""
    (camera,) = stage.env.scene.human_render_cameras.values()
    params = {name: value[0].cpu().numpy() for name, value in camera.get_params().items()}
    world_to_camera = params["extrinsic_cv"].astype(np.float64)
    base = np.append(stage.env.base_in_world_m, 1.0)
    rotation = world_to_camera[:3, :3]
    return Camera(
        intrinsic=params["intrinsic_cv"].astype(np.float64),
        base_to_camera=np.column_stack([rotation, world_to_camera[:3] @ base]),
    )
