"""Scenes: a function of the seed, disjoint between partitions, size independent of all else."""

from functools import cache

import numpy as np
import pytest

from sacil_tasks import scenes
from sacil_tasks.catalog import task_names, task_spec
from sacil_tasks.errors import UsageError
from sacil_tasks.scenes import ATTEMPTS, PARTITIONS

DRAWS = 5000
CHANCE = 4.0
"""Standard errors that chance is allowed."""


@cache
def _draws(task: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Labels, positions and yaws of many validation scenes."""
    seeds = [scenes.scene_seed("val", 0, task, index, 0) for index in range(DRAWS)]
    layouts = [scenes.draw_layout(task_spec(task), seed) for seed in seeds]
    return (
        np.array([scenes.draw_geometry(seed).labels for seed in seeds]),
        np.array([layout.xy_m for layout in layouts]),
        np.array([layout.yaw_rad for layout in layouts]),
    )


def test_partitions_never_meet() -> None:
    drawn = {
        partition: {
            scenes.scene_seed(partition, scene_set, task, index, attempt)
            for scene_set in (0, 1, 12345)
            for task in task_names()
            for index in range(300)
            for attempt in (0, 1, ATTEMPTS - 1)
        }
        for partition in PARTITIONS
    }
    assert sum(map(len, drawn.values())) == len(set.union(*drawn.values()))
    for partition, seeds in drawn.items():
        assert len(seeds) == 3 * len(task_names()) * 300 * 3
        assert {scenes.partition_of(seed) for seed in seeds} == {partition}


def test_typed_and_unseeded_seeds_are_training_scenes() -> None:
    """ManiSkill draws seeds of unseeded resets below 2**31."""
    assert {scenes.partition_of(seed) for seed in (0, 1, 2022, 2**31 - 1)} == {"train"}


@pytest.mark.parametrize("seed", [-1, 2**32])
def test_seeds_outside_32_bits_are_refused(seed: int) -> None:
    with pytest.raises(UsageError, match="a seed is"):
        scenes.partition_of(seed)


def test_unknown_partition_names_the_nearest() -> None:
    with pytest.raises(UsageError, match="Did you mean train"):
        scenes.scene_seed("trian", 0, "pick_and_lift", 0, 0)


@pytest.mark.parametrize("task", task_names())
def test_layouts_keep_their_distance_and_region(task: str) -> None:
    _, xy_m, yaw_rad = _draws(task)
    spec = task_spec(task)
    gaps = np.linalg.norm(xy_m - np.roll(xy_m, 1, axis=1), axis=-1)
    low, high = np.transpose(scenes.REGION_M)
    assert gaps.min() >= spec.spacing_m
    assert np.all((xy_m >= low - 0.07) & (xy_m <= high + 0.07))
    if spec.fixture is None or not spec.fixture.spots_m:
        low, high = np.transpose(spec.region_m)
        assert np.all((xy_m >= low) & (xy_m <= high))
    assert np.abs(yaw_rad).max() <= np.deg2rad(spec.yaw_limit_deg)


@pytest.mark.parametrize("task", [t for t in task_names() if task_spec(t).fixture])
def test_candidates_stand_on_every_spot_of_their_fixture(task: str) -> None:
    spec = task_spec(task)
    for seed in range(50):
        layout = scenes.draw_layout(spec, seed)
        assert np.abs(layout.fixture[:2] - spec.fixture.xy_m).max() <= spec.fixture.shift_m
        if spec.fixture.spots_m:
            spots = scenes.in_world(layout.fixture, np.array(spec.fixture.spots_m))
            gaps = np.linalg.norm(layout.xy_m[:, None] - spots, axis=-1)
            assert sorted(gaps.argmin(axis=1)) == [0, 1, 2]
            assert gaps.min(axis=1).max() <= np.sqrt(2) * spec.fixture.spot_shift_m


@pytest.mark.parametrize("task", task_names())
def test_size_order_is_a_uniform_permutation(task: str) -> None:
    labels, _, _ = _draws(task)
    _, counts = np.unique(labels, axis=0, return_counts=True)
    expected = DRAWS / 6
    assert len(counts) == 6
    assert np.abs(counts - expected).max() < CHANCE * np.sqrt(expected)


@pytest.mark.parametrize("task", task_names())
def test_size_tells_nothing_of_position_heading_or_index(task: str) -> None:
    """Mutual information in nats, with the bias that chance gives it, between label and place."""
    labels, xy_m, yaw_rad = _draws(task)
    features = [xy_m[..., 0], xy_m[..., 1], yaw_rad, np.broadcast_to(np.arange(3), labels.shape)]
    for feature in features:
        _, bins = np.unique(feature, return_inverse=True)
        bins = bins.ravel() * 8 // (bins.max() + 1)
        assert _mutual_information(labels.ravel(), bins) < 3 * 14 / (2 * labels.size)


def _mutual_information(first: np.ndarray, second: np.ndarray) -> float:
    joint = np.zeros((first.max() + 1, second.max() + 1))
    np.add.at(joint, (first, second), 1 / len(first))
    product = joint.sum(1, keepdims=True) * joint.sum(0)
    seen = joint > 0
    return float((joint[seen] * np.log(joint[seen] / product[seen])).sum())


def test_streams_of_one_seed_are_unrelated() -> None:
    """ManiSkill's own streams repeat: an object's size would equal its position."""
    draws = np.array(
        [[scenes.stream(s, tag).random() for tag in scenes.STREAMS] for s in range(2000)]
    )
    correlation = np.corrcoef(draws.T) - np.eye(len(scenes.STREAMS))
    assert np.abs(correlation).max() < CHANCE / np.sqrt(2000)


def test_colours_are_common_but_for_half_of_training() -> None:
    shared = {}
    for partition in PARTITIONS:
        seeds = [scenes.scene_seed(partition, 0, "pick_and_lift", i, 0) for i in range(1000)]
        rgb = np.array([scenes.draw_geometry(seed).rgb for seed in seeds])
        shared[partition] = np.mean(np.all(rgb == rgb[:, :1], axis=(1, 2)))
    assert shared["val"] == shared["test"] == 1.0
    assert shared["train"] == pytest.approx(0.5 + 0.5 / len(scenes.COLOURS) ** 2, abs=0.06)
