"""Clouds for point networks: the same whatever the order, and neighbours that are the nearest."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from networks import blank_moments
from synthetic import observation

from baselines.layers.pointnet import interpolated
from baselines.scene.augment import Augmentation
from baselines.scene.neighbours import Pyramid, farthest_first, near_points, nearest_three
from baselines.scene.points import HALF_SIDE_M, TABLE_M, CloudSight, PointCloud, average, visible
from baselines.scene.sight import Moment
from baselines.scene.views import apply_affine
from sacil_tasks.errors import UsageError
from sacil_tasks.interface import SCENE_BOUNDS

PYRAMID = Pyramid(
    voxel_m=0.005, points=96, stages=(48, 24, 12), radius=0.2, growth=2.0, neighbours=8
)
MOVE = Augmentation(0.6, np.array([0.05, -0.03, 0.02]))


@pytest.fixture(scope="module")
def seen():
    return observation(np.random.default_rng(3), 0)


@pytest.fixture(scope="module")
def ordered() -> np.ndarray:
    """Points in the order of the pyramid."""
    xyz = np.random.default_rng(4).uniform(-0.5, 0.5, (PYRAMID.points, 3)).astype(np.float32)
    return xyz[farthest_first(xyz, PYRAMID.stages[0])]


def places(cloud: PointCloud, moment: Moment) -> np.ndarray:
    """Where in the cube the points are."""
    return moment.gripper_in_cube[:3] + (cloud.reach[0] * cloud.xyz[0]).numpy()


def assert_equal(first: PointCloud, second: PointCloud) -> None:
    for name, value in vars(first).items():
        assert torch.equal(value, getattr(second, name)), name


def test_the_order_of_points_changes_nothing(seen):
    order = [2, 0, 3, 1]
    names = ("rgb", "depth_mm", "intrinsics", "camera_in_base")
    shuffled = replace(seen, **{name: getattr(seen, name)[order] for name in names})
    sight = CloudSight(PYRAMID)
    assert_equal(sight.look([Moment(seen)]), sight.look([Moment(shuffled)]))


def test_voxels_are_the_means_of_their_points_to_the_last_bit():
    rng = np.random.default_rng(0)
    rows = rng.uniform(-1, 1, (5000, 9)).astype(np.float32)
    means = average(rows, 0.25)
    assert np.array_equal(means, average(rng.permutation(rows), 0.25))
    cells = np.floor((rows[:, :3] + 1) / 0.25)
    kinds, index, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    assert np.array_equal(np.floor((means[:, :3] + 1) / 0.25), kinds)
    for column in range(9):
        sums = np.bincount(index.ravel(), rows[:, column])
        np.testing.assert_allclose(means[:, column], sums / counts, atol=2e-6)


def test_the_table_and_what_is_outside_the_cube_are_left_out(seen):
    rows = visible(seen)
    height_m = rows[:, 2] * HALF_SIDE_M + SCENE_BOUNDS.center_in_base[2]
    assert 0 < len(rows) < np.count_nonzero(seen.depth_mm)
    assert height_m.min() > TABLE_M - 1e-6
    assert np.abs(rows[:, :3]).max() <= 1


def test_normals_point_from_a_surface_to_its_camera(seen):
    flat = replace(seen, depth_mm=np.full_like(seen.depth_mm, 700))
    np.testing.assert_allclose(visible(flat)[:, 6:], np.tile([0, 0, 1], (4 * 128**2, 1)), atol=1e-3)


def test_each_point_is_the_farthest_from_those_before_it():
    xyz = np.random.default_rng(1).normal(size=(200, 3)).astype(np.float32)
    order = farthest_first(xyz, 50)
    assert sorted(order) == list(range(200))
    for count in range(1, 50):
        gaps = np.linalg.norm(xyz[:, None] - xyz[order[:count]], axis=-1).min(1)
        assert gaps[order[count]] == pytest.approx(gaps.max())


def test_a_short_choice_begins_a_long_one():
    xyz = np.random.default_rng(1).normal(size=(200, 3)).astype(np.float32)
    assert np.array_equal(farthest_first(xyz, 10)[:10], farthest_first(xyz, 80)[:10])


def test_neighbours_are_the_first_points_within_reach(ordered):
    near, start, before = near_points(ordered, PYRAMID), 0, PYRAMID.points
    for count, radius in zip(PYRAMID.stages, PYRAMID.radii, strict=True):
        gaps = np.linalg.norm(ordered[:count, None] - ordered[None, :before], axis=-1)
        for centre in range(count):
            hits = np.flatnonzero(gaps[centre] <= radius)[: PYRAMID.neighbours]
            expected = np.pad(hits, (0, PYRAMID.neighbours - len(hits)), constant_values=hits[0])
            assert near[start + centre].tolist() == expected.tolist()
        start, before = start + count, count


def test_parents_are_the_three_nearest_points_of_the_next_stage(ordered):
    parents, shares = nearest_three(ordered, PYRAMID)
    last = PYRAMID.stages[-1]
    for point in range(last, PYRAMID.points):
        stage = max(count for count in PYRAMID.stages if count <= point)
        gaps = np.linalg.norm(ordered[:stage] - ordered[point], axis=1)
        expected = np.argsort(gaps)[:3]
        assert parents[point - last].tolist() == expected.tolist()
        weights = 1 / gaps[expected]
        np.testing.assert_allclose(shares[point - last], weights / weights.sum(), rtol=1e-4)


def test_interpolation_keeps_kept_points_and_follows_a_linear_field(ordered):
    parents, shares = nearest_three(ordered, PYRAMID)
    count, last = PYRAMID.stages[0], PYRAMID.stages[-1]
    part = slice(count - last, None)
    slope = np.array([1.0, -2.0, 0.5], np.float32)
    field = torch.from_numpy(ordered @ slope)
    links = (torch.from_numpy(links[part])[None] for links in (parents, shares))
    found = interpolated(field[None, :count, None], *links)[0, :, 0]
    assert torch.equal(found[:count], field[:count])
    farthest = np.linalg.norm(ordered[count:] - ordered[parents[part, 2]], axis=1)
    error = (found - field).numpy()[count:]
    assert (np.abs(error) <= farthest * np.linalg.norm(slope)).all()
    assert np.corrcoef(found[count:], field[count:])[0, 1] > 0.9


def test_the_cloud_moves_as_the_scene_does(seen):
    still, moved = Moment(seen, seed=5), Moment(seen, MOVE, seed=5)
    sight = CloudSight(PYRAMID)
    before, after = sight.look([still]), sight.look([moved])
    in_base = places(before, still) * HALF_SIDE_M + np.array(SCENE_BOUNDS.center_in_base)
    expected = apply_affine(MOVE.to_cube(), in_base)
    np.testing.assert_allclose(places(after, moved), expected, atol=1e-5)
    turned = before.features[0, :, 3:6].numpy() @ MOVE.matrix[:, :3].T
    np.testing.assert_allclose(after.features[0, :, 3:6], turned, atol=1e-5)
    for name in ("near", "parents", "shares", "reach"):
        assert torch.equal(getattr(before, name), getattr(after, name))
    assert torch.equal(before.features[..., 6], after.features[..., 6])


def test_only_the_seed_draws_other_points(seen):
    sight = CloudSight(PYRAMID)
    first, second, other = (sight.look([Moment(seen, seed=seed)]) for seed in (0, 0, 1))
    assert_equal(first, second)
    assert not torch.equal(first.xyz, other.xyz)


@pytest.mark.parametrize("points", [0, 1, 5])
def test_small_clouds_are_repeated(points):
    moment = blank_moments(1, points)[0]
    cloud = CloudSight(PYRAMID).look([moment])
    distinct = np.unique(cloud.xyz[0].numpy().round(5), axis=0)
    assert 1 <= len(distinct) <= max(points, 1)
    assert all(value.isfinite().all() for value in vars(cloud).values())
    assert cloud.near.max() < max(points, 1)
    torch.testing.assert_close(cloud.shares.sum(-1), torch.ones(cloud.shares.shape[:2]))
    if not points:
        assert not cloud.xyz.any()


def test_stages_that_grow_are_refused():
    with pytest.raises(UsageError, match="--stages"):
        replace(PYRAMID, stages=(48, 64, 12))
