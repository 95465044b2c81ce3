"""What networks read of a scene: every pixel in its place, and the past in its order."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from synthetic import observation

from baselines.scene import crop
from baselines.scene.augment import Augmentation
from baselines.scene.cloud import point_maps, unproject
from baselines.scene.crop import Crop
from baselines.scene.sight import CameraSight, Moment, ViewSight, ZoomSight, gripper_px
from baselines.scene.views import THREE_VIEWS, VIEWS, apply_affine, cube_from_base

MOVE = Augmentation(0.6, np.array([0.05, -0.03, 0.02]))


@pytest.fixture(scope="module")
def episode():
    rng = np.random.default_rng(3)
    return [observation(rng, step) for step in range(5)]


def test_point_maps_hold_the_points_of_the_cloud(episode):
    seen = episode[0]
    cloud = unproject(seen.rgb, seen.depth_mm, seen.intrinsics, seen.camera_in_base)
    maps, inside = point_maps(seen.depth_mm, seen.intrinsics, seen.camera_in_base, MOVE.to_cube())
    expected = apply_affine(MOVE.to_cube(), cloud.xyz_in_base)
    found = maps.transpose(0, 2, 3, 1)[seen.depth_mm > 0]
    within = (np.abs(expected) <= 1).all(-1)
    assert np.array_equal(inside[seen.depth_mm > 0], within)
    assert not inside[seen.depth_mm == 0].any()
    np.testing.assert_allclose(found[within], expected[within], atol=1e-6)
    assert (found[~within] == 0).all()


def test_the_present_comes_last_and_shorter_histories_are_padded_before(episode):
    moments = [Moment(episode[2], before=episode[:2]), Moment(episode[0])]
    pictures = CameraSight(remembers=True, steps=4).look(moments)
    assert pictures.happened.tolist() == [[True, True, True], [False, False, True]]
    assert pictures.step[0].tolist() == [0, 1, 2]
    for t in range(3):
        expected = torch.from_numpy(episode[t].rgb).permute(0, 3, 1, 2)
        assert torch.equal(pictures.rgb[0, t], expected)
    for padding in (pictures.rgb, pictures.xyz_in_cube, pictures.seen):
        assert not padding[1, :2].any()


def test_a_crop_shows_every_pixel_with_its_own_point_and_nothing_beyond_the_edges(episode):
    seen = episode[0]
    plain = point_maps(seen.depth_mm, seen.intrinsics, seen.camera_in_base, MOVE.to_cube())
    shown = Crop(np.array([5, -3])).show(seen)
    maps, inside = point_maps(
        shown.depth_mm, seen.intrinsics, seen.camera_in_base, MOVE.to_cube(), shown.sources
    )
    assert np.array_equal(maps[..., 3:, :-5], plain[0][..., :-3, 5:])
    assert np.array_equal(inside[..., 3:, :-5], plain[1][..., :-3, 5:])
    assert np.array_equal(shown.rgb[:, 3:, :-5], seen.rgb[:, :-3, 5:])
    assert not inside[..., :3, :].any()
    assert not inside[..., -5:].any()
    assert np.array_equal(shown.rgb[:, 3:, -5:], np.repeat(seen.rgb[:, :-3, -1:], 5, axis=2))


def test_the_past_is_cropped_like_the_present_and_the_gripper_with_its_images(episode):
    moment = Moment(episode[1], MOVE, before=episode[:1], seed=7)
    corner = crop.draw(7, 16).corner_px
    assert corner.any()
    cropped = CameraSight(remembers=True, steps=2, crop_px=16).look([moment])
    plain = CameraSight(remembers=True, steps=2).look([moment])
    for t in range(2):
        expected = Crop(corner).show(episode[t]).rgb
        assert np.array_equal(cropped.rgb[0, t].permute(0, 2, 3, 1).numpy(), expected)
    torch.testing.assert_close(cropped.gripper_px, plain.gripper_px - torch.from_numpy(corner))


def test_crops_go_as_far_as_asked_for_and_no_farther():
    corners = np.array([crop.draw(seed, 3).corner_px for seed in range(1, 200)])
    assert (corners.min(0) == -3).all()
    assert (corners.max(0) == 3).all()
    assert not crop.draw(1, 0).corner_px.any()


def test_only_as_many_steps_as_asked_for_are_shown(episode):
    pictures = CameraSight(remembers=True, steps=2).look([Moment(episode[4], before=episode[:4])])
    assert pictures.step.tolist() == [[3, 4]]


@pytest.mark.parametrize(
    "sight", [ViewSight(16), CameraSight(remembers=False), ZoomSight(16, draws=2)]
)
def test_rows_do_not_depend_on_each_other(episode, sight):
    moments = [Moment(seen, MOVE, seed=i) for i, seen in enumerate(episode[:3])]
    together = sight.look(moments)
    for index, moment in enumerate(moments):
        alone = sight.look([moment])
        for name, value in vars(alone).items():
            expected = getattr(together, name)[index : index + 1]
            assert torch.equal(value, expected) if name != "clouds" else same(value, expected)


def same(clouds, others):
    pairs = zip(clouds, others, strict=True)
    return all(np.array_equal(a.xyz_in_cube, b.xyz_in_cube) for a, b in pairs)


def test_a_zooming_sight_shows_the_views_of_the_plain_one(episode):
    moments = [Moment(seen, MOVE) for seen in episode[:2]]
    plain = ViewSight(24).look(moments).views
    zooming = ZoomSight(24, draws=0).look(moments).views
    assert torch.equal(zooming, plain[:, [VIEWS.index(view) for view in THREE_VIEWS]])


def test_the_whole_cube_is_what_a_zoom_of_one_shows(episode):
    scene = ZoomSight(24, draws=0).look([Moment(seen, MOVE) for seen in episode[:2]])
    assert torch.equal(scene.closer(torch.zeros(2, 3), 1.0).views, scene.views)


def test_a_zoom_draws_the_points_about_its_centre_larger(episode):
    scene = ZoomSight(32, draws=0).look([Moment(episode[0], MOVE), Moment(episode[1], MOVE)])
    centers = torch.tensor([[0.1, -0.2, -0.3], [0.3, 0.1, -0.5]])
    near = scene.closer(centers, 4.0).views
    for cloud, center, views in zip(scene.clouds, centers.numpy(), near, strict=True):
        close = 4 * (cloud.xyz_in_cube.astype(float) - center)
        inside = (np.abs(close) <= 1 - 1e-5).all(-1)
        assert 20 < inside.sum() < len(inside) / 10
        shown = views[:, :3].permute(0, 2, 3, 1)[views[:, 6] > -1].double().numpy()
        assert np.abs(shown).max() <= 1
        distances = np.abs(shown[:, None] - close[inside][None]).max(-1).min(1)
        assert np.mean(distances < 1e-5) > 0.98  # the rest lie on the very border


def test_random_choices_follow_the_seed(episode):
    sight = ZoomSight(16, draws=3)
    first, same_seed, other = (sight.look([Moment(episode[0], seed=s)]).draws for s in (1, 1, 2))
    assert torch.equal(first, same_seed)
    assert not torch.equal(first, other)
    assert (first >= 0).all()
    assert (first < 1).all()


def test_the_gripper_moves_with_the_scene(episode):
    pose = Moment(episode[0], MOVE).gripper_in_cube
    moved = MOVE.move_pose(episode[0].tcp_in_base.astype(float))
    np.testing.assert_allclose(pose[:3], apply_affine(cube_from_base(), moved[:3]), atol=1e-6)
    np.testing.assert_allclose(pose[3:], moved[3:], atol=1e-6)


def test_the_gripper_is_seen_where_a_pixel_shows_the_same_point(episode):
    seen = episode[0]
    base, _ = point_maps(
        seen.depth_mm, seen.intrinsics, seen.camera_in_base, np.eye(3, 4, dtype=np.float32)
    )
    row, column = np.argwhere(np.abs(base[2]).max(0) > 0)[1234]
    held = np.r_[base[2, :, row, column], seen.tcp_in_base[3:]].astype(np.float32)
    found = gripper_px(replace(seen, tcp_in_base=held))
    np.testing.assert_allclose(found[2], [column + 0.5, row + 0.5], atol=1e-3)


def test_a_gripper_behind_the_camera_is_nowhere(episode):
    behind = episode[0].tcp_in_base + np.float32([0, 0, 5, 0, 0, 0, 0])
    assert (gripper_px(replace(episode[0], tcp_in_base=behind)) == -np.inf).all()
