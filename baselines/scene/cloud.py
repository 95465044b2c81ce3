"""From four RGB-D images to points: one coloured cloud, or a map of points beside each image."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int64, UInt8, UInt16

from baselines.scene.compiled import compiled

METRES_PER_MILLIMETRE = 1e-3


@dataclass(frozen=True)
class Cloud:
    """Coloured points, camera after camera, row after row."""

    xyz_in_base: Float32[np.ndarray, "n 3"]
    """Positions in metres."""

    rgb: UInt8[np.ndarray, "n 3"]
    """Colours as the cameras gave them."""


def unproject(
    rgb: UInt8[np.ndarray, "k h w 3"],
    depth_mm: UInt16[np.ndarray, "k h w"],
    intrinsics: Float32[np.ndarray, "k 3 3"],
    camera_in_base: Float32[np.ndarray, "k 4 4"],
) -> Cloud:
    """Lift every pixel with depth to a point; the arguments are fields of `Observation`.

    Pixels whose depth is 0 saw nothing and are dropped, so the cloud may be empty.
    """
    rays = _rays(intrinsics, camera_in_base)
    xyz_in_base = np.empty((depth_mm.size, 3), np.float32)
    colours = np.empty((depth_mm.size, 3), np.uint8)
    count = _lift(
        rgb,
        depth_mm,
        rays.astype(np.float32),
        camera_in_base[:, :3, 3].astype(np.float32),
        xyz_in_base,
        colours,
    )
    return Cloud(xyz_in_base=xyz_in_base[:count], rgb=colours[:count])


def crop_to_cube(
    cloud: Cloud, cube_from_base: Float32[np.ndarray, "3 4"]
) -> tuple[Float32[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"]]:
    """Cube coordinates and colours of the points that lie in [-1, 1]^3.

    `cube_from_base` includes the augmentation.
    """
    xyz_in_cube, colours = np.empty_like(cloud.xyz_in_base), np.empty_like(cloud.rgb)
    count = _crop(cloud.xyz_in_base, cloud.rgb, cube_from_base, xyz_in_cube, colours)
    return xyz_in_cube[:count].copy(), colours[:count].copy()


def point_maps(
    depth_mm: UInt16[np.ndarray, "k h w"],
    intrinsics: Float32[np.ndarray, "k 3 3"],
    camera_in_base: Float32[np.ndarray, "k 4 4"],
    cube_from_base: Float32[np.ndarray, "3 4"],
    sources: Int64[np.ndarray, "2 side"] | None = None,
) -> tuple[Float32[np.ndarray, "k 3 h w"], Bool[np.ndarray, "k h w"]]:
    """Cube coordinates of every pixel's point, and whether it lies in [-1, 1]^3.

    `cube_from_base` includes the augmentation; `sources` are the cameras' columns and rows that a
    crop shows. Pixels that saw nothing, or something outside, are at 0.
    """
    turn, shift = cube_from_base[:, :3], cube_from_base[:, 3]
    rays = turn @ _rays(intrinsics, camera_in_base)
    origins = camera_in_base[:, :3, 3] @ turn.T + shift
    maps = np.empty((len(depth_mm), 3, *depth_mm.shape[1:]), np.float32)
    inside = np.empty(depth_mm.shape, np.bool_)
    if sources is None:
        sources = np.broadcast_to(np.arange(depth_mm.shape[-1]), (2, depth_mm.shape[-1]))
    centres = sources.astype(np.float32) + np.float32(0.5)
    _map(depth_mm, rays.astype(np.float32), origins.astype(np.float32), centres, maps, inside)
    return maps, inside


def _rays(
    intrinsics: Float32[np.ndarray, "k 3 3"], camera_in_base: Float32[np.ndarray, "k 4 4"]
) -> Float32[np.ndarray, "k 3 3"]:
    """Displacement (m) per millimetre of depth of the pixel (column, row, 1)."""
    return METRES_PER_MILLIMETRE * camera_in_base[:, :3, :3] @ np.linalg.inv(intrinsics)


@compiled
def _lift(
    rgb: np.ndarray,
    depth_mm: np.ndarray,
    rays: np.ndarray,
    origins: np.ndarray,
    xyz_in_base: np.ndarray,
    colours: np.ndarray,
) -> int:
    """Write the points into the last two arrays and return how many there are.

    `rays[k] @ (column, row, 1)` is the displacement in metres per millimetre of depth.
    """
    half = np.float32(0.5)
    count = 0
    for k in range(depth_mm.shape[0]):
        ray, origin = rays[k], origins[k]
        for i in range(depth_mm.shape[1]):
            v = np.float32(i) + half
            start_x = ray[0, 1] * v + ray[0, 2]
            start_y = ray[1, 1] * v + ray[1, 2]
            start_z = ray[2, 1] * v + ray[2, 2]
            for j in range(depth_mm.shape[2]):
                depth = np.float32(depth_mm[k, i, j])
                if depth == 0:
                    continue
                u = np.float32(j) + half
                xyz_in_base[count, 0] = (ray[0, 0] * u + start_x) * depth + origin[0]
                xyz_in_base[count, 1] = (ray[1, 0] * u + start_y) * depth + origin[1]
                xyz_in_base[count, 2] = (ray[2, 0] * u + start_z) * depth + origin[2]
                colours[count, 0] = rgb[k, i, j, 0]
                colours[count, 1] = rgb[k, i, j, 1]
                colours[count, 2] = rgb[k, i, j, 2]
                count += 1
    return count


@compiled
def _crop(
    xyz: np.ndarray,
    rgb: np.ndarray,
    transform: np.ndarray,
    xyz_in_cube: np.ndarray,
    colours: np.ndarray,
) -> int:
    """Write the points inside the cube into the last two arrays and return how many there are."""
    one = np.float32(1)
    count = 0
    for i in range(len(xyz)):
        px, py, pz = xyz[i, 0], xyz[i, 1], xyz[i, 2]
        x = transform[0, 0] * px + transform[0, 1] * py + transform[0, 2] * pz + transform[0, 3]
        y = transform[1, 0] * px + transform[1, 1] * py + transform[1, 2] * pz + transform[1, 3]
        z = transform[2, 0] * px + transform[2, 1] * py + transform[2, 2] * pz + transform[2, 3]
        if abs(x) <= one and abs(y) <= one and abs(z) <= one:
            xyz_in_cube[count, 0], xyz_in_cube[count, 1], xyz_in_cube[count, 2] = x, y, z
            colours[count, 0], colours[count, 1] = rgb[i, 0], rgb[i, 1]
            colours[count, 2] = rgb[i, 2]
            count += 1
    return count


@compiled
def _map(
    depth_mm: np.ndarray,
    rays: np.ndarray,
    origins: np.ndarray,
    centres: np.ndarray,
    maps: np.ndarray,
    inside: np.ndarray,
) -> None:
    one, nothing = np.float32(1), np.float32(0)
    for k in range(depth_mm.shape[0]):
        ray, origin = rays[k], origins[k]
        for i in range(depth_mm.shape[1]):
            v = centres[1, i]
            for j in range(depth_mm.shape[2]):
                depth, u = np.float32(depth_mm[k, i, j]), centres[0, j]
                x = (ray[0, 0] * u + ray[0, 1] * v + ray[0, 2]) * depth + origin[0]
                y = (ray[1, 0] * u + ray[1, 1] * v + ray[1, 2]) * depth + origin[1]
                z = (ray[2, 0] * u + ray[2, 1] * v + ray[2, 2]) * depth + origin[2]
                hit = depth > nothing and max(abs(x), abs(y), abs(z)) <= one
                inside[k, i, j] = hit
                maps[k, 0, i, j] = x if hit else nothing
                maps[k, 1, i, j] = y if hit else nothing
                maps[k, 2, i, j] = z if hit else nothing
