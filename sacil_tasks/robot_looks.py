"""What the robot looks like: ManiSkill's Panda with a tenth of its triangles.

Its meshes have 136,000 of them, which software rendering spends 85 % of its time on; at the
cameras' 128 pixels most of them are smaller than a tenth of a pixel. Triangles are merged by
clustering their corners in a grid. Collision shapes stay as they are. D-looks.
"""

from functools import cache

import numpy as np
import sapien
from jaxtyping import Float32, Int64, UInt32
from mani_skill.utils.structs import Articulation

CELLS_M = {"panda_hand": 0.004, "panda_leftfinger": 0.0, "panda_rightfinger": 0.0}
"""Grid of the links that the wrist camera sees from close by; 0 leaves a link as it is."""

CELL_M = 0.010
"""Grid of the others: a pixel of the fixed cameras shows 7 mm."""


def lighten(robot: Articulation) -> None:
    """Exchange the visual meshes of every link, in every environment.

    Call it before the scene is rendered for the first time.
    """
    for link in robot.links:
        cell_m = CELLS_M.get(link.name, CELL_M)
        for component in link._objs:  # noqa: SLF001 -- no public way to the parallel ones
            body = component.entity.find_component_by_type(sapien.render.RenderBodyComponent)
            if body is not None and cell_m:
                _exchange(component.entity, body, link.name, cell_m)


def _exchange(
    entity: sapien.Entity, body: sapien.render.RenderBodyComponent, name: str, cell_m: float
) -> None:
    if name not in _known():
        _known()[name] = _light_shapes(body, cell_m)
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
    body: sapien.render.RenderBodyComponent, cell_m: float
) -> list[sapien.render.RenderShapeTriangleMesh]:
    """One shape for each part of a link that is larger than a grid cell."""
    shapes = []
    for shape in body.render_shapes:
        for part in shape.parts:
            vertices_m, triangles = merged(
                np.asarray(part.vertices) * np.asarray(shape.scale),
                np.asarray(part.triangles),
                cell_m,
            )
            if len(triangles):
                lighter = sapien.render.RenderShapeTriangleMesh(
                    vertices_m,
                    triangles,
                    _normals(vertices_m, triangles),
                    np.zeros((len(vertices_m), 2), np.float32),
                    part.material,
                )
                lighter.local_pose = shape.local_pose
                shapes.append(lighter)
    return shapes


def merged(
    vertices_m: Float32[np.ndarray, "v 3"], triangles: UInt32[np.ndarray, "t 3"], cell_m: float
) -> tuple[Float32[np.ndarray, "w 3"], UInt32[np.ndarray, "u 3"]]:
    """The mesh with all vertices of a grid cell moved into their mean; flat triangles are left out.

    Vertex clustering (Rossignac and Borrel, 1993).
    """
    _, cell = np.unique(_cells(vertices_m, cell_m), return_inverse=True)
    counts = np.bincount(cell)
    means_m = np.stack([np.bincount(cell, axis) / counts for axis in vertices_m.T], axis=1)
    corners = cell[triangles]
    proper = (corners != np.roll(corners, 1, axis=1)).all(axis=1)
    _, first = np.unique(np.sort(corners[proper], axis=1), axis=0, return_index=True)
    kept = corners[proper][np.sort(first)]
    return means_m.astype(np.float32), kept.astype(np.uint32)


def _cells(vertices_m: Float32[np.ndarray, "v 3"], cell_m: float) -> Int64[np.ndarray, "v"]:
    """The number of the grid cell that each vertex is in."""
    steps = np.floor((vertices_m - vertices_m.min(axis=0)) / cell_m).astype(np.int64)
    return np.ravel_multi_index(tuple(steps.T), steps.max(axis=0) + 1)


def _normals(
    vertices_m: Float32[np.ndarray, "v 3"], triangles: UInt32[np.ndarray, "t 3"]
) -> Float32[np.ndarray, "v 3"]:
    """Mean normal of the triangles around each vertex, weighted by their area."""
    a, b, c = (vertices_m[corner] for corner in triangles.T)
    normals = np.zeros_like(vertices_m)
    for corner in triangles.T:
        np.add.at(normals, corner, np.cross(b - a, c - a))
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
