"""Scene + words -> an episode that keyframes act on. Demos and evaluation both run on a `Stage`.

A scene index names the first of its attempts in which the expert can plan *every* variation, at
canonical sizes, from the home pose. So which scene it is depends on no word, split or worker.
"""

import hashlib
import json
import time
from collections import defaultdict
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from sacil_tasks.cameras import observe
from sacil_tasks.catalog import env_id, task_spec
from sacil_tasks.demos import ENV_KWARGS
from sacil_tasks.instructions import Slots, variations
from sacil_tasks.interface import MAX_KEYFRAMES, Keyframe, Observation
from sacil_tasks.motion.executor import KeyframeExecutor
from sacil_tasks.outcomes import Outcome
from sacil_tasks.recording import StepRecorder
from sacil_tasks.scenes import ATTEMPTS, scene_seed
from sacil_tasks.table import SizedTableEnv
from sacil_tasks.vulkan import explain_render_failure
from sacil_tasks.wording import draw_meaning


@dataclass(frozen=True)
class SceneKey:
    """Name of a scene."""

    task: str
    partition: str
    scene_set: int
    index: int


@dataclass(frozen=True)
class StepResult:
    """What one keyframe led to, after everything has settled."""

    refusal: str | None
    """Why the keyframe was not executed, or None."""

    success: bool
    """The task is solved and nothing unnamed was disturbed."""

    success_lenient: bool
    """The task is solved."""


class Stage:
    """One environment with an arm that takes keyframes; runs episode after episode."""

    def __init__(self, task: str, *, render: bool = True) -> None:
        """Start the simulator; without `render`, `observe` is not available.

        Raises:
            UsageError: the task is unknown, or nothing here can render.
        """
        self.task = task
        self.spec = task_spec(task)
        self.recorder = StepRecorder(_make(task, render=render))
        self.env: SizedTableEnv = self.recorder.unwrapped  # type: ignore[assignment]
        self.attempt = 0
        """Attempts of the running scene that were rejected, for the acceptance rate."""
        self.seed = 0
        """Environment seed of the running episode."""
        self.options: dict[str, Any] = {}
        """Reset options of the running episode."""
        self._executor = KeyframeExecutor(self.recorder)
        self._accepted: dict[SceneKey, int] = {}
        self._seconds: dict[str, float] = defaultdict(float)
        self._steps = 0
        self._gripper_open = True

    @property
    def seconds(self) -> dict[str, float]:
        """Seconds spent so far on scenes (their reset), planning (also to accept a scene), physics
        and rendering."""
        spent = dict(self._seconds) | {"physics": self.recorder.physics_s}
        planning = spent.pop("execution", 0.0) + spent.pop("acceptance", 0.0)
        return spent | {"planning": planning - self.recorder.physics_s}

    def begin(
        self, scene: SceneKey, *, variation: int, template: int | None = None, split: str = "canon"
    ) -> str:
        """Start an episode and return its instruction.

        `template` None: as the scene's instruction stream draws it.
        """
        slots = variations(self.spec, split)[variation]
        known = scene in self._accepted
        if not known:
            self._accepted[scene] = self._find_attempt(scene, slots, template)
        if known or split != "canon":
            self._reset(scene, self._accepted[scene], slots, template, split)
        return self.env.get_language_instruction()[0]

    def observe(self) -> Observation:
        """Render all cameras now."""
        started = time.perf_counter()
        observation = observe(
            self.env, step=self._steps, max_steps=MAX_KEYFRAMES, gripper_open=self._gripper_open
        )
        self._seconds["rendering"] += time.perf_counter() - started
        return observation

    def execute(self, keyframe: Keyframe) -> StepResult:
        """Plan, move, set the gripper and let everything settle."""
        started = time.perf_counter()
        refusal = self._executor.execute(keyframe)
        self._seconds["execution"] += time.perf_counter() - started
        self._steps += 1
        if refusal is None:
            self._gripper_open = keyframe.gripper_open
        state = self.env.evaluate()
        return StepResult(
            refusal=None if refusal is None else refusal.reason,
            success=bool(state["success"]),
            success_lenient=bool(state["success_lenient"]),
        )

    def expert_keyframe(self, index: int, choice: tuple[int, ...] | None = None) -> Keyframe:
        """Keyframe `index` of the expert, who handles the candidates `choice`: those named."""
        return self.env.expert_keyframe(index, choice or self.env.target_order())

    def outcome(self) -> Outcome:
        """What has happened so far."""
        return self.env.outcome()

    def fingerprint(self) -> str:
        """Hash of sizes, states (rounded to 1e-6) and words: equal scenes have equal ones."""
        state = self.env.get_state_dict()
        bodies = state["actors"] | state["articulations"]
        numbers = {name: values[0].numpy() for name, values in bodies.items()}
        numbers["sizes_m"] = self.env.sizes_m
        # Adding 0 turns -0 into 0, which is the same number but another text.
        rounded = {name: (np.round(v, 6) + 0.0).tolist() for name, v in sorted(numbers.items())}
        content = json.dumps([rounded, self.env.get_language_instruction()])
        return hashlib.sha256(content.encode()).hexdigest()

    def close(self) -> None:
        """Stop the simulator."""
        self.recorder.close()

    def _find_attempt(self, scene: SceneKey, slots: Slots, template: int | None) -> int:
        """The first attempt that the expert can plan; it has been reset."""
        for attempt in range(ATTEMPTS):
            self._reset(scene, attempt, slots, template, "canon")
            started = time.perf_counter()
            refusal = self._executor.plan_sequences(map(self._expert, variations(self.spec)))
            self._seconds["acceptance"] += time.perf_counter() - started
            self.env.ask(slots)
            if refusal is None:
                return attempt
        raise RuntimeError(f"the expert can plan none of the {ATTEMPTS} attempts of {scene}")

    def _reset(
        self, scene: SceneKey, attempt: int, slots: Slots, template: int | None, split: str
    ) -> None:
        started = time.perf_counter()
        self.attempt = attempt
        self.seed = scene_seed(scene.partition, scene.scene_set, scene.task, scene.index, attempt)
        if template is None:
            template = draw_meaning(self.spec, split, self.seed)[1]
        self.options = {"slots": slots, "template": template, "split": split}
        self.recorder.reset(seed=self.seed, options=dict(self.options))
        self._executor.begin()
        self._steps, self._gripper_open = 0, True
        self._seconds["scenes"] += time.perf_counter() - started

    def _expert(self, words: Slots) -> list[Keyframe]:
        """All keyframes of the expert if `words` were asked for."""
        self.env.ask(words)
        return [self.expert_keyframe(k) for k in range(self.spec.keyframes)]


def _make(task: str, *, render: bool) -> gym.Env:
    try:
        backend = "cpu" if render else "none"
        return gym.make(env_id(task), render_backend=backend, **ENV_KWARGS).unwrapped
    except RuntimeError as error:
        raise explain_render_failure(error) from error
