"""What a SAPIEN scene is made of: the robot's links, and the bodies that are in its way."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TypeAlias

import coal
import numpy as np
import pinocchio as pin
from jaxtyping import Float64
from mani_skill.envs.sapien_env import BaseEnv
from sapien import Entity, physx

from sacil_tasks.motion.shapes import Placed, hull, to_coal, to_se3

BASE_LINK = "panda_link0"
SHOULDER_IN_BASE = np.array([0.0, 0.0, 0.333])
REACH_M = 1.25
"""No point of the hand or of what it holds is ever farther from the shoulder."""

RobotShapes: TypeAlias = Mapping[str, list[Placed]]
"""Collision geometry by link name; the same in every scene."""


@dataclass(frozen=True)
class Body:
    """An obstacle: an actor, or a link of an articulation that is not the robot."""

    name: str
    entity: Entity
    shapes: tuple[Placed, ...]
    movable: bool
    """Free to be picked up."""

    slides_along: Float64[np.ndarray, "3"] | None
    """Direction, in its own frame, in which it can be pulled."""


def base_in_world(env: BaseEnv) -> pin.SE3:
    """Where the robot stands."""
    return to_se3(env.agent.robot.pose.sp)


def read_robot(env: BaseEnv) -> RobotShapes:
    """One convex hull per robot link."""
    return {
        component.entity.name: hull(component.collision_shapes)
        for component in _colliding(env)
        if _is_robot(component)
    }


def read_bodies(env: BaseEnv) -> tuple[Body, ...]:
    """Everything the arm could touch: hulls of movable actors, every shape of the rest."""
    world_in_base = base_in_world(env).inverse()
    return tuple(
        body
        for component in _colliding(env)
        if not _is_robot(component)
        if _within_reach(
            body := _read_body(component), world_in_base * to_se3(component.entity.pose)
        )
    )


def gap_m(one: Placed, two: Placed) -> float:
    """Distance between two placed geometries; negative where they overlap."""
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    return coal.distance(one[0], _transform(one[1]), two[0], _transform(two[1]), request, result)


def _read_body(component: physx.PhysxRigidBaseComponent) -> Body:
    movable = isinstance(component, physx.PhysxRigidDynamicComponent) and not component.kinematic
    shapes = component.collision_shapes
    placed = hull(shapes) if movable else [to_coal(shape) for shape in shapes]
    return Body(
        component.entity.name, component.entity, tuple(placed), movable, _slides_along(component)
    )


def _slides_along(component: physx.PhysxRigidBaseComponent) -> Float64[np.ndarray, "3"] | None:
    if not isinstance(component, physx.PhysxArticulationLinkComponent):
        return None
    joint = component.joint
    if joint is None or joint.type != "prismatic":
        return None
    return to_se3(joint.pose_in_child).rotation[:, 0]  # PhysX joints slide along x


def _within_reach(body: Body, pose: pin.SE3) -> bool:
    shoulder = (coal.Sphere(1e-3), pin.SE3(np.eye(3), SHOULDER_IN_BASE))
    return body.movable or any(
        gap_m(shoulder, (shape, pose * local)) < REACH_M for shape, local in body.shapes
    )


def _colliding(env: BaseEnv) -> Iterator[physx.PhysxRigidBaseComponent]:
    for entity in env.scene.sub_scenes[0].entities:
        component = entity.find_component_by_type(physx.PhysxRigidBaseComponent)
        if component is not None and component.collision_shapes:
            yield component


def _is_robot(component: physx.PhysxRigidBaseComponent) -> bool:
    if not isinstance(component, physx.PhysxArticulationLinkComponent):
        return False
    return component.articulation.links[0].entity.name == BASE_LINK


def _transform(pose: pin.SE3) -> coal.Transform3s:
    return coal.Transform3s(pose.rotation, pose.translation)
