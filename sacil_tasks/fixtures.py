"""What stands on the table besides the candidates: a scale to take things off."""

import sapien
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.building import ActorBuilder
from mani_skill.utils.structs import Actor

from sacil_tasks.props import Rgb, matte

PAN_HALF_M = (0.16, 0.13)
PAN_TOP_M = 0.10
_PAN_THICKNESS_M = 0.01
_DARK, _STEEL = (0.10, 0.11, 0.13), (0.60, 0.62, 0.65)


def build_scale(scene: ManiSkillScene, name: str) -> Actor:
    """Weighing scale, origin under its middle: a body with a flat pan on top; nothing moves."""
    builder = scene.create_actor_builder()
    body_m, pan_m = PAN_TOP_M - _PAN_THICKNESS_M, _PAN_THICKNESS_M / 2
    _add_box(builder, (0.0, 0.0, body_m / 2), (0.10, 0.10, body_m / 2), _DARK)
    _add_box(builder, (0.0, 0.0, PAN_TOP_M - pan_m), (*PAN_HALF_M, pan_m), _STEEL)
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
