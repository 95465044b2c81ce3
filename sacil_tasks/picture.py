"""Pictures of the tasks: what people see of a scene, what policies see, and the words below.

`sacil_tasks.cards` is the command that draws them. Scenes are those of `val`.
"""

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import cv2
import gymnasium as gym
import numpy as np
import sapien
from jaxtyping import Float64, UInt8
from mani_skill.utils import sapien_utils
from tqdm import tqdm

from sacil_tasks.cameras import observe
from sacil_tasks.catalog import env_id, task_names
from sacil_tasks.errors import UsageError
from sacil_tasks.files import atomic_path
from sacil_tasks.interface import CAMERAS, MAX_KEYFRAMES
from sacil_tasks.motion.executor import KeyframeExecutor
from sacil_tasks.scenes import scene_seed
from sacil_tasks.table import SizedTableEnv
from sacil_tasks.vulkan import explain_render_failure

DRAWN_PIXELS = 1024
"""Overviews are drawn larger than they are shown: edges come out smooth."""

MARGIN_PIXELS, LINE_PIXELS = 8, 18
FONT, FONT_SCALE = cv2.FONT_HERSHEY_SIMPLEX, 0.45

GRID_COLUMNS = 3
TILE_PIXELS, VIEW_PIXELS = 400, 256
"""Sides of an overview in the README's grid, and of a camera's image."""

CARD_PIXELS = 2 * VIEW_PIXELS + LINE_PIXELS + 2 * MARGIN_PIXELS
"""Side of the overview on a card: with its caption as tall as two captioned views."""

FOV_RAD, FILLED = 0.5, 0.85
"""Of the camera for people, and how much of its image the scene may fill."""

AZIMUTH_RAD, ELEVATION_RAD = np.deg2rad(57), np.deg2rad(33)
"""Where that camera is, seen from the scene: drawers open to this side, the arm is behind."""

Image = UInt8[np.ndarray, "h w 3"]


@dataclass(frozen=True)
class Shot:
    """What one scene looks like, to people and to policies."""

    task: str
    quote: str
    """The instruction, in quotation marks."""

    overview: Image
    """After the expert's first keyframe."""

    views: tuple[Image, ...]
    """What the cameras see at the start, in the order of `CAMERAS`."""


def draw_all(docs: Path, scene: int) -> None:
    """Draw the picture of each card, and those of the README.

    Raises:
        UsageError: nothing here can render, the expert cannot begin, or a file cannot be written.
    """
    shots = [shoot(task, scene) for task in tqdm(task_names(), desc="pictures", disable=None)]
    for shot in shots:
        save(docs / "tasks" / f"{shot.task}.png", card_picture(shot))
    save(docs / "images" / "tasks.png", overview_picture(shots))
    save(docs / "images" / "cameras.png", joined(_views(shots[0]), axis=1))


def shoot(task: str, scene: int) -> Shot:
    """Set up a validation scene of `task`, and take its pictures.

    Raises:
        UsageError: nothing here can render, or the expert cannot begin.
    """
    seed = scene_seed("val", 0, task, scene, 0)
    env = _make(task)
    env.reset(seed=seed)
    views = observe(env, step=0, max_steps=MAX_KEYFRAMES, gripper_open=True).rgb
    executor = KeyframeExecutor(env)
    executor.begin()
    refusal = executor.execute(env.expert_keyframe(0, env.target_order()))
    if refusal is not None:
        raise UsageError(
            f"the expert cannot begin scene {scene} of {task} ({refusal.reason}); "
            "choose another one with --scene."
        )
    aim(env)
    overview = env.render_rgb_array()[0].cpu().numpy()
    shot = Shot(task, f'"{env.get_language_instruction()[0]}"', overview, tuple(views))
    env.close()
    return shot


def _make(task: str) -> SizedTableEnv:
    try:
        made = gym.make(
            env_id(task),
            obs_mode="none",
            control_mode="pd_joint_pos",
            render_mode="rgb_array",
            render_backend="cpu",
            human_render_camera_configs={
                "width": DRAWN_PIXELS,
                "height": DRAWN_PIXELS,
                "fov": FOV_RAD,
            },
        )
    except RuntimeError as error:
        raise explain_render_failure(error) from error
    return cast(SizedTableEnv, made.unwrapped)


def aim(env: SizedTableEnv) -> None:
    """Move the camera for people to where the hand and all that is on the table fill its image."""
    corners_m = _corners_m(env)
    middle_m = (corners_m.min(0) + corners_m.max(0)) / 2
    level = np.array([np.cos(AZIMUTH_RAD), np.sin(AZIMUTH_RAD), 0.0])
    back = np.cos(ELEVATION_RAD) * level + np.array([0.0, 0.0, np.sin(ELEVATION_RAD)])
    right = np.cross([0.0, 0.0, 1.0], level)
    seen_m = (corners_m - middle_m) @ np.stack([right, np.cross(back, right), back], axis=1)
    # A corner stays inside if it is this far off the axis at its own distance, or less.
    slope = FILLED * np.tan(FOV_RAD / 2)
    distance_m = (np.abs(seen_m[:, :2]).max(1) / slope + seen_m[:, 2]).max()
    pose = sapien_utils.look_at(middle_m + distance_m * back, middle_m)
    env.scene.human_render_cameras["render_camera"].camera.set_local_pose(pose.sp)


def _corners_m(env: SizedTableEnv) -> Float64[np.ndarray, "n 3"]:
    """Corners of the boxes around the hand and all that is on the table, in the world frame."""
    arm = {link.name for link in env.agent.robot.links} - {"panda_hand"}
    boxes_m = [
        np.asarray(body.compute_global_aabb_tight(), dtype=np.float64)
        for entity in env.scene.sub_scenes[0].entities
        if (body := entity.find_component_by_type(sapien.render.RenderBodyComponent)) is not None
        and entity.name not in arm
    ]
    visible_m = [box for box in boxes_m if box[1, 2] > 1e-3]  # not the table, nor what is parked
    return np.concatenate([np.stack(np.meshgrid(*box.T), -1).reshape(-1, 3) for box in visible_m])


def card_picture(shot: Shot) -> Image:
    """Overview with its instruction, and the views of the four cameras beside it."""
    views = _views(shot)
    rows = [joined(views[:2], axis=1), joined(views[2:], axis=1)]
    overview = panel(shot.overview, CARD_PIXELS, shot.quote)
    return joined([overview, joined(rows, axis=0)], axis=1)


def overview_picture(shots: Sequence[Shot]) -> Image:
    """All overviews in rows, each with the task's name and an instruction."""
    tiles = [panel(shot.overview, TILE_PIXELS, f"{shot.task}\n{shot.quote}") for shot in shots]
    starts = range(0, len(tiles), GRID_COLUMNS)
    return joined([joined(tiles[i : i + GRID_COLUMNS], axis=1) for i in starts], axis=0)


def _views(shot: Shot) -> list[Image]:
    named = zip(shot.views, CAMERAS, strict=True)
    return [panel(image, VIEW_PIXELS, name) for image, name in named]


def panel(image: Image, pixels: int, words: str) -> Image:
    """An image at `pixels` a side with words below it."""
    way = cv2.INTER_AREA if len(image) > pixels else cv2.INTER_NEAREST
    scaled = cast(Image, cv2.resize(image, (pixels, pixels), interpolation=way))
    lines = [line for part in words.splitlines() for line in wrapped(part, pixels)]
    strip = np.full((LINE_PIXELS * len(lines) + MARGIN_PIXELS, pixels, 3), 255, np.uint8)
    for row, line in enumerate(lines, start=1):
        start = ((pixels - _width(line)) // 2, LINE_PIXELS * row)
        cv2.putText(strip, line, start, FONT, FONT_SCALE, (0, 0, 0), 1, cv2.LINE_AA)
    return np.concatenate([scaled, strip])


def wrapped(words: str, pixels: int) -> list[str]:
    """Words in as few lines as fit into a width, of about the same length."""
    ways = (textwrap.wrap(words, characters) for characters in range(1, len(words) + 1))
    fitting = [lines for lines in ways if max(map(_width, lines)) <= pixels]
    return min(fitting, key=lambda lines: (len(lines), max(map(_width, lines))))


def _width(words: str) -> int:
    (width, _), _ = cv2.getTextSize(words, FONT, FONT_SCALE, 1)
    return width


def joined(images: Sequence[Image], axis: int) -> Image:
    """Images below (`axis` 0) or beside each other (1) on white, apart by a margin."""
    size = np.max([image.shape for image in images], axis=0)
    padded = []
    for image in images:
        room = size - image.shape
        room[axis] = MARGIN_PIXELS if image is not images[-1] else 0
        padded.append(np.pad(image, [(0, after) for after in room], constant_values=255))
    return np.concatenate(padded, axis=axis)


def save(path: Path, image: Image) -> None:
    """Write an image as a PNG.

    Raises:
        UsageError: the file cannot be written.
    """
    coded, data = cv2.imencode(
        ".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_PNG_COMPRESSION, 9]
    )
    if not coded:
        raise UsageError(f"OpenCV could not encode {path} as a PNG.")
    with atomic_path(path) as draft:
        draft.write_bytes(data.tobytes())
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB")
