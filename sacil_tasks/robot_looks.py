"""What the robot looks like: ManiSkill's Panda with a tenth of its triangles.

Its meshes have 136,000 of them, which software rendering spends 85 % of its time on; at the
cameras' 128 pixels most of them are smaller than a tenth of a pixel. Collision shapes stay as they
are. D-looks.
"""

from functools import cache

import numpy as np
import sapien
import trimesh
from mani_skill.utils.structs import Articulation

SHARE = 0.1
"""Of a part's triangles that are kept."""

FEW = 600
"""Parts with fewer triangles stay as they are."""

CREASE_RAD = 0.5
"""Faces that meet at a larger angle are shaded apart."""


def lighten(robot: Articulation) -> None:
    """Exchange the visual meshes of every link, in every environment.

    Call it before the scene is rendered for the first time.
    """
    for link in robot.links:
        for component in link._objs:  # noqa: SLF001 -- no public way to the parallel ones
            body = component.entity.find_component_by_type(sapien.render.RenderBodyComponent)
            if body is not None:
                _exchange(component.entity, body, link.name)


def _exchange(entity: sapien.Entity, body: sapien.render.RenderBodyComponent, name: str) -> None:
    if name not in _known():
        _known()[name] = _light_shapes(body)
    lighter = sapien.render.RenderBodyComponent()
    for shape in _known()[name]:
        lighter.attach(shape.clone())
    entity.remove_component(body)
    entity.add_component(lighter)


@cache
def _known() -> dict[str, list[sapien.render.RenderShapeTriangleMesh]]:
    """Shapes by link, made once per process; their clones share the meshes."""
    return {}


def _light_shapes(
    body: sapien.render.RenderBodyComponent,
) -> list[sapien.render.RenderShapeTriangleMesh]:
    """One shape for each part of a link, in the part's material."""
    shapes = []
    for shape in body.render_shapes:
        for part in shape.parts:
            mesh = simplified(trimesh.Trimesh(part.vertices * shape.scale, part.triangles))
            lighter = sapien.render.RenderShapeTriangleMesh(
                mesh.vertices.astype(np.float32),
                mesh.faces.astype(np.uint32),
                mesh.vertex_normals.astype(np.float32),
                np.zeros((len(mesh.vertices), 2), np.float32),
                part.material,
            )
            lighter.local_pose = shape.local_pose
            shapes.append(lighter)
    return shapes


def simplified(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh with a tenth of its triangles (quadric edge collapse), smooth between creases."""
    count = max(FEW, round(SHARE * len(mesh.faces)))
    if count < len(mesh.faces):
        mesh = mesh.simplify_quadric_decimation(face_count=count)
    return trimesh.graph.smooth_shade(mesh, angle=CREASE_RAD)
