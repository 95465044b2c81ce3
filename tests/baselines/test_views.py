"""Virtual views against a loop over points, and the behaviour at the edges."""

import multiprocessing
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from baselines.scene.views import (
    BACK,
    EMPTY_DEPTH,
    FRONT,
    LEFT,
    RIGHT,
    THREE_VIEWS,
    TOP,
    VIEWS,
    apply_affine,
    base_from_cube,
    cube_from_base,
    project,
    render_views,
)
from sacil_tasks.interface import SCENE_BOUNDS

IDENTITY = np.eye(3, 4, dtype=np.float32)
ONE = np.float32(1)
CHOICES = pytest.mark.parametrize(
    "views", [VIEWS, THREE_VIEWS, (BACK,)], ids=["five", "three", "one"]
)


def first_cells(value: np.float32, pixels: int, sign: int) -> tuple[int, int]:
    """The two pixels a point covers along one image axis that runs with or against its axis."""
    first = int(np.floor(np.float32(pixels / 2) * (ONE + value) - np.float32(0.5)))
    pair = (first, first + 1)
    return pair if sign > 0 else (pixels - 1 - pair[0], pixels - 1 - pair[1])


def image_place(view, point, pixels):
    """Columns, rows and depth of a point, written out view by view."""
    x, y, z = point
    along = {
        TOP: (x, 1, y, ONE - z),
        FRONT: (x, -1, z, ONE - y),
        BACK: (x, 1, z, ONE + y),
        LEFT: (y, 1, z, ONE - x),
        RIGHT: (y, -1, z, ONE + x),
    }
    u, sign, v, depth = along[view]
    return first_cells(u, pixels, sign), first_cells(v, pixels, -1), depth


def reference_view(chosen, points, rgb, pixels):
    """One view drawn point by point, pixel by pixel."""
    view = np.zeros((7, pixels, pixels), np.float32)
    winner = {}
    for i, point in enumerate(points):
        if not (np.abs(point) <= 1).all():
            continue
        columns, rows, depth = image_place(chosen, point, pixels)
        for pixel in [(r, c) for r in rows for c in columns]:
            inside = min(pixel) >= 0 and max(pixel) < pixels
            if inside and (pixel not in winner or depth < winner[pixel][0]):
                winner[pixel] = (depth, i)
    mean = np.float32(sum(float(winner[p][0]) for p in sorted(winner)) / max(len(winner), 1))
    view[6] = EMPTY_DEPTH
    for (row, column), (depth, i) in winner.items():
        view[:3, row, column] = points[i]
        view[3:6, row, column] = rgb[i] / np.float32(255)
        view[6, row, column] = depth - mean
    return view


def reference_views(points, rgb, pixels, views=VIEWS):
    with np.errstate(invalid="ignore"):
        return np.stack([reference_view(view, points, rgb, pixels) for view in views])


def random_cloud(seed, count, reach=1.1):
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(-reach, reach, (count, 3)).astype(np.float32)
    return xyz, rng.integers(0, 256, (count, 3), dtype=np.uint8)


@pytest.mark.parametrize("pixels", [7, 16, 40])
@pytest.mark.parametrize("count", [1, 20, 800])
@CHOICES
def test_views_equal_the_loop_over_points(pixels, count, views):
    xyz, rgb = random_cloud(count + pixels, count)
    np.testing.assert_array_equal(
        render_views(xyz, rgb, IDENTITY, pixels, views=views),
        reference_views(xyz, rgb, pixels, views),
    )


@pytest.mark.parametrize("pixels", [128, 220])
def test_views_of_a_whole_observation_equal_the_loop_over_points(pixels):
    xyz, rgb = random_cloud(0, 6000, reach=1.02)
    xyz[:2000, 2] *= 0.02  # a table: crowded side views
    np.testing.assert_array_equal(
        render_views(xyz, rgb, IDENTITY, pixels), reference_views(xyz, rgb, pixels)
    )


def test_points_on_a_coarse_lattice_with_many_ties_equal_the_loop_over_points():
    rng = np.random.default_rng(3)
    xyz = (rng.integers(-4, 5, (600, 3)) / 4).astype(np.float32)  # faces and corners included
    rgb = rng.integers(0, 256, (600, 3), dtype=np.uint8)
    np.testing.assert_array_equal(render_views(xyz, rgb, IDENTITY, 8), reference_views(xyz, rgb, 8))


def test_nearest_neighbours_in_depth_are_told_apart():
    depths = [np.float32(0.7)]
    for _ in range(5):
        depths.append(np.nextafter(depths[-1], np.float32(1)))
    xyz = np.array([(0, 0, d) for d in depths], np.float32)
    rgb = np.arange(len(xyz) * 3, dtype=np.uint8).reshape(-1, 3)
    top = render_views(xyz, rgb, IDENTITY, 16)[0]
    assert (top[2][top[6] != EMPTY_DEPTH] == depths[-1]).all()


def test_on_equal_depth_the_earlier_point_wins():
    xyz = np.zeros((3, 3), np.float32)
    rgb = np.array([[10, 10, 10], [200, 200, 200], [5, 5, 5]], np.uint8)
    views = render_views(xyz, rgb, IDENTITY, 16)
    assert np.unique(views[:, 3]).tolist() == [0.0, np.float32(10) / np.float32(255)]


def test_order_of_points_does_not_matter_without_ties():
    xyz, rgb = random_cloud(5, 500)
    order = np.random.default_rng(0).permutation(len(xyz))
    np.testing.assert_array_equal(
        render_views(xyz, rgb, IDENTITY, 32), render_views(xyz[order], rgb[order], IDENTITY, 32)
    )


def test_no_points_give_background():
    views = render_views(np.empty((0, 3), np.float32), np.empty((0, 3), np.uint8), IDENTITY, 16)
    assert (views[:, :6] == 0).all()
    assert (views[:, 6] == EMPTY_DEPTH).all()


def test_points_that_are_not_finite_or_outside_are_dropped():
    xyz = np.array([[np.nan, 0, 0], [0, np.inf, 0], [0, 0, -np.inf], [0, 0, 1.001]], np.float32)
    views = render_views(xyz, np.full((4, 3), 9, np.uint8), IDENTITY, 16)
    assert (views[:, 6] == EMPTY_DEPTH).all()
    assert np.isfinite(views).all()


def test_one_point_covers_two_by_two_pixels_about_its_projection():
    point = np.array([[0.5, 0.25, -0.5]], np.float32)
    views = render_views(point, np.full((1, 3), 255, np.uint8), IDENTITY, 128)
    for view, (u, v) in zip(views, project(torch.from_numpy(point[0]), 128), strict=True):
        rows, columns = np.nonzero(view[3])
        assert len(rows) == 4
        assert np.abs(rows + 0.5 - float(v)).max() <= 1
        assert np.abs(columns + 0.5 - float(u)).max() <= 1
        assert (view[6][rows, columns] == 0).all()  # one depth: its own mean


def test_corners_of_the_cube_are_drawn_inside_the_image():
    corners = np.array(np.meshgrid(*[[-1, 1]] * 3), np.float32).reshape(3, -1).T.copy()
    views = render_views(corners, np.full((8, 3), 255, np.uint8), IDENTITY, 10)
    for view in views:
        assert sorted(zip(*np.nonzero(view[3]), strict=True)) == [(0, 0), (0, 9), (9, 0), (9, 9)]


def test_depth_is_relative_to_the_mean_over_covered_pixels():
    xyz, rgb = random_cloud(1, 300)
    for view in render_views(xyz, rgb, IDENTITY, 64):
        covered = view[:3].any(axis=0)
        assert abs(view[6][covered].mean()) < 1e-6
        assert (view[6][~covered] == EMPTY_DEPTH).all()


def test_the_transform_is_applied_before_drawing():
    xyz, rgb = random_cloud(2, 2000, reach=0.5)
    transform = cube_from_base()
    placed = np.stack(
        [r[0] * xyz[:, 0] + r[1] * xyz[:, 1] + r[2] * xyz[:, 2] + r[3] for r in transform], axis=-1
    )
    np.testing.assert_array_equal(
        render_views(xyz, rgb, transform, 48), render_views(placed, rgb, IDENTITY, 48)
    )


def test_drawing_into_a_batch_overwrites_what_was_there():
    xyz, rgb = random_cloud(4, 200)
    batch = np.full((2, 5, 7, 24, 24), np.nan, np.float32)
    drawn = render_views(xyz, rgb, IDENTITY, 24, batch[1])
    assert np.shares_memory(drawn, batch)
    np.testing.assert_array_equal(batch[1], render_views(xyz, rgb, IDENTITY, 24))
    assert np.isnan(batch[0]).all()


def test_arrays_that_do_not_fit_are_refused():
    xyz, rgb = random_cloud(0, 5)
    with pytest.raises((ValueError, TypeError)):
        render_views(xyz, rgb, IDENTITY, 24, np.empty((5, 7, 24, 16), np.float32))
    with pytest.raises((ValueError, TypeError)):
        render_views(xyz, rgb[:4], IDENTITY, 24)


def test_three_views_are_three_of_the_five():
    xyz, rgb = random_cloud(7, 4000)
    five = render_views(xyz, rgb, IDENTITY, 40)
    three = render_views(xyz, rgb, IDENTITY, 40, views=THREE_VIEWS)
    np.testing.assert_array_equal(three, five[[VIEWS.index(view) for view in THREE_VIEWS]])


def test_projection_follows_the_table_of_views():
    uv = project(torch.tensor([0.5, 0.25, -0.5]), 220)
    assert uv.tolist() == [[165, 82.5], [55, 165], [165, 165], [137.5, 165], [82.5, 165]]
    three = project(torch.tensor([0.5, 0.25, -0.5]), 220, THREE_VIEWS)
    assert three.tolist() == [[165, 82.5], [137.5, 165], [55, 165]]


def test_cube_spans_the_scene_bounds():
    center, half = np.array(SCENE_BOUNDS.center_in_base), SCENE_BOUNDS.side_m / 2
    corners = center + half * np.array([[-1, -1, -1], [1, 1, 1], [1, -1, 0]])
    in_cube = apply_affine(cube_from_base(), corners)
    np.testing.assert_allclose(in_cube, [[-1, -1, -1], [1, 1, 1], [1, -1, 0]], atol=1e-6)
    back = base_from_cube(torch.from_numpy(in_cube))
    np.testing.assert_allclose(back.numpy(), corners, atol=1e-6)


def _view_sum(seed):
    return float(render_views(*random_cloud(seed, 3000), IDENTITY, 64).sum())


def test_threads_draw_the_same_views():
    expected = [_view_sum(seed) for seed in range(8)]
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(_view_sum, range(8))) == expected


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # fork in a process with threads
def test_a_forked_process_draws_the_same_views():
    expected = [_view_sum(seed) for seed in range(3)]
    with multiprocessing.get_context("fork").Pool(1) as pool:
        assert pool.map(_view_sum, range(3)) == expected
