"""Collision-free joint paths to a pose, and their timing.

First a straight line of the tool, then a straight joint segment, then OMPL's RRT-Connect. Every
plan is a function of its arguments alone: limits count iterations, never seconds, and every
random stream starts anew with each plan.
"""

import atexit
import gc
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
import pinocchio as pin
import toppra
from ompl import base, geometric, util
from toppra.algorithm import TOPPRA
from toppra.constraint import (
    Constraint,
    JointAccelerationConstraint,
    JointVelocityConstraint,
)

from sacil_tasks.motion.collision import CHECK_RAD, CollisionWorld, MotionState
from sacil_tasks.motion.kinematics import ARM_JOINTS, HALF_TURN, Joints, PandaArm, Path

# Seeding anew for each plan makes OMPL log an error each time; its streams do restart.
util.setLogLevel(util.LOG_NONE)
toppra.setup_logging("ERROR")
# Objects frozen out of garbage collection look like leaks to OMPL's bindings, which say so at exit.
atexit.register(gc.unfreeze)


@dataclass(frozen=True, kw_only=True)
class PlannerConfig:
    """Search effort."""

    range_rad: float = 0.5
    """Longest edge of an RRT-Connect tree."""

    iterations: int = 1000
    """RRT-Connect iterations before a goal is given up."""

    goals: int = 3
    """Inverse kinematics solutions that RRT-Connect tries."""

    seed: int = 1
    """OMPL's seed, set anew before every search."""


@dataclass(frozen=True, kw_only=True)
class TimingConfig:
    """Speed of the arm."""

    velocity_rad_s: float = 1.2
    """Largest speed of any joint: 0.06 rad per control step at 20 Hz."""

    acceleration_rad_s2: float = 5.0
    """Largest acceleration of any joint."""

    gridpoint_rad: float = 0.05
    """Joint distance between two grid points of the time-optimal parametrisation."""


@dataclass(frozen=True)
class Refusal:
    """Why a keyframe cannot be executed."""

    reason: Literal["not_finite", "outside_workspace", "no_ik", "in_collision", "no_path"]


class Planner:
    """Joint paths in one scene."""

    def __init__(
        self, arm: PandaArm, world: CollisionWorld, config: PlannerConfig | None = None
    ) -> None:
        """Plan for `arm` within `world`."""
        self._arm = arm
        self._world = world
        self._config = config or PlannerConfig()

    def path(
        self, state: MotionState, target: pin.SE3, *, ignore_obstacles: bool
    ) -> Path | Refusal:
        """A path from the state's joints to the pose or its half turn about the tool axis.

        The gripper is symmetric, so both poses grasp alike: the one nearer by rotation comes
        first along a straight line, the one nearer in joint space in a search.
        """
        self._world.set_state(state, ignore_obstacles=ignore_obstacles)
        straight = self._straight_tool_path(state.joints, target)
        if straight is not None:
            return straight
        goals = self._arm.goals(target, state.joints)
        if not goals:
            return Refusal("no_ik")
        free = [goal for goal in goals if self._world.open_corridor(state.joints, goal)]
        if not free:
            return Refusal("in_collision")
        return self._joint_path(state.joints, free)

    def _straight_tool_path(self, start: Joints, target: pin.SE3) -> Path | None:
        rotation = self._arm.tcp_in_base(start).rotation
        poses = sorted(
            (target, target * HALF_TURN),
            key=lambda pose: float(np.linalg.norm(pin.log3(rotation.T @ pose.rotation))),
        )
        for pose in poses:
            path = self._arm.line(start, pose)
            if path is None or not self._world.open_corridor(start, path[-1]):
                continue
            if self._world.is_path_free(path):
                return path
        return None

    def _joint_path(self, start: Joints, goals: list[Joints]) -> Path | Refusal:
        for goal in goals:
            segment = np.array([start, goal])
            if self._world.open_corridor(start, goal) and self._world.is_path_free(segment):
                return segment
        for goal in goals[: self._config.goals]:
            path = self._search(start, goal)
            if path is not None:
                return path
        return Refusal("no_path")

    def _search(self, start: Joints, goal: Joints) -> Path | None:
        """RRT-Connect with OMPL, then deterministic shortcuts."""
        self._world.open_corridor(start, goal)
        # Streams created from here on depend on this seed only, not on earlier plans.
        util.RNG.setSeed(self._config.seed)
        space = self._space_information()
        problem = base.ProblemDefinition(space)
        problem.setStartAndGoalStates(_to_ompl(space, start), _to_ompl(space, goal))
        search = geometric.RRTConnect(space)
        search.setRange(self._config.range_rad)
        search.setProblemDefinition(problem)
        search.setup()
        search.solve(base.PlannerTerminationCondition(_Countdown(self._config.iterations)))
        if not problem.hasExactSolution():
            return None
        return _shortened(space, problem.getSolutionPath())

    def _space_information(self) -> base.SpaceInformation:
        space = base.RealVectorStateSpace(ARM_JOINTS)
        bounds = base.RealVectorBounds(ARM_JOINTS)
        for joint in range(ARM_JOINTS):
            bounds.setLow(joint, float(self._arm.lower[joint]))
            bounds.setHigh(joint, float(self._arm.upper[joint]))
        space.setBounds(bounds)
        information = base.SpaceInformation(space)
        information.setStateValidityChecker(
            lambda state: self._world.is_free(np.array(state[0:ARM_JOINTS]))
        )
        # OMPL wants a fraction of the space's extent, about 14 rad here.
        information.setStateValidityCheckingResolution(CHECK_RAD / space.getMaximumExtent())
        information.setup()
        return information


class _Countdown:
    """Termination after so many questions; RRT-Connect asks once an iteration."""

    def __init__(self, count: int) -> None:
        self._left = count

    def __call__(self) -> bool:
        self._left -= 1
        return self._left < 0


def _to_ompl(information: base.SpaceInformation, joints: Joints) -> base.State:
    state = information.allocState()
    for joint, angle in enumerate(joints):
        state[joint] = float(angle)
    return state


def _shortened(information: base.SpaceInformation, path: geometric.PathGeometric) -> Path:
    shortcuts = geometric.PathSimplifier(information)
    shortcuts.reduceVertices(path)
    shortcuts.partialShortcutPath(path)
    shortcuts.reduceVertices(path)
    return np.array([state[0:ARM_JOINTS] for state in path.getStates()])


def timed(path: Path, rate_hz: float, config: TimingConfig | None = None) -> Path:
    """Joint targets at the control rate along a path; the last one is the path's end."""
    config = config or TimingConfig()
    spread = _respaced(path, config.gridpoint_rad)
    if len(spread) < 2:
        return path[-1:]
    lengths = np.abs(np.diff(spread, axis=0)).max(axis=1)
    positions = np.concatenate([[0.0], np.cumsum(lengths)])
    curve = toppra.SplineInterpolator(positions, spread)
    trajectory = TOPPRA(_limits(config), curve, gridpoints=positions, solver_wrapper="seidel")
    motion = trajectory.compute_trajectory()
    steps = int(np.ceil(motion.duration * rate_hz))
    times = np.minimum(np.arange(1, steps + 1) / rate_hz, motion.duration)
    return motion(times)


@cache
def _limits(config: TimingConfig) -> list[Constraint]:
    return [
        JointVelocityConstraint(np.full(ARM_JOINTS, config.velocity_rad_s)),
        JointAccelerationConstraint(np.full(ARM_JOINTS, config.acceleration_rad_s2)),
    ]


def _respaced(path: Path, step_rad: float) -> Path:
    """The same way with waypoints about `step_rad` apart, so that a spline cannot cut corners."""
    lengths = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(path, axis=0)).max(axis=1))])
    count = int(np.ceil(lengths[-1] / step_rad)) + 1
    marks = np.linspace(0.0, lengths[-1], max(count, 5 if lengths[-1] > 1e-4 else 1))
    return np.stack([np.interp(marks, lengths, path[:, j]) for j in range(ARM_JOINTS)], axis=1)
