"""The collision world of one scene: robot, obstacles, and perhaps an object in the hand.

The shapes are the simulator's own (see `shapes`). A robot link, and an actor that can move, is
the convex hull of its shapes; what stands still keeps every shape, so that the hand may enter a
drawer. coal's dynamic tree finds the few pairs worth an exact test.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TypeAlias

import coal
import numpy as np
import pinocchio as pin
from jaxtyping import Bool, Float64
from mani_skill.envs.sapien_env import BaseEnv

from sacil_tasks.motion.bodies import BASE_LINK, RobotShapes, gap_m, read_bodies
from sacil_tasks.motion.kinematics import ARM_JOINTS, SRDF, JointPath, Joints, PandaArm
from sacil_tasks.motion.shapes import Placed

MARGIN_M = 0.01
"""Free motion keeps this distance; without it the arm was seen to brush handles."""

SLACK_M = 5e-4
"""A pair that starts or ends closer than the margin may come this much closer still."""

CHECK_RAD = 0.012
"""Farthest any joint moves between two collision checks."""

OPEN_M = 0.04
"""Position of either finger joint when the gripper is open."""

EMPTY_M = 0.002
"""Closed fingers nearer to the middle than this hold nothing."""

HAND_JOINT = 7
ARM, HAND, NOTHING = -1, -2, -3
"""Owners of geometry beside the bodies, which are numbered from 0."""

Gaps: TypeAlias = dict[int, float]
"""Distance (m) by collision pair, for the pairs closer than their margin."""


@dataclass(frozen=True)
class MotionState:
    """What a plan starts from; a value, so that sequences can be planned ahead."""

    joints: Joints
    finger_m: float
    """Position of either finger joint."""

    bodies_in_base: tuple[pin.SE3, ...]
    """Poses of `CollisionWorld.bodies`, in their order."""

    held: int | None
    """Index of the body in the hand."""

    pulled: int | None = None
    """Index of the sliding body, a drawer, whose handle is in the hand."""


@dataclass(frozen=True)
class _Part:
    """One geometry of a body in the Pinocchio geometry model."""

    geometry: int
    body: int
    placed: Placed = field(repr=False)


class CollisionWorld:
    """Collision checks of the arm in one scene.

    `set_state` says where everything is, `open_corridor` how close start and goal allow to
    come; then `is_free` and `is_path_free` answer.
    """

    def __init__(self, arm: PandaArm, robot: RobotShapes, env: BaseEnv) -> None:
        """Read the scene of `env` as it is built now; its poses come with each state."""
        self.bodies = read_bodies(env)
        self._arm = arm
        self._model = pin.GeometryModel()
        self._owner: list[int] = []
        self._add_robot(robot)
        self._parts = [
            _Part(self._add(body.name, 0, 0, placed, index), index, placed)
            for index, body in enumerate(self.bodies)
            for placed in body.shapes
        ]
        self._add_obstacle_pairs()
        self._data = self._model.createData()
        self._tree = pin.BroadPhaseManager_DynamicAABBTreeCollisionManager(
            arm.model, self._model, self._data
        )
        self._configuration = pin.neutral(arm.model)

    def set_state(self, state: MotionState, *, ignore_obstacles: bool = False) -> None:
        """Place every body and the fingers.

        With `ignore_obstacles` only the robot's own links may not meet each other.
        """
        self._configuration[ARM_JOINTS:] = state.finger_m
        hand = self._hand_in_base(state.joints)
        for part, (_, pose) in self._placed(state):
            geometry = self._model.geometryObjects[part.geometry]
            held = part.body == state.held
            geometry.parentJoint = HAND_JOINT if held else 0
            geometry.placement = hand.actInv(pose) if held else pose
        active = self._activity(state.held) & (self._robot_only() | (not ignore_obstacles))
        self._data.setActiveCollisionPairs(self._model, active, upper=True)
        self._set_margins({})

    def open_corridor(self, start: Joints, goal: Joints) -> bool:
        """Set the distance every pair has to keep on the way; False if the goal is in collision.

        It is 10 mm, or what start and goal themselves leave where that is less: so a hand that
        stands beside an obstacle may leave it, and may end beside one, but not touch it.
        """
        self._set_margins({})
        near_start, near_goal = self._gaps(start), self._gaps(goal)
        for pair, gap in near_goal.items():
            if gap < min(0.0, near_start.get(pair, np.inf) - SLACK_M):
                return False
        nearest = {
            pair: min(near_start.get(pair, np.inf), near_goal.get(pair, np.inf))
            for pair in near_start.keys() | near_goal.keys()
        }
        self._set_margins({pair: gap - SLACK_M for pair, gap in nearest.items()})
        return True

    def is_free(self, joints: Joints) -> bool:
        """Whether every pair keeps its distance."""
        return not pin.computeCollisions(
            self._arm.model,
            self._arm.data,
            self._tree,
            self._with_fingers(joints),
            stop_at_first_collision=True,
        )

    def is_path_free(self, path: JointPath) -> bool:
        """Whether every pair keeps its distance everywhere along the joint segments."""
        return all(
            self.is_free(joints) for start, end in pairwise(path) for joints in _between(start, end)
        )

    def body_between_fingers(self, state: MotionState) -> int | None:
        """The movable body that the fingers enclose, nearest to the tool centre first."""
        movable = {index for index, body in enumerate(self.bodies) if body.movable}
        return self._between_fingers(state, movable)

    def drawer_between_fingers(self, state: MotionState) -> int | None:
        """The sliding body that the fingers enclose, nearest to the tool centre first."""
        sliding = {i for i, body in enumerate(self.bodies) if body.slides_along is not None}
        return self._between_fingers(state, sliding)

    def _between_fingers(self, state: MotionState, among: set[int]) -> int | None:
        if state.finger_m < EMPTY_M:
            return None
        tcp = self._arm.tcp_in_base(state.joints)
        # A thin bar from finger to finger, along the closing axis y of the tool.
        bar = coal.Box(2e-3, 2 * state.finger_m, 2e-3)
        center = (coal.Sphere(1e-3), tcp)
        gaps = {
            part.body: gap_m(center, placed)
            for part, placed in self._placed(state)
            if part.body in among and gap_m((bar, tcp), placed) <= 0
        }
        return min(gaps, key=gaps.__getitem__, default=None)

    def _placed(self, state: MotionState) -> Iterator[tuple[_Part, Placed]]:
        for part in self._parts:
            geometry, local = part.placed
            yield part, (geometry, state.bodies_in_base[part.body] * local)

    def _add_robot(self, robot: RobotShapes) -> None:
        model = self._arm.model
        for link, shapes in robot.items():
            frame = model.getFrameId(link)
            origin = model.frames[frame]
            for geometry, pose in shapes:
                placed = (geometry, origin.placement * pose)
                owner = HAND if "hand" in link or "finger" in link else ARM
                self._add(link, origin.parentJoint, frame, placed, owner)
        self._model.addAllCollisionPairs()
        pin.removeCollisionPairs(model, self._model, SRDF)

    def _add(self, name: str, joint: int, frame: int, placed: Placed, owner: int) -> int:
        self._owner.append(owner)
        label = f"{name}#{self._model.ngeoms}"
        return self._model.addGeometryObject(
            pin.GeometryObject(label, joint, frame, placed[1], placed[0])
        )

    def _add_obstacle_pairs(self) -> None:
        # The base stands in its table for good, so its link is in no pair with an obstacle.
        objects = self._model.geometryObjects
        links = [
            index
            for index, owner in enumerate(self._owner)
            if owner < 0 and not objects[index].name.startswith(BASE_LINK)
        ]
        for part in self._parts:
            for link in links:
                self._model.addCollisionPair(pin.CollisionPair(link, part.geometry))
        for one in self._parts:
            for other in self._parts:
                movable = self.bodies[one.body].movable or self.bodies[other.body].movable
                if one.body < other.body and movable:
                    self._model.addCollisionPair(pin.CollisionPair(one.geometry, other.geometry))

    def _robot_only(self) -> Bool[np.ndarray, "g g"]:
        robot = np.array(self._owner) < 0
        return np.logical_and.outer(robot, robot)

    def _activity(self, held: int | None) -> Bool[np.ndarray, "g g"]:
        """The arm with itself and everything; what is held with everything but the hand."""
        owner = np.array(self._owner)
        carried = owner == (NOTHING if held is None else held)
        grip = np.logical_and.outer(carried, owner == HAND)
        with_robot = np.logical_or.outer(owner < 0, owner < 0)
        return (with_robot | np.logical_xor.outer(carried, carried)) & ~(grip | grip.T)

    def _set_margins(self, exceptions: Gaps) -> None:
        margins = np.where(self._robot_only(), 0.0, MARGIN_M)
        self._data.setSecurityMargins(
            self._model, margins, upper=True, sync_distance_upper_bound=True
        )
        for pair, margin in exceptions.items():
            self._data.collisionRequests[pair].security_margin = margin

    def _gaps(self, joints: Joints) -> Gaps:
        if self.is_free(joints):
            return {}
        model, data = self._model, self._data
        pin.computeCollisions(model, data, stop_at_first_collision=False)
        return {
            pair: pin.computeDistance(model, data, pair).min_distance
            for pair, active in enumerate(data.activeCollisionPairs)
            if active and data.collisionResults[pair].isCollision()
        }

    def _hand_in_base(self, joints: Joints) -> pin.SE3:
        pin.forwardKinematics(self._arm.model, self._arm.data, self._with_fingers(joints))
        return self._arm.data.oMi[HAND_JOINT].copy()

    def _with_fingers(self, joints: Joints) -> Float64[np.ndarray, "9"]:
        self._configuration[:ARM_JOINTS] = joints
        return self._configuration


def _between(start: Joints, end: Joints) -> JointPath:
    """Points after `start` up to `end`, at most `CHECK_RAD` apart in every joint."""
    count = max(1, int(np.ceil(np.abs(end - start).max() / CHECK_RAD)))
    shares = np.arange(1, count + 1)[:, None] / count
    return start + shares * (end - start)
