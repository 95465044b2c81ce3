"""Pictures show all that a scene is about, and their captions are whole."""

import cv2
import gymnasium as gym
import numpy as np
import pytest

from sacil_tasks.catalog import env_id, task_names, task_spec
from sacil_tasks.instructions import official_sentences
from sacil_tasks.picture import (
    FONT,
    FONT_SCALE,
    MARGIN_PIXELS,
    TILE_PIXELS,
    aim,
    joined,
    panel,
    wrapped,
)
from sacil_tasks.scenes import scene_seed


@pytest.mark.parametrize("task", task_names())
def test_a_caption_is_whole_and_no_wider_than_its_picture(task):
    longest = max(official_sentences(task_spec(task)), key=len)
    lines = wrapped(longest, TILE_PIXELS)
    assert " ".join(lines) == longest
    assert max(cv2.getTextSize(line, FONT, FONT_SCALE, 1)[0][0] for line in lines) <= TILE_PIXELS


def test_words_stand_below_the_picture():
    image = np.zeros((128, 128, 3), np.uint8)
    captioned = panel(image, 256, "front")
    assert captioned.shape[1] == 256
    assert (captioned[:256] == 0).all()
    assert (captioned[256:] == 255).any()
    assert (captioned[256:] < 128).any()


def test_pictures_are_joined_on_white_without_scaling():
    low, high = np.zeros((10, 20, 3), np.uint8), np.zeros((30, 5, 3), np.uint8)
    row = joined([low, high], axis=1)
    assert row.shape == (30, 20 + MARGIN_PIXELS + 5, 3)
    assert (row == 0).all(-1).sum() == low[..., 0].size + high[..., 0].size
    assert (row[10:, :20] == 255).all()


@pytest.mark.sim
@pytest.mark.parametrize("task", task_names())
def test_the_camera_for_people_sees_every_candidate_and_the_fingers(task):
    env = gym.make(
        env_id(task), obs_mode="none", render_mode="rgb_array", render_backend="cpu"
    ).unwrapped
    env.reset(seed=scene_seed("val", 0, task, 0, 0))
    aim(env)
    fingers = env.tcp_in_base()[:, :3].numpy()
    points = np.concatenate([env.candidate_in_base(), fingers]) + env.base_in_world_m
    camera = env.scene.human_render_cameras["render_camera"].camera
    extrinsic, intrinsic = camera.get_extrinsic_matrix()[0], camera.get_intrinsic_matrix()[0]
    seen = (points @ extrinsic[:, :3].numpy().T + extrinsic[:, 3].numpy()) @ intrinsic.numpy().T
    inside = seen[:, :2] / seen[:, 2:] / [camera.width, camera.height]
    assert (seen[:, 2] > 0).all()
    assert ((inside > 0.05) & (inside < 0.95)).all()
    env.close()
