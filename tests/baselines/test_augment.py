"""Moves are rigid, keep the label in the cube, and move cloud and gripper as one."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from baselines.scene.augment import AugmentConfig, draw
from baselines.scene.views import apply_affine, cube_from_base, render_views
from sacil_tasks.interface import SCENE_BOUNDS

CENTER, HALF = np.array(SCENE_BOUNDS.center_in_base), SCENE_BOUNDS.side_m / 2
MIDDLE = CENTER + np.array([0.03, -0.05, 0.02])
RISING = AugmentConfig(translation_m=0.125)


def moves(target, count=300, config=AugmentConfig()):  # noqa: B008
    rng = np.random.default_rng(0)
    return [draw(rng, target, config) for _ in range(count)]


def gripper_frame(points, pose):
    rotation = Rotation.from_quat(pose[3:], scalar_first=True)
    return rotation.inv().apply(points - pose[:3])


def test_a_point_on_the_gripper_keeps_its_place_in_the_gripper_frame():
    """Also for tilted grippers, where turning about the gripper's own axis would fail."""
    rng = np.random.default_rng(1)
    points = MIDDLE + rng.normal(0, 0.1, (20, 3))
    for move, rotation in zip(moves(MIDDLE, 50), Rotation.random(50, rng=2), strict=True):
        pose = np.concatenate([MIDDLE, rotation.as_quat(scalar_first=True)])
        np.testing.assert_allclose(
            gripper_frame(move.move_points(points), move.move_pose(pose)),
            gripper_frame(points, pose),
            atol=1e-9,
        )


def test_the_turn_pivots_on_the_label_and_stays_in_its_range():
    shifts = np.array([move.move_points(MIDDLE) - MIDDLE for move in moves(MIDDLE)])
    turns = np.array([move.yaw_rad for move in moves(MIDDLE)])
    assert np.abs(shifts).max() <= 0.125
    assert np.abs(turns).max() <= np.pi / 4
    assert (shifts.min(0)[:2] < -0.12).all()
    assert (shifts.max(0)[:2] > 0.12).all()
    assert turns.min() < -0.75
    assert turns.max() > 0.75


def test_heights_stay_unless_a_rise_is_asked_for():
    points = np.random.default_rng(0).uniform(-1, 1, (30, 3))
    for move in moves(MIDDLE, 10):
        np.testing.assert_allclose(move.move_points(points)[:, 2], points[:, 2], atol=1e-12)


def test_heights_change_by_the_shift_alone():
    points = np.random.default_rng(0).uniform(-1, 1, (30, 3))
    for move in moves(MIDDLE, 10, RISING):
        rise = move.move_points(points)[:, 2] - points[:, 2]
        np.testing.assert_allclose(rise, rise[0], atol=1e-12)


@pytest.mark.parametrize("corner", [(-1, -1, -1), (1, 1, 1), (-0.9, 0.2, 0.99), (0, 0, -0.8)])
def test_the_label_never_leaves_the_cube(corner):
    target = CENTER + HALF * np.array(corner)
    for move in moves(target, config=RISING):
        assert np.abs(apply_affine(move.to_cube(), target)).max() <= 1 + 1e-6


def test_labels_near_a_face_are_not_piled_up_on_it():
    target = CENTER - np.array([0, 0, HALF - 0.02])
    heights = np.array([move.move_points(target)[2] for move in moves(target, config=RISING)])
    on_the_face = np.isclose(heights, CENTER[2] - HALF, atol=1e-4)
    assert on_the_face.mean() < 0.02


def test_a_label_outside_the_cube_is_brought_to_its_face():
    target = CENTER + np.array([HALF + 0.3, 0, 0])
    for move in moves(target, 10):
        assert apply_affine(move.to_cube(), target)[0] == pytest.approx(1, abs=1e-6)


def test_ranges_of_zero_leave_the_scene_alone():
    (still,) = moves(MIDDLE, 1, AugmentConfig(yaw_rad=0.0, translation_m=0.0))
    pose = np.array([0.5, 0.1, 0.2, 0, 1, 0, 0])
    np.testing.assert_allclose(still.move_pose(pose), pose, atol=1e-12)
    np.testing.assert_allclose(still.to_cube(), cube_from_base(), atol=1e-6)


def test_one_matrix_draws_what_moving_then_placing_draws():
    rng = np.random.default_rng(5)
    xyz = (CENTER + rng.uniform(-HALF, HALF, (4000, 3))).astype(np.float32)
    rgb = rng.integers(0, 256, xyz.shape, dtype=np.uint8)
    for move in moves(MIDDLE, 3):
        at_once = render_views(xyz, rgb, move.to_cube(), 64)
        moved = move.move_points(xyz).astype(np.float32)
        in_steps = render_views(moved, rgb, cube_from_base(), 64)
        differing = np.abs(at_once - in_steps)[:, :6] > 1e-4
        assert differing.mean() < 1e-3  # points that rounding moves across a pixel border


def test_the_same_generator_draws_the_same_moves():
    for first, second in zip(moves(MIDDLE, 5), moves(MIDDLE, 5), strict=True):
        np.testing.assert_array_equal(first.matrix, second.matrix)
