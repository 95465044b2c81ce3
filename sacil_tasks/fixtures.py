"""What stands on the table besides the candidates: a scale, a rack for cups, a cabinet."""

import numpy as np
import sapien
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.building import ActorBuilder
from mani_skill.utils.building.articulation_builder import ArticulationBuilder
from mani_skill.utils.structs import Actor, Articulation
from sapien.wrapper.articulation_builder import LinkBuilder
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

HANDLE_HEIGHTS_M = {"bottom": 0.1375, "middle": 0.2225, "top": 0.3075}
"""Drawers, and the height of each one's middle, where its handle is."""

CABINET_TOP_M = 0.362
DRAWER_TRAVEL_M = 0.20
DRAWER_MASS_KG = 0.6
DRAWER_FLOOR_M = -0.0335
"""Upper face of a drawer's floor in the drawer's frame."""

DRAWER_INSIDE_M = ((-0.252, -0.01), (-0.128, 0.128), (DRAWER_FLOOR_M, 0.0395))
"""Ranges along x, y and z of the room inside a drawer, in the drawer's frame."""

HANDLE_M = 0.038
"""Distance from a drawer's front to the middle of its handle's bar."""

_BODY_BOXES_M = (
    ((-0.14, 0.0, 0.0475), (0.14, 0.15, 0.0475)),  # plinth
    ((-0.14, -0.145, 0.2225), (0.14, 0.005, 0.1275)),
    ((-0.14, 0.145, 0.2225), (0.14, 0.005, 0.1275)),
    ((-0.275, 0.0, 0.2225), (0.005, 0.14, 0.1275)),  # back
    ((-0.14, 0.0, 0.356), (0.14, 0.15, 0.006)),  # top
)
"""Centre and half extents of each box, in the cabinet's frame."""

_DRAWER_BOXES_M = (
    ((-0.005, 0.0, 0.0), (0.005, 0.138, 0.0395), _WOOD),  # front
    ((-0.135, 0.0, -0.0365), (0.125, 0.136, 0.003), _WOOD),  # floor
    ((-0.135, -0.132, -0.012), (0.125, 0.004, 0.0275), _WOOD),
    ((-0.135, 0.132, -0.012), (0.125, 0.004, 0.0275), _WOOD),
    ((-0.256, 0.0, -0.012), (0.004, 0.128, 0.0275), _WOOD),  # back
    ((HANDLE_M, 0.0, 0.0), (0.007, 0.040, 0.007), _DARK),  # bar of the handle
    ((0.0155, -0.033, 0.0), (0.0155, 0.005, 0.005), _DARK),
    ((0.0155, 0.033, 0.0), (0.0155, 0.005, 0.005), _DARK),
)
"""Centre, half extents and colour of each box, in the drawer's frame."""


def build_scale(scene: ManiSkillScene, name: str) -> Actor:
    """Weighing scale, origin under its middle: a body with a flat pan on top; nothing moves.

    D-scale.
    """
    builder = scene.create_actor_builder()
    body_m, pan_m = PAN_TOP_M - _PAN_THICKNESS_M, _PAN_THICKNESS_M / 2
    _add_box(scene, builder, (0.0, 0.0, body_m / 2), (0.10, 0.10, body_m / 2), _DARK)
    _add_box(scene, builder, (0.0, 0.0, PAN_TOP_M - pan_m), (*PAN_HALF_M, pan_m), _STEEL)
    builder.initial_pose = sapien.Pose()
    return builder.build_kinematic(name=name)


def build_rack(scene: ManiSkillScene, name: str) -> Actor:
    """Cup holder, origin under its middle: a plate with three pegs in a row along x."""
    builder = scene.create_actor_builder()
    _add_box(scene, builder, (0.0, 0.0, PLATE_TOP_M / 2), (0.16, 0.055, PLATE_TOP_M / 2), _WOOD)
    upwards = euler2quat(0, np.pi / 2, 0)  # SAPIEN's capsules lie along x
    for x_m in PEGS_M:
        # The lower half ball is inside the plate, the upper one is the peg's tip.
        pose = sapien.Pose([x_m, 0.0, PLATE_TOP_M + _PEG_M / 2 - _PEG_RADIUS_M], upwards)
        builder.add_capsule_collision(pose, _PEG_RADIUS_M, _PEG_M / 2)
        if scene.can_render():
            builder.add_capsule_visual(pose, _PEG_RADIUS_M, _PEG_M / 2, material=matte(_STEEL))
    builder.initial_pose = sapien.Pose()
    return builder.build_kinematic(name=name)


def build_cabinet(scene: ManiSkillScene, name: str) -> Articulation:
    """Cabinet with three drawers, origin on the table under its front, x out of the front."""
    builder = scene.create_articulation_builder()
    builder.disable_self_collisions = True
    builder.initial_pose = sapien.Pose()
    body = builder.create_link_builder()
    body.set_name("body")
    for center_m, half_m in _BODY_BOXES_M:
        _add_box(scene, body, center_m, half_m, _STEEL)
    for drawer, height_m in HANDLE_HEIGHTS_M.items():
        _add_drawer(scene, builder, body, drawer, height_m)
    cabinet = builder.build(name, fix_root_link=True)
    for joint in cabinet.active_joints:
        # Less lets an open drawer drift, more makes the handle slip through the fingers.
        joint.set_friction(0.5)
        joint.set_drive_properties(stiffness=0.0, damping=5.0)
    return cabinet


def _add_drawer(
    scene: ManiSkillScene,
    builder: ArticulationBuilder,
    body: LinkBuilder,
    name: str,
    height_m: float,
) -> None:
    """Drawer whose origin is the middle of its front's outer face; its joint slides along x."""
    drawer = builder.create_link_builder(body)
    drawer.set_name(name)
    drawer.set_joint_name(f"{name}_slide")
    drawer.set_joint_properties(
        "prismatic",
        [[0.0, DRAWER_TRAVEL_M]],
        pose_in_parent=sapien.Pose([0.0, 0.0, height_m]),
        pose_in_child=sapien.Pose(),
    )
    volume_m3 = sum(8 * float(np.prod(half_m)) for _, half_m, _ in _DRAWER_BOXES_M)
    for center_m, half_m, rgb in _DRAWER_BOXES_M:
        _add_box(scene, drawer, center_m, half_m, rgb, density=DRAWER_MASS_KG / volume_m3)


def _add_box(
    scene: ManiSkillScene,
    builder: ActorBuilder | LinkBuilder,
    center_m: tuple[float, float, float],
    half_m: tuple[float, float, float],
    rgb: Rgb,
    density: float = 1000.0,
) -> None:
    pose = sapien.Pose(center_m)
    builder.add_box_collision(pose, half_m, density=density)
    if scene.can_render():
        builder.add_box_visual(pose, half_m, material=matte(rgb))
