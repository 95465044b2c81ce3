"""The pictures of the README: `python -m sacil_tasks.picture` draws them anew.

`tasks.png` shows a scene of each task with its instruction, `cameras.png` what a policy sees of
the first of them. Scenes are those of `val`.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import cast

import cv2
import gymnasium as gym
import numpy as np
import tyro
from jaxtyping import UInt8
from mani_skill.utils import sapien_utils

from sacil_tasks.cameras import observe
from sacil_tasks.catalog import env_id, suite_tasks
from sacil_tasks.errors import UsageError, run_command
from sacil_tasks.files import atomic_path
from sacil_tasks.interface import CAMERAS, MAX_KEYFRAMES
from sacil_tasks.scenes import scene_seed
from sacil_tasks.table import SizedTableEnv
from sacil_tasks.vulkan import explain_render_failure

PANEL_PIXELS = 420
DRAWN_PIXELS = 2 * PANEL_PIXELS
"""Drawn larger and reduced: edges come out smooth."""

CAPTION_PIXELS, MARGIN_PIXELS = 30, 4
EYE_M, TARGET_M, FOV_RAD = (0.72, 0.50, 0.60), (-0.18, 0.0, 0.20), 0.76


@dataclass(frozen=True, kw_only=True)
class PictureConfig:
    """Which scenes to draw, and where to put the pictures."""

    suite: str = "slice"
    """Tasks shown side by side."""

    scene: int = 0
    """Index of the validation scene."""

    out: Path = Path("docs/images")
    """Folder of the pictures."""


Image = UInt8[np.ndarray, "h w 3"]


@dataclass(frozen=True)
class Shot:
    """What one scene looks like, to people and to policies."""

    words: str
    overview: Image
    cameras: tuple[Image, ...]


def shoot(task: str, scene: int) -> Shot:
    """Set up a validation scene of `task` and take its pictures.

    Raises:
        UsageError: nothing here can render.
    """
    camera = {
        "pose": sapien_utils.look_at(EYE_M, TARGET_M),
        "width": DRAWN_PIXELS,
        "height": DRAWN_PIXELS,
        "fov": FOV_RAD,
    }
    try:
        made = gym.make(
            env_id(task),
            render_mode="rgb_array",
            render_backend="cpu",
            human_render_camera_configs=camera,
        )
    except RuntimeError as error:
        raise explain_render_failure(error) from error
    env = cast(SizedTableEnv, made.unwrapped)
    env.reset(seed=scene_seed("val", 0, task, scene, 0))
    drawn = env.render_rgb_array()[0].cpu().numpy()
    seen = observe(env, step=0, max_steps=MAX_KEYFRAMES, gripper_open=True)
    shot = Shot(env.get_language_instruction()[0], drawn, tuple(seen.rgb))
    env.close()
    return shot


def panel(image: Image, words: str) -> Image:
    """An image at panel size with words below it."""
    shrinks = image.shape[0] > PANEL_PIXELS
    way = cv2.INTER_AREA if shrinks else cv2.INTER_NEAREST
    scaled = cv2.resize(image, (PANEL_PIXELS, PANEL_PIXELS), interpolation=way)
    strip = np.full((CAPTION_PIXELS, PANEL_PIXELS, 3), 255, np.uint8)
    font, scale = cv2.FONT_HERSHEY_SIMPLEX, 0.43
    (width, _), _ = cv2.getTextSize(words, font, scale, 1)
    start = ((PANEL_PIXELS - width) // 2, 20)
    cv2.putText(strip, words, start, font, scale, (0, 0, 0), 1, cv2.LINE_AA)
    margin = ((0, 0), (MARGIN_PIXELS, MARGIN_PIXELS), (0, 0))
    return np.pad(np.concatenate([scaled, strip]), margin, constant_values=255)


def save_row(path: Path, panels: list[Image]) -> None:
    """Write panels side by side as a PNG.

    Raises:
        UsageError: the file cannot be written.
    """
    row = cv2.cvtColor(np.concatenate(panels, axis=1), cv2.COLOR_RGB2BGR)
    coded, data = cv2.imencode(".png", row, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    if not coded:
        raise UsageError(f"OpenCV could not encode {path} as a PNG.")
    with atomic_path(path) as draft:
        draft.write_bytes(data.tobytes())
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


def main(config: PictureConfig) -> None:
    """Draw both pictures."""
    shots = [shoot(task, config.scene) for task in suite_tasks(config.suite)]
    save_row(config.out / "tasks.png", [panel(shot.overview, shot.words) for shot in shots])
    named = zip(shots[0].cameras, CAMERAS, strict=True)
    save_row(config.out / "cameras.png", [panel(image, name) for image, name in named])


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(PictureConfig, description=__doc__)))
