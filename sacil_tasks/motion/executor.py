"""From keyframes to control steps: plan, move, then the gripper acts, then everything settles."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import cast

import gymnasium as gym
import numpy as np
import pinocchio as pin
from jaxtyping import Float64
from mani_skill.envs.sapien_env import BaseEnv

from sacil_tasks.errors import UsageError
from sacil_tasks.interface import SCENE_BOUNDS, Keyframe
from sacil_tasks.motion.bodies import base_in_world, read_robot
from sacil_tasks.motion.collision import OPEN_M, CollisionWorld, MotionState
from sacil_tasks.motion.kinematics import ARM_JOINTS, JointPath, Joints, PandaArm
from sacil_tasks.motion.planner import Planner, Refusal, timed
from sacil_tasks.motion.shapes import to_se3


@dataclass(frozen=True, kw_only=True)
class ExecutorConfig:
    """When a motion counts as finished."""

    hold_steps: int = 10
    """Control steps that arm or fingers are waited for at most after their last target."""

    still: float = 5e-4
    """All stands still if no joint moves more in a control step (rad; fingers: m)."""

    arrived_rad: float = 2e-3
    """Farther from its target the arm may only be turning back from an overshoot."""


@dataclass(frozen=True)
class Plan:
    """How the arm will move."""

    path: JointPath
    """Waypoints; collision-free between them."""

    motion: JointPath
    """Where the joints should be after each control step."""


@dataclass(frozen=True)
class _Ahead:
    """What a sequence of keyframes leads to."""

    state: MotionState
    gripper_open: bool


class KeyframeExecutor:
    """Executes keyframes in one environment; experts and policies alike act through it.

    Call `begin` after every reset of the environment. All motion goes through `env.step`, so a
    wrapper that records actions records these.
    """

    def __init__(self, env: gym.Env, config: ExecutorConfig | None = None) -> None:
        """Act through `env` (wrapped or not), which must be single and driven by `pd_joint_pos`.

        Raises:
            UsageError: several parallel environments, or another controller.
        """
        self._env = env
        self._base = cast(BaseEnv, env.unwrapped)
        if self._base.num_envs != 1 or self._base.control_mode != "pd_joint_pos":
            raise UsageError(
                "keyframes are executed in one environment with control_mode='pd_joint_pos', got "
                f"{self._base.num_envs} with '{self._base.control_mode}'; make the env like that."
            )
        self._config = config or ExecutorConfig()
        self._arm = PandaArm()
        self._robot = read_robot(self._base)

    def begin(self) -> None:
        """Read the scene as it is now."""
        self.world = CollisionWorld(self._arm, self._robot, self._base)
        self._planner = Planner(self._arm, self.world)
        self._gripper_open = bool(self._fingers().mean() > 0.9 * OPEN_M)

    def plan(self, keyframe: Keyframe) -> Plan | Refusal:
        """How to reach a keyframe from the present state, or why that is impossible.

        A plan that respects collisions and fails is refused; it is never retried without.
        """
        path = self._path(keyframe, self.state())
        if isinstance(path, Refusal):
            return path
        return Plan(path, timed(path, self._base.control_freq))

    def execute(self, keyframe: Keyframe) -> Refusal | None:
        """Move the arm, then the gripper; a refusal means that nothing has moved."""
        plan = self.plan(keyframe)
        if isinstance(plan, Refusal):
            return plan
        for target in self._without_lag(plan.motion):
            self._step(target)
        self._hold(plan.motion[-1])
        if keyframe.gripper_open != self._gripper_open:
            self._gripper_open = keyframe.gripper_open
            self._hold(plan.motion[-1])
        return None

    def plan_sequence(self, keyframes: Sequence[Keyframe]) -> Refusal | None:
        """Whether all keyframes can be reached one after the other, without simulation."""
        return self.plan_sequences([keyframes])

    def plan_sequences(self, sequences: Iterable[Sequence[Keyframe]]) -> Refusal | None:
        """Whether every sequence can be followed from here; common beginnings are planned once.

        What is between the closing fingers goes with the hand until they open: a movable body
        wherever it goes, a drawer as far as it slides.
        """
        here = _Ahead(self.state(), self._gripper_open)
        known: dict[tuple[bytes, ...], _Ahead] = {}
        for keyframes in sequences:
            ahead = here
            done: tuple[bytes, ...] = ()
            for keyframe in keyframes:
                done = (*done, _fingerprint(keyframe))
                reached = known.get(done) or self._reach(keyframe, ahead)
                if isinstance(reached, Refusal):
                    return reached
                known[done] = ahead = reached
        return None

    def state(self) -> MotionState:
        """Where arm, fingers and bodies are now."""
        world_in_base = base_in_world(self._base).inverse()
        state = MotionState(
            joints=self._joints(),
            finger_m=float(self._fingers().mean()),
            bodies_in_base=tuple(
                world_in_base * to_se3(body.entity.pose) for body in self.world.bodies
            ),
            held=None,
        )
        if self._gripper_open:
            return state
        return replace(state, held=self.world.body_between_fingers(state))

    def _path(self, keyframe: Keyframe, state: MotionState) -> JointPath | Refusal:
        target = _to_pose(keyframe)
        if isinstance(target, Refusal):
            return target
        return self._planner.path(state, target, ignore_obstacles=keyframe.ignore_collisions)

    def _reach(self, keyframe: Keyframe, ahead: _Ahead) -> _Ahead | Refusal:
        path = self._path(keyframe, ahead.state)
        if isinstance(path, Refusal):
            return path
        state = self._after(ahead.state, path[-1])
        if keyframe.gripper_open != ahead.gripper_open:
            state = self._with_gripper(state, gripper_open=keyframe.gripper_open)
        return _Ahead(state, keyframe.gripper_open)

    def _after(self, state: MotionState, joints: Joints) -> MotionState:
        bodies = list(state.bodies_in_base)
        before, after = self._arm.tcp_in_base(state.joints), self._arm.tcp_in_base(joints)
        if state.held is not None:
            bodies[state.held] = after * before.inverse() * bodies[state.held]
        if state.pulled is not None:
            pose = bodies[state.pulled]
            axis = pose.rotation @ self.world.bodies[state.pulled].slides_along
            shift = axis * (axis @ (after.translation - before.translation))
            bodies[state.pulled] = pin.SE3(pose.rotation, pose.translation + shift)
        return replace(state, joints=joints, bodies_in_base=tuple(bodies))

    def _with_gripper(self, state: MotionState, *, gripper_open: bool) -> MotionState:
        if gripper_open:
            return replace(state, finger_m=OPEN_M, held=None, pulled=None)
        # The fingers stay apart in the plan: wider than they will be, so on the safe side.
        held = self.world.body_between_fingers(state)
        if held is not None:
            return replace(state, held=held)
        return replace(state, finger_m=0.0, pulled=self.world.drawer_between_fingers(state))

    def _without_lag(self, motion: JointPath) -> JointPath:
        """Targets that make the joints be where they should be after each control step.

        The PD controller is a spring and a damper that pull the arm's inertia. The damper makes
        it follow a target like a first-order lag of damping / stiffness seconds: left alone, it
        would trail by up to 0.12 rad. The inertia carries it on where it brakes: left alone, the
        tool would dip by up to 7 mm at the end of a descent. Either would leave the checked path.
        """
        agent, rate_hz = self._base.agent, self._base.control_freq
        before = np.concatenate([self._joints()[None], motion[:-1]])
        speeds = np.pad(motion - before, ((1, 1), (0, 0))) * rate_hz
        accelerations = np.gradient(speeds, axis=0)[1:-1] * rate_hz
        inertias = np.array([self._arm.inertia(joints) for joints in motion])
        lag_steps = agent.arm_damping / agent.arm_stiffness * rate_hz
        targets = before + (motion - before) / (1 - np.exp(-1 / lag_steps))
        targets += np.einsum("nij,nj->ni", inertias, accelerations) / agent.arm_stiffness
        return np.clip(targets, self._arm.lower, self._arm.upper)

    def _hold(self, target: Joints) -> None:
        """Keep the last target until arm and fingers stand still."""
        for _ in range(self._config.hold_steps):
            before = self._positions()
            self._step(target)
            moved, missing = self._positions() - before, self._joints() - target
            still = np.abs(moved).max() < self._config.still
            if still and np.abs(missing).max() < self._config.arrived_rad:
                return

    def _step(self, target: Joints) -> None:
        gripper = 1.0 if self._gripper_open else -1.0
        self._env.step(np.append(target, gripper).astype(np.float32))

    def _joints(self) -> Joints:
        # Pressed against a limit, a joint may end a hair beyond it, where no plan may start.
        return np.clip(self._positions()[:ARM_JOINTS], self._arm.lower, self._arm.upper)

    def _fingers(self) -> Float64[np.ndarray, "2"]:
        return self._positions()[ARM_JOINTS:]

    def _positions(self) -> Float64[np.ndarray, "9"]:
        return self._base.agent.robot.get_qpos()[0].numpy().astype(float)


def _fingerprint(keyframe: Keyframe) -> bytes:
    flags = bytes([keyframe.gripper_open, keyframe.ignore_collisions])
    return keyframe.position_m.tobytes() + keyframe.quaternion_wxyz.tobytes() + flags


def _to_pose(keyframe: Keyframe) -> pin.SE3 | Refusal:
    position = np.asarray(keyframe.position_m, dtype=float)
    quaternion = np.asarray(keyframe.quaternion_wxyz, dtype=float)
    length = np.linalg.norm(quaternion)
    if not (np.isfinite(position).all() and np.isfinite(quaternion).all() and length > 1e-6):
        return Refusal("not_finite")
    offset = np.abs(position - np.array(SCENE_BOUNDS.center_in_base)).max()
    if offset > SCENE_BOUNDS.side_m / 2:
        return Refusal("outside_workspace")
    w, x, y, z = (float(value) for value in quaternion / length)
    return pin.SE3(pin.Quaternion(w, x, y, z), position)
