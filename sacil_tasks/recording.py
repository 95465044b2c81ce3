"""Control steps -> a trajectory in ManiSkill's terms: actions, states and success of each step."""

import time
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from mani_skill.envs.sapien_env import BaseEnv

from sacil_tasks.demos import StateTree, Trajectory


class StepRecorder(gym.Wrapper):
    """Keeps what happens between two resets and how long physics took.

    Actions are rounded to float32 before the step, so that a replay of the stored ones is exact.
    """

    def __init__(self, env: gym.Env) -> None:
        """Record `env`; states only while `keep_states` is set."""
        super().__init__(env)
        self._base: BaseEnv = env.unwrapped  # type: ignore[assignment]
        self.keep_states = False
        self.physics_s = 0.0
        """Seconds spent in `step` since construction."""
        self._clear()

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Start a new recording."""
        answer = super().reset(**kwargs)
        self._clear()
        self._note_state()
        return answer

    def step(self, action: np.ndarray) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Step and note the action and its success."""
        started = time.perf_counter()
        rounded = np.asarray(action, np.float32)
        answer = super().step(rounded)
        self.physics_s += time.perf_counter() - started
        self._actions.append(rounded)
        self._success.append(bool(answer[4]["success"]))
        self._note_state()
        return answer

    def trajectory(self) -> Trajectory:
        """Everything since the last reset."""
        return Trajectory(
            actions=np.stack(self._actions),
            success=np.array(self._success),
            states=_stack(self._states),
        )

    def _clear(self) -> None:
        self._actions: list[np.ndarray] = []
        self._success: list[bool] = []
        self._states: list[StateTree] = []

    def _note_state(self) -> None:
        if self.keep_states:
            self._states.append(_to_numpy(self._base.get_state_dict()))


def _to_numpy(tree: Any) -> Any:
    if isinstance(tree, dict):
        return {name: _to_numpy(branch) for name, branch in tree.items()}
    return np.array(tree[0])


def _stack(states: list[StateTree]) -> StateTree:
    if not states:
        return {}
    return {
        name: _stack([state[name] for state in states])
        if isinstance(states[0][name], dict)
        else np.stack([state[name] for state in states])
        for name in states[0]
    }
