"""A stock ManiSkill scene with walls put into it: what the motion tests plan in."""

from collections.abc import Sequence

import gymnasium as gym
import mani_skill.envs  # noqa: F401 - registers PickCube-v1
import numpy as np
import sapien
from mani_skill.utils.structs import Actor, Link
from scipy.spatial.transform import Rotation

from sacil_tasks.interface import Keyframe

BASE_X_M = -0.615
DOWN_WXYZ = np.array([0.0, 1.0, 0.0, 0.0])
Box = tuple[Sequence[float], Sequence[float]]
"""Centre in the base frame and half sizes, in metres."""

WALL: Box = ((0.55, 0.0, 0.2), (0.1, 0.01, 0.2))
"""Stands across the way from the right to the left of the table."""


def make_env(*walls: Box) -> gym.Env:
    """PickCube-v1 without rendering, with boxes that stand still."""
    env = gym.make(
        "PickCube-v1",
        obs_mode="none",
        control_mode="pd_joint_pos",
        sim_backend="physx_cpu",
        render_backend="none",
    )
    env.reset(seed=0)
    for index, (center, half_size) in enumerate(walls):
        builder = env.unwrapped.scene.create_actor_builder()
        builder.add_box_collision(half_size=half_size)
        builder.initial_pose = sapien.Pose(np.add(center, (BASE_X_M, 0.0, 0.0)))
        builder.build_kinematic(f"wall_{index}")
    return env


def keyframe(
    position_m: Sequence[float],
    *,
    quaternion_wxyz: Sequence[float] = tuple(DOWN_WXYZ),
    gripper_open: bool = True,
    ignore_collisions: bool = False,
) -> Keyframe:
    """A keyframe that looks straight down unless told otherwise."""
    return Keyframe(
        np.array(position_m), np.array(quaternion_wxyz), gripper_open, ignore_collisions
    )


def cube_in_base(env: gym.Env) -> np.ndarray:
    """Centre of the cube."""
    return _in_base(env.unwrapped.cube)


def tcp_in_base(env: gym.Env) -> np.ndarray:
    """Tool centre point."""
    return _in_base(env.unwrapped.agent.tcp)


def _in_base(thing: Actor | Link) -> np.ndarray:
    return np.subtract(thing.pose.p[0].numpy(), (BASE_X_M, 0.0, 0.0))


def grasp(env: gym.Env) -> list[Keyframe]:
    """Keyframes that pick the cube up: above, around it, up again."""
    position, quaternion = cube_in_base(env), _square_to_cube(env)
    above = np.add(position, (0.0, 0.0, 0.1))
    return [
        keyframe(above, quaternion_wxyz=quaternion),
        keyframe(position, quaternion_wxyz=quaternion, gripper_open=False, ignore_collisions=True),
        keyframe(above, quaternion_wxyz=quaternion, gripper_open=False, ignore_collisions=True),
    ]


def _square_to_cube(env: gym.Env) -> np.ndarray:
    w, x, y, z = env.unwrapped.cube.pose.q[0].numpy()
    yaw = Rotation.from_quat([x, y, z, w]).as_euler("xyz")[2] % (np.pi / 2)
    hand = Rotation.from_euler("z", yaw) * Rotation.from_euler("x", np.pi)
    return np.roll(hand.as_quat(), 1)
