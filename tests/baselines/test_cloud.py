"""Clouds against a plain pinhole model."""

import numpy as np
from scipy.spatial.transform import Rotation

from baselines.scene.cloud import unproject

CAMERAS, HEIGHT, WIDTH = 4, 5, 7


def sensors(seed=0):
    """Random images, a general pinhole and random poses."""
    rng = np.random.default_rng(seed)
    rgb = rng.integers(0, 256, (CAMERAS, HEIGHT, WIDTH, 3), dtype=np.uint8)
    depth_mm = rng.integers(0, 4, (CAMERAS, HEIGHT, WIDTH)).astype(np.uint16) * 500
    pinhole = np.array([[90, 0.5, 3.4], [0, 110, 2.6], [0, 0, 1]], np.float32)
    camera_in_base = np.tile(np.eye(4, dtype=np.float32), (CAMERAS, 1, 1))
    camera_in_base[:, :3, :3] = Rotation.random(CAMERAS, rng=seed).as_matrix()
    camera_in_base[:, :3, 3] = rng.uniform(-1, 1, (CAMERAS, 3))
    return rgb, depth_mm, np.tile(pinhole, (CAMERAS, 1, 1)), camera_in_base


def project_back(point, pinhole, camera_in_base):
    """Pixel coordinates and depth (m) of a point of the base frame."""
    in_camera = np.linalg.inv(camera_in_base.astype(np.float64)) @ np.append(point, 1.0)
    u, v, w = pinhole @ in_camera[:3]
    return u / w, v / w, in_camera[2]


def test_each_point_projects_back_to_the_centre_of_its_pixel_in_image_order():
    rgb, depth_mm, intrinsics, camera_in_base = sensors()
    cloud = unproject(rgb, depth_mm, intrinsics, camera_in_base)
    seen = list(zip(*np.nonzero(depth_mm), strict=True))
    assert len(cloud.xyz_in_base) == len(cloud.rgb) == len(seen)
    for point, colour, (k, i, j) in zip(cloud.xyz_in_base, cloud.rgb, seen, strict=True):
        u, v, depth_m = project_back(point, intrinsics[k], camera_in_base[k])
        np.testing.assert_allclose((u, v), (j + 0.5, i + 0.5), atol=1e-3)
        np.testing.assert_allclose(depth_m, depth_mm[k, i, j] / 1000, atol=1e-5)
        np.testing.assert_array_equal(colour, rgb[k, i, j])


def test_images_without_depth_give_an_empty_cloud():
    rgb, depth_mm, intrinsics, camera_in_base = sensors()
    cloud = unproject(rgb, np.zeros_like(depth_mm), intrinsics, camera_in_base)
    assert cloud.xyz_in_base.shape == (0, 3)
    assert cloud.rgb.shape == (0, 3)


def test_types_are_those_the_renderer_takes():
    cloud = unproject(*sensors())
    assert cloud.xyz_in_base.dtype == np.float32
    assert cloud.rgb.dtype == np.uint8
