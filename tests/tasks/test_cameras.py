"""Cameras: calibrated, repeatable, blind to words, and sizes can be told apart through them."""

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sacil_tasks import scenes
from sacil_tasks.cameras import RIGS, observe
from sacil_tasks.catalog import env_id, task_names, task_spec
from sacil_tasks.errors import UsageError
from sacil_tasks.instructions import variations
from sacil_tasks.interface import CAMERAS, IMAGE_PIXELS, Observation
from sacil_tasks.scenes import scene_seed
from sacil_tasks.table import SizedTableEnv
from sacil_tasks.tasks.pick_and_lift import GOAL_RADIUS_M

pytestmark = pytest.mark.sim


def _made(task: str, **kwargs: Any) -> gym.Env:
    return gym.make(env_id(task), **{"obs_mode": "none", "render_backend": "cpu"} | kwargs)


@pytest.fixture(scope="module", autouse=True)
def blocks() -> Iterator[SizedTableEnv]:
    """Alive throughout: shaders are compiled again after the last environment has closed."""
    made = _made("pick_and_lift")
    yield made.unwrapped  # type: ignore[misc]
    made.close()


@pytest.fixture(scope="module", params=task_names())
def env(request: pytest.FixtureRequest, blocks: SizedTableEnv) -> Iterator[SizedTableEnv]:
    if request.param == "pick_and_lift":
        yield blocks
        return
    made = _made(request.param)
    yield made.unwrapped  # type: ignore[misc]
    made.close()


def _look(env: SizedTableEnv, seed: int, **options: Any) -> Observation:
    env.reset(seed=seed, options=options)
    return observe(env, step=0, max_steps=25, gripper_open=True)


def test_an_observation_is_what_the_contract_says(env: SizedTableEnv) -> None:
    seen = _look(env, 1)
    size = (len(CAMERAS), IMAGE_PIXELS, IMAGE_PIXELS)
    assert (seen.rgb.shape, seen.rgb.dtype) == ((*size, 3), np.uint8)
    assert (seen.depth_mm.shape, seen.depth_mm.dtype) == (size, np.uint16)
    assert seen.intrinsics.dtype == seen.camera_in_base.dtype == np.float32
    assert seen.tcp_in_base.shape == (7,)
    turns = seen.camera_in_base[:, :3, :3].astype(np.float64)
    assert np.allclose(turns @ turns.transpose(0, 2, 1), np.eye(3), atol=1e-5)
    assert np.allclose(np.linalg.det(turns), 1)
    assert seen.depth_mm[seen.depth_mm > 0].min() > 50


def test_same_seed_same_pixels_and_words_change_none(env: SizedTableEnv) -> None:
    first = _look(env, 3)
    _look(env, 4)
    for slots in variations(env.task):
        again = _look(env, 3, slots=slots)
        assert np.array_equal(first.rgb, again.rgb)
        assert np.array_equal(first.depth_mm, again.depth_mm)


def _points_in_base(seen: Observation, view: int) -> np.ndarray:
    """Pixels of one view as points; written apart from the project's own unprojection."""
    columns, rows = np.meshgrid(np.arange(IMAGE_PIXELS) + 0.5, np.arange(IMAGE_PIXELS) + 0.5)
    depth_m = seen.depth_mm[view].astype(np.float64) / 1000
    fx, fy = seen.intrinsics[view, 0, 0], seen.intrinsics[view, 1, 1]
    cx, cy = seen.intrinsics[view, 0, 2], seen.intrinsics[view, 1, 2]
    in_camera = np.stack([(columns - cx) / fx, (rows - cy) / fy, np.ones_like(rows)], axis=-1)
    pose = seen.camera_in_base[view].astype(np.float64)
    return (in_camera * depth_m[..., None]) @ pose[:3, :3].T + pose[:3, 3]


def _central_seed() -> int:
    """A scene whose sphere hangs where all four cameras see it."""
    spec = task_spec("pick_and_lift")
    goals = [scenes.draw_layout(spec, seed).goal_m for seed in range(200)]
    return int(np.linalg.norm(np.subtract(goals, (0.02, 0.0, 0.2)), axis=1).argmin())


@pytest.mark.parametrize("view", range(len(CAMERAS)), ids=CAMERAS)
def test_unprojected_sphere_is_where_it_hangs(blocks: SizedTableEnv, view: int) -> None:
    """Least-squares centre of the sphere's pixels: half a pixel off would be 2 mm and more."""
    seen = _look(blocks, _central_seed())
    goal = blocks.goal.pose.p[0].numpy() - blocks.base_in_world_m
    points = _points_in_base(seen, view).reshape(-1, 3)
    surface = np.abs(np.linalg.norm(points - goal, axis=1) - GOAL_RADIUS_M) < 0.004
    points = points[surface]
    assert len(points) > 80
    system = np.column_stack([2 * points, np.ones(len(points))])
    centre = np.linalg.lstsq(system, (points**2).sum(1), rcond=None)[0][:3]
    assert np.abs(centre - goal).max() < 0.0015


@pytest.mark.parametrize("view", range(len(CAMERAS)), ids=CAMERAS)
def test_unprojected_table_is_flat_at_zero(blocks: SizedTableEnv, view: int) -> None:
    heights = _points_in_base(_look(blocks, 5), view)[..., 2]
    table = heights[np.abs(heights) < 0.01]
    assert table.size > IMAGE_PIXELS**2 // 3
    assert abs(np.median(table)) < 5e-4
    assert np.quantile(np.abs(table), 0.95) < 2e-3  # the rest are feet of blocks


def _pixels_by_label(env: SizedTableEnv, seed: int, split: str) -> np.ndarray:
    """Visible pixels of the small, medium and large candidate in each view."""
    env.reset(seed=seed, options={"split": split})
    env.scene.update_render(update_sensors=True, update_human_render_cameras=False)
    ids: dict[str, list[int]] = {}
    for number, thing in env.segmentation_id_map.items():
        owner = getattr(thing, "articulation", None) or thing
        ids.setdefault(owner.name, []).append(number)
    counts = np.zeros((len(CAMERAS), 3), dtype=int)
    for view, name in enumerate(CAMERAS):
        sensor = env.scene.sensors[name]
        sensor.capture()
        labels = sensor.get_obs(rgb=False, depth=False, position=False)["segmentation"]
        for k, label in enumerate(("small", "medium", "large")):
            candidate = env.candidates[env.candidate_labels.index(label)]
            counts[view, k] = np.isin(labels.numpy(), ids[candidate.name]).sum()
    return counts


def test_sizes_can_be_told_apart_in_two_views_of_any_scene(env: SizedTableEnv) -> None:
    for split in {"canon", "shift_down", "shift_up"} & set(env.task.splits):
        for index in range(6):
            seed = scene_seed("val", 0, env.task.name, index, 0)
            counts = _pixels_by_label(env, seed, split)
            told_apart = (np.diff(counts, axis=1) > 0).sum(axis=0)
            assert told_apart.min() >= 2, f"{split} {index}: {counts}"
            hidden = (counts == 0).sum(axis=0)
            assert hidden.max() <= 1, f"{split} {index}: {counts}"


@pytest.mark.parametrize("mode", ["rgbd", "pointcloud", "state_dict+rgb", "depth+segmentation"])
def test_stock_observation_modes_work_and_hide_the_candidates(mode: str) -> None:
    made = _made("push_buttons", obs_mode=mode)
    seen, _ = made.reset(seed=1)
    made.step(made.action_space.sample())
    if "state" not in mode:
        assert set(seen["extra"]) == {"tcp_pose"}
    made.close()


def test_rlbench_poses_are_an_option() -> None:
    made = _made("pick_and_lift", camera_rig="rlbench")
    seen = _look(made.unwrapped, 1)  # type: ignore[arg-type]
    eye = seen.camera_in_base[0, :3, 3] + made.unwrapped.base_in_world_m
    assert eye == pytest.approx(RIGS["rlbench"]["front"].eye_m, abs=1e-5)
    made.close()
    with pytest.raises(UsageError, match="Did you mean rlbench"):
        _made("pick_and_lift", camera_rig="rlbnch")
