"""What stands on the table besides the candidates: a scale, and a rack for cups."""

import numpy as np
import sapien
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.building import ActorBuilder
from mani_skill.utils.structs import Actor
from transforms3d.euler import euler2quat

from sacil_tasks.props import Rgb, matte

PAN_HALF_M = (0.16, 0.13)
PAN_TOP_M = 0.10
_PAN_THICKNESS_M = 0.01

PEGS_M = (-0.11, 0.0, 0.11)
"""Places of the rack's pegs along its x."""

PLATE_TOP_M = 0.015
_PEG_RADIUS_M, _PEG_M = 0.005, 0.032

_DARK, _STEEL, _WOOD = (0.10, 0.11, 0.13), (0.60, 0.62, 0.65), (0.30, 0.19, 0.10)


def build_scale(scene: ManiSkillScene, name: str) -> Actor:
    """Weighing scale, origin under its middle: a body with a flat pan on top; nothing moves."""
    builder = scene.create_actor_builder()
    body_m, pan_m = PAN_TOP_M - _PAN_THICKNESS_M, _PAN_THICKNESS_M / 2
    _add_box(builder, (0.0, 0.0, body_m / 2), (0.10, 0.10, body_m / 2), _DARK)
    _add_box(builder, (0.0, 0.0, PAN_TOP_M - pan_m), (*PAN_HALF_M, pan_m), _STEEL)
    builder.initial_pose = sapien.Pose()
    return builder.build_kinematic(name=name)


def build_rack(scene: ManiSkillScene, name: str) -> Actor:
    """Cup holder, origin under its middle: a plate with three pegs in a row along x."""
    builder = scene.create_actor_builder()
    _add_box(builder, (0.0, 0.0, PLATE_TOP_M / 2), (0.16, 0.055, PLATE_TOP_M / 2), _WOOD)
    upwards = euler2quat(0, np.pi / 2, 0)  # SAPIEN's capsules lie along x
    for x_m in PEGS_M:
        # The lower half ball is inside the plate, the upper one is the peg's tip.
        pose = sapien.Pose([x_m, 0.0, PLATE_TOP_M + _PEG_M / 2 - _PEG_RADIUS_M], upwards)
        builder.add_capsule_collision(pose, _PEG_RADIUS_M, _PEG_M / 2)
        if scene.can_render():
            builder.add_capsule_visual(pose, _PEG_RADIUS_M, _PEG_M / 2, material=matte(_STEEL))
    builder.initial_pose = sapien.Pose()
    return builder.build_kinematic(name=name)


def _add_box(
    builder: ActorBuilder,
    center_m: tuple[float, float, float],
    half_m: tuple[float, float, float],
    rgb: Rgb,
) -> None:
    pose = sapien.Pose(center_m)
    builder.add_box_collision(pose, half_m)
    if builder.scene.can_render():
        builder.add_box_visual(pose, half_m, material=matte(rgb))
