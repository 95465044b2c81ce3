"""Collision-free joint paths to a pose, and their timing.

First a straight line of the tool, then a straight joint segment, then OMPL's RRT-Connect
(D-motion). Every plan is a function of its arguments alone: limits count iterations, never
seconds, and every random stream starts anew with each plan.
"""

import atexit
import gc
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
import pinocchio as pin
import toppra
from jaxtyping import Float64
from ompl import base, geometric, util
from toppra.algorithm import TOPPRA
from toppra.constraint import (
    Constraint,
    JointAccelerationConstraint,
    JointVelocityConstraint,
)

from sacil_tasks.motion.collision import CHECK_RAD, CollisionWorld, MotionState
from sacil_tasks.motion.kinematics import ARM_JOINTS, HALF_TURN, JointPath, Joints, PandaArm

# Seeding anew for each plan makes OMPL log an error each time; its streams do restart.
util.setLogLevel(util.LOG_NONE)
toppra.setup_logging("ERROR")
# Objects frozen out of garbage collection look like leaks to OMPL's bindings, which say so at exit.
atexit.register(gc.unfreeze)


MIN_MARKS = 5
"""A cubic spline needs four."""

NO_WAY_RAD = 1e-5
"""A shorter path is one target."""

CREEP = 0.1
"""Slowest speed (rad/s) anywhere but at the ends of a path."""


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
    ) -> JointPath | Refusal:
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

    def _straight_tool_path(self, start: Joints, target: pin.SE3) -> JointPath | None:
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

    def _joint_path(self, start: Joints, goals: list[Joints]) -> JointPath | Refusal:
        for goal in goals:
            segment = np.array([start, goal])
            if self._world.open_corridor(start, goal) and self._world.is_path_free(segment):
                return segment
        for goal in goals[: self._config.goals]:
            path = self._search(start, goal)
            if path is not None:
                return path
        return Refusal("no_path")

    def _search(self, start: Joints, goal: Joints) -> JointPath | None:
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


def _shortened(information: base.SpaceInformation, path: geometric.PathGeometric) -> JointPath:
    shortcuts = geometric.PathSimplifier(information)
    shortcuts.reduceVertices(path)
    shortcuts.partialShortcutPath(path)
    shortcuts.reduceVertices(path)
    return np.array([state[0:ARM_JOINTS] for state in path.getStates()])


def timed(path: JointPath, rate_hz: float, config: TimingConfig | None = None) -> JointPath:
    """Joint targets at the control rate along a path; the last one is the path's end."""
    config = config or TimingConfig()
    marks, waypoints = _respaced(path, config.gridpoint_rad)
    if marks[-1] < NO_WAY_RAD:
        return path[-1:]
    curve = toppra.SplineInterpolator(marks, waypoints)
    fastest = TOPPRA(_limits(config), curve, gridpoints=marks, solver_wrapper="seidel")
    fastest.compute_parameterization(0.0, 0.0)
    return curve(_marks_at(rate_hz, marks, fastest.problem_data.sd_vec))


def _marks_at(
    rate_hz: float, marks: Float64[np.ndarray, "m"], speeds: Float64[np.ndarray, "m"] | None
) -> Float64[np.ndarray, "steps"]:
    """How far along the way the arm is after each control step, given the speed at each mark.

    toppra's own parametrisation leaves the path where a corner brings the speed to almost zero;
    here the speed has a floor and every stretch ends at its mark, whatever toppra says.
    """
    speeds = np.maximum(np.nan_to_num(np.zeros_like(marks) if speeds is None else speeds), CREEP)
    speeds[[0, -1]] = 0.0
    lengths = np.diff(marks)
    clock = np.concatenate([[0.0], np.cumsum(2 * lengths / (speeds[:-1] + speeds[1:]))])
    accelerations = np.diff(speeds**2) / (2 * lengths)
    times = np.arange(1, int(np.ceil(clock[-1] * rate_hz)) + 1) / rate_hz
    stretch = np.minimum(np.searchsorted(clock, times, side="right") - 1, len(lengths) - 1)
    spent = np.minimum(times, clock[-1]) - clock[stretch]
    return marks[stretch] + (speeds[stretch] + accelerations[stretch] * spent / 2) * spent


@cache
def _limits(config: TimingConfig) -> list[Constraint]:
    return [
        JointVelocityConstraint(np.full(ARM_JOINTS, config.velocity_rad_s)),
        JointAccelerationConstraint(np.full(ARM_JOINTS, config.acceleration_rad_s2)),
    ]


def _respaced(
    path: JointPath, step_rad: float
) -> tuple[Float64[np.ndarray, "m"], Float64[np.ndarray, "m 7"]]:
    """Marks at most `step_rad` apart along the way, and the joints there.

    Close enough that a spline cannot cut corners. Marks measure the way along the path: where it
    turns back, neighbours may meet, and a spline over their distance would explode.
    """
    lengths = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(path, axis=0)).max(axis=1))])
    count = max(MIN_MARKS, int(np.ceil(lengths[-1] / step_rad)) + 1)
    marks = np.linspace(0.0, lengths[-1], count)
    joints = [np.interp(marks, lengths, path[:, joint]) for joint in range(ARM_JOINTS)]
    return marks, np.stack(joints, axis=1)
