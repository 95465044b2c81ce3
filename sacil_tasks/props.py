"""Table, candidates and markers: visuals from meshes, collision from primitives and small hulls.

Every builder takes the parallel scene it builds in, so that sizes may differ from scene to scene;
`build_each` merges the results into one batched object.
"""

from collections.abc import Callable, Sequence
from typing import TypeAlias, TypeVar

import numpy as np
import sapien
import trimesh
from jaxtyping import Float64
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.building import ActorBuilder
from mani_skill.utils.structs import Actor, Articulation
from sapien import physx
from sapien.wrapper.articulation_builder import LinkBuilder
from torch import Tensor
from transforms3d.euler import euler2quat

Rgb: TypeAlias = Sequence[float]
Prop = TypeVar("Prop", Actor, Articulation)
Length = TypeVar("Length", float, Tensor)

BLOCK_DENSITY = 300.0
CUP_MASS_KG = 0.06
CUP_FACETS = 12
CUP_FLOOR_M = 0.004
PEPPER_DENSITY = 300.0
_PEPPER_PROFILE = (
    *((0.0, 0.62), (0.12, 0.84), (0.32, 0.97), (0.55, 1.0)),
    *((0.78, 0.96), (0.92, 0.80), (1.0, 0.50)),
)
"""Share of the height, share of the width there."""

BUTTON_BASE_M = 0.02
BUTTON_TRAVEL_M = 0.008
BUTTON_CAP_M = 0.018
CAP_MASS_KG = 0.05
_UPRIGHT = euler2quat(0, np.pi / 2, 0)
"""SAPIEN's cylinders lie along x."""


def build_each(scene: ManiSkillScene, name: str, build: Callable[[int, str], Prop]) -> Prop:
    """Build one prop per parallel scene and return them as one, under one key of the state."""
    if scene.num_envs == 1:
        return build(0, name)
    parts = [build(i, f"{name}-{i}") for i in range(scene.num_envs)]
    for part in parts:
        scene.remove_from_state_dict_registry(part)
    merged = _merge(parts, name)
    scene.add_to_state_dict_registry(merged)
    return merged


def _merge(parts: list[Prop], name: str) -> Prop:
    if isinstance(parts[0], Actor):
        return Actor.merge(parts, name=name)
    return Articulation.merge(parts, name=name, merge_links=True)


def build_table(scene: ManiSkillScene) -> Actor:
    """Matte table with its top at z = 0: ManiSkill's extents without its wood texture."""
    builder = scene.create_actor_builder()
    half = (0.6045, 1.209, 0.46)
    builder.add_box_collision(half_size=half)
    if scene.can_render():
        builder.add_box_visual(half_size=half, material=matte((0.52, 0.50, 0.47)))
    builder.initial_pose = sapien.Pose([-0.12, 0, -half[2]])
    return builder.build_static(name="table")


def build_block(scene: ManiSkillScene, index: int, name: str, edge_m: float, rgb: Rgb) -> Actor:
    """Cube of constant density, its origin at the centre."""
    builder = _builder(scene, index)
    half = [edge_m / 2] * 3
    builder.add_box_collision(half_size=half, density=BLOCK_DENSITY)
    if scene.can_render():
        builder.add_box_visual(half_size=half, material=matte(rgb))
    return builder.build_dynamic(name=name)


def cup_height_m(diameter_m: Length) -> Length:
    """Height of a cup of this outer diameter."""
    return 1.3 * diameter_m


def cup_grasp_yaw(heading_rad: float) -> float:
    """Gripper yaw that closes across the handle, on two flat facets of the wall.

    Of the two, half a turn apart, the one in (-90, 90] degrees.
    """
    return np.pi / 2 - (np.pi / 2 - heading_rad) % np.pi


def build_cup(scene: ManiSkillScene, index: int, name: str, diameter_m: float, rgb: Rgb) -> Actor:
    """Hollow upright cup, origin at the middle of its height, handle towards +x.

    Twelve wall boxes and a floor collide; the handle is for the eye only, as in RLBench. All cups
    weigh the same, so that the size shows in the image and nowhere else.
    """
    builder = _builder(scene, index)
    wall_m = max(0.003, 0.07 * diameter_m)
    boxes = [*_cup_walls(diameter_m, wall_m), _cup_floor(diameter_m, wall_m)]
    volume_m3 = sum(8 * np.prod(half) for _, half in boxes)
    for pose, half in boxes:
        builder.add_box_collision(pose, half, density=CUP_MASS_KG / volume_m3)
    if scene.can_render():
        _add_mesh(builder, _cup_mesh(diameter_m, wall_m), matte(rgb))
    return builder.build_dynamic(name=name)


def _cup_walls(diameter_m: float, wall_m: float) -> list[tuple[sapien.Pose, list[float]]]:
    radius_m = diameter_m / 2
    half = [
        wall_m / 2,
        radius_m * np.tan(np.pi / CUP_FACETS),
        cup_height_m(diameter_m) / 2,
    ]
    poses = []
    for angle in np.arange(CUP_FACETS) * 2 * np.pi / CUP_FACETS:
        outwards = np.array([np.cos(angle), np.sin(angle), 0])
        poses.append(sapien.Pose((radius_m - wall_m / 2) * outwards, euler2quat(0, 0, angle)))
    return [(pose, half) for pose in poses]


def _cup_floor(diameter_m: float, wall_m: float) -> tuple[sapien.Pose, list[float]]:
    half_side = (diameter_m / 2 - wall_m) / np.sqrt(2)
    height = (CUP_FLOOR_M - cup_height_m(diameter_m)) / 2
    return sapien.Pose([0, 0, height]), [half_side, half_side, CUP_FLOOR_M / 2]


def _cup_mesh(diameter_m: float, wall_m: float) -> trimesh.Trimesh:
    radius_m, height_m = diameter_m / 2, cup_height_m(diameter_m)
    wall = trimesh.creation.annulus(radius_m - wall_m, radius_m, height_m, sections=32)
    floor = trimesh.creation.cylinder(radius_m - wall_m / 2, CUP_FLOOR_M, sections=32)
    floor.apply_translation([0, 0, (CUP_FLOOR_M - height_m) / 2])
    return wall + floor + _handle_mesh(diameter_m)


def _handle_mesh(diameter_m: float) -> trimesh.Trimesh:
    """Half a ring standing in the x-z plane and reaching 0.38 diameters out of the wall."""
    reach_m, thickness_m = 0.38 * diameter_m, 0.055 * diameter_m
    turn = np.linspace(0, 2 * np.pi, 9)
    profile = np.stack([np.cos(turn), np.sin(turn)], axis=1) * thickness_m
    profile[:, 0] += reach_m - thickness_m
    ring = trimesh.creation.revolve(profile, angle=np.pi, sections=16)  # y >= 0, about z
    ring.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    ring.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0]))
    ring.apply_translation([0.48 * diameter_m, 0, 0])
    return ring


def pepper_height_m(width_m: Length) -> Length:
    """Height of a pepper of this width, without its stem."""
    return 1.1 * width_m


def build_pepper(scene: ManiSkillScene, index: int, name: str, width_m: float, rgb: Rgb) -> Actor:
    """Bell pepper with four lobes along x and y, origin at the middle of its height.

    A hull collides; the stem is for the eye only.
    """
    builder = _HullBuilder(_pepper_rings(8).reshape(-1, 3) * width_m, PEPPER_DENSITY)
    builder.set_scene(scene)
    builder.set_scene_idxs([index])
    builder.initial_pose = sapien.Pose([0, 0, 1])
    if scene.can_render():
        _add_mesh(builder, _pepper_mesh(width_m), matte(rgb))
        stem = trimesh.creation.cylinder(0.07 * width_m, 0.15 * width_m, sections=8)
        stem.apply_translation([0, 0, 0.62 * width_m])
        _add_mesh(builder, stem, matte((0.10, 0.25, 0.04)))
    return builder.build_dynamic(name=name)


def _pepper_rings(sections: int) -> Float64[np.ndarray, "rings sections 3"]:
    """Outline of a pepper of width 1, ring by ring from its flat bottom up."""
    angle = np.arange(sections) * 2 * np.pi / sections
    lobes = (1 + 0.08 * np.cos(4 * angle)) / 1.08
    return np.array(
        [
            np.stack(
                [
                    reach * lobes * np.cos(angle) / 2,
                    reach * lobes * np.sin(angle) / 2,
                    np.full(sections, pepper_height_m(level - 0.5)),
                ],
                axis=1,
            )
            for level, reach in _PEPPER_PROFILE
        ]
    )


def _pepper_mesh(width_m: float) -> trimesh.Trimesh:
    """The outline as a closed surface; between two lobes it is hollow, unlike its hull."""
    sections = 32
    points = _pepper_rings(sections)
    here = np.arange(points.shape[0] * sections).reshape(-1, sections)
    beside = np.roll(here, -1, axis=1)
    a, b, c, d = (part.ravel() for part in (here[:-1], beside[:-1], here[1:], beside[1:]))
    sides = np.concatenate([np.stack([a, b, d], axis=1), np.stack([a, d, c], axis=1)])
    bottom, top = here[0], here[-1]
    lids = [(bottom[0], bottom[i + 1], bottom[i]) for i in range(1, sections - 1)]
    lids += [(top[0], top[i], top[i + 1]) for i in range(1, sections - 1)]
    return trimesh.Trimesh(
        points.reshape(-1, 3) * width_m, np.concatenate([sides, lids]), process=False
    )


class _HullBuilder(ActorBuilder):
    """Builds actors that collide as the hull of points.

    ManiSkill takes hulls from files only, and SAPIEN goes on using the first file of a name.
    """

    def __init__(self, points_m: Float64[np.ndarray, "n 3"], density: float) -> None:
        super().__init__()
        self._points_m = points_m
        self._density = density

    def build_physx_component(self, link_parent: object = None) -> physx.PhysxRigidBaseComponent:
        """Add the hull to what ManiSkill builds."""
        component = super().build_physx_component(link_parent)
        shape = physx.PhysxCollisionShapeConvexMesh(
            vertices=self._points_m.astype(np.float32),
            scale=np.ones(3, dtype=np.float32),
            material=physx.get_default_material(),
        )
        shape.set_density(self._density)
        component.attach(shape)
        return component


def build_button(
    scene: ManiSkillScene, index: int, name: str, cap_m: float, rgb: Rgb
) -> Articulation:
    """Button fixed to the table: a base box and a sprung cap that can be pushed 8 mm down.

    Only the width follows the size; height and stiffness are those of every button.
    """
    builder = scene.create_articulation_builder()
    builder.set_scene_idxs([index])
    builder.initial_pose = sapien.Pose()
    base = builder.create_link_builder()
    base.set_name("base")
    _add_box(scene, base, [0.75 * cap_m, 0.75 * cap_m, BUTTON_BASE_M / 2], (0.12, 0.12, 0.13))
    cap = builder.create_link_builder(base)
    cap.set_name("cap")
    _add_cap(scene, cap, cap_m, rgb)
    button = builder.build(name, fix_root_link=True)
    _spring(button)
    return button


def _add_box(scene: ManiSkillScene, link: LinkBuilder, half: list[float], rgb: Rgb) -> None:
    pose = sapien.Pose([0, 0, half[2]])
    link.add_box_collision(pose, half)
    if scene.can_render():
        link.add_box_visual(pose, half, material=matte(rgb))


def _add_cap(scene: ManiSkillScene, cap: LinkBuilder, cap_m: float, rgb: Rgb) -> None:
    upwards = euler2quat(0, -np.pi / 2, 0)
    cap.set_joint_name("press")
    cap.set_joint_properties(
        "prismatic",
        [[-BUTTON_TRAVEL_M, 0.0]],
        pose_in_parent=sapien.Pose([0, 0, BUTTON_BASE_M], upwards),
        pose_in_child=sapien.Pose([0, 0, 0], upwards),
    )
    # The shaft ends inside the base when pressed; a link never collides with its own parent.
    pose = sapien.Pose([0, 0, BUTTON_CAP_M / 2], _UPRIGHT)
    density = CAP_MASS_KG / (np.pi * (cap_m / 2) ** 2 * BUTTON_CAP_M)
    cap.add_cylinder_collision(pose, cap_m / 2, BUTTON_CAP_M / 2, density=density)
    if scene.can_render():
        cap.add_cylinder_visual(pose, cap_m / 2, BUTTON_CAP_M / 2, material=matte(rgb))


def _spring(button: Articulation) -> None:
    """Hold the cap up by a drive; without gravity, or it would idle lower the heavier it is."""
    for joint in button.active_joints:
        joint.set_drive_properties(stiffness=250.0, damping=5.0)
    button.links_map["cap"].disable_gravity = True


def build_marker(scene: ManiSkillScene, name: str) -> Actor:
    """Thin green disc that is laid onto a pressed button."""
    builder = scene.create_actor_builder()
    if scene.can_render():
        builder.add_cylinder_visual(
            sapien.Pose(q=_UPRIGHT), 0.006, 0.0005, material=matte((0.0, 1.0, 0.1))
        )
    builder.initial_pose = sapien.Pose([0, 0, -0.1])
    return builder.build_kinematic(name=name)


def build_goal(scene: ManiSkillScene, name: str, radius_m: float) -> Actor:
    """Pale sphere in the air that nothing can touch."""
    builder = scene.create_actor_builder()
    if scene.can_render():
        builder.add_sphere_visual(radius=radius_m, material=matte((0.95, 0.97, 1.0)))
    builder.initial_pose = sapien.Pose([0, 0, 0.25])
    return builder.build_kinematic(name=name)


def _builder(scene: ManiSkillScene, index: int) -> ActorBuilder:
    builder = scene.create_actor_builder()
    builder.set_scene_idxs([index])
    builder.initial_pose = sapien.Pose([0, 0, 1])
    return builder


def matte(rgb: Rgb) -> "sapien.render.RenderMaterial":
    """Material without highlights, which would tell the light's direction and little else."""
    return sapien.render.RenderMaterial(base_color=[*rgb, 1.0], roughness=0.9, specular=0.1)


def _add_mesh(
    builder: ActorBuilder, mesh: trimesh.Trimesh, material: "sapien.render.RenderMaterial"
) -> None:
    """Add a flat-shaded visual from memory: SAPIEN caches mesh *files* by name, and would go on
    showing the first one written."""
    mesh.unmerge_vertices()
    shape = sapien.render.RenderShapeTriangleMesh(
        vertices=mesh.vertices,
        triangles=mesh.faces,
        normals=mesh.face_normals.repeat(3, axis=0),
        uvs=np.zeros((len(mesh.vertices), 2)),
        material=material,
    )
    builder._procedural_shapes.append(shape)  # noqa: SLF001 -- ManiSkill has no public way in
