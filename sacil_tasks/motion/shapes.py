"""From PhysX collision shapes to coal geometry, so that planner and simulator agree."""

from collections.abc import Sequence
from typing import TypeAlias

import coal
import numpy as np
import pinocchio as pin
import sapien
from jaxtyping import Float64, Int
from sapien import physx
from scipy.spatial import ConvexHull

Placed: TypeAlias = tuple[coal.CollisionGeometry, pin.SE3]
"""A geometry and its pose in the frame of its link or actor."""

CORNERS = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), dtype=float).reshape(3, 8).T
X_TO_Z = pin.SE3(pin.utils.rotate("y", np.pi / 2), np.zeros(3))
"""PhysX capsules and cylinders lie along x, coal's along z."""


def to_se3(pose: sapien.Pose) -> pin.SE3:
    """SAPIEN pose to Pinocchio; both put w first."""
    w, x, y, z = (float(value) for value in pose.q)
    return pin.SE3(pin.Quaternion(w, x, y, z).normalized(), np.asarray(pose.p, dtype=float))


def to_coal(shape: physx.PhysxCollisionShape) -> Placed:
    """One PhysX shape as exact coal geometry.

    Raises:
        TypeError: triangle meshes and other shapes that the planner does not know.
    """
    pose = to_se3(shape.local_pose)
    match shape:
        case physx.PhysxCollisionShapeBox():
            return coal.Box(*(2 * np.asarray(shape.half_size, dtype=float))), pose
        case physx.PhysxCollisionShapeSphere():
            return coal.Sphere(float(shape.radius)), pose
        case physx.PhysxCollisionShapeCapsule():
            return coal.Capsule(float(shape.radius), 2 * float(shape.half_length)), pose * X_TO_Z
        case physx.PhysxCollisionShapeCylinder():
            return coal.Cylinder(float(shape.radius), 2 * float(shape.half_length)), pose * X_TO_Z
        case physx.PhysxCollisionShapePlane():
            return coal.Halfspace(np.array([1.0, 0.0, 0.0]), 0.0), pose
        case physx.PhysxCollisionShapeConvexMesh():
            return convex(np.asarray(shape.vertices) * np.asarray(shape.scale)), pose
    raise TypeError(f"the planner cannot use a {type(shape).__name__}; use primitives or hulls")


def hull(shapes: Sequence[physx.PhysxCollisionShape]) -> list[Placed]:
    """One convex hull around all boxes and convex meshes; other shapes as they are."""
    corners = [points for shape in shapes if (points := _corners(shape)) is not None]
    rest = [to_coal(shape) for shape in shapes if _corners(shape) is None]
    if len(corners) < 2:
        return [to_coal(shape) for shape in shapes]
    return [(convex(np.concatenate(corners)), pin.SE3.Identity()), *rest]


def convex(points: Float64[np.ndarray, "n 3"]) -> coal.Convex:
    """Convex hull of points, with outward faces."""
    shell = ConvexHull(points)
    index = np.full(len(points), -1)
    index[shell.vertices] = np.arange(len(shell.vertices))
    corners, faces = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
    for point in points[shell.vertices]:
        corners.append(point.astype(float))
    for face in _outward(points, shell):
        faces.append(coal.Triangle(*(int(index[corner]) for corner in face)))
    return coal.Convex(corners, faces)


def _outward(points: Float64[np.ndarray, "n 3"], shell: ConvexHull) -> Int[np.ndarray, "f 3"]:
    a, b, c = (points[shell.simplices[:, corner]] for corner in range(3))
    inward = np.einsum("fi,fi->f", np.cross(b - a, c - a), shell.equations[:, :3]) < 0
    faces = shell.simplices.copy()
    faces[inward] = faces[inward][:, ::-1]
    return faces


def _corners(shape: physx.PhysxCollisionShape) -> Float64[np.ndarray, "n 3"] | None:
    if isinstance(shape, physx.PhysxCollisionShapeBox):
        local = CORNERS * np.asarray(shape.half_size, dtype=float)
    elif isinstance(shape, physx.PhysxCollisionShapeConvexMesh):
        local = np.asarray(shape.vertices, dtype=float) * np.asarray(shape.scale)
    else:
        return None
    pose = to_se3(shape.local_pose)
    return local @ pose.rotation.T + pose.translation
