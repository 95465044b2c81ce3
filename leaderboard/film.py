"""Control steps -> one video per episode, with its words and what came of them."""

import textwrap
from pathlib import Path
from typing import Any, Self, SupportsFloat, cast

import cv2
import gymnasium as gym
import imageio.v2 as imageio
import numpy as np
from jaxtyping import UInt8
from mani_skill.envs.sapien_env import BaseEnv
from torch import Tensor

from leaderboard.records import EpisodeRecord
from sacil_tasks.episode import Stage
from sacil_tasks.errors import UsageError

STEPS_PER_FRAME = 4
FRAMES_PER_SECOND = 10
"""Twice real time at 20 control steps a second."""

_CAPTION_PIXELS = 64
_LINE_PIXELS = 20
_CHARACTERS = 60


class Film(gym.Wrapper):
    """Renders ManiSkill's camera for people every few control steps."""

    def __init__(self, env: gym.Env, folder: Path) -> None:
        """Film `env` into `folder`."""
        super().__init__(env)
        self._folder = folder
        self._frames: list[UInt8[np.ndarray, "h w 3"]] = []
        self._steps = 0

    @classmethod
    def of(cls, stage: Stage, folder: Path) -> Self:
        """Put a camera between a stage's recorder and its environment."""
        film = cls(stage.recorder.env, folder)
        stage.recorder.env = film
        return film

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Start a new film."""
        self._frames, self._steps = [], 0
        return super().reset(**kwargs)

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Keep a frame now and then, and step."""
        if self._steps % STEPS_PER_FRAME == 0:
            self._frames.append(self._render())
        self._steps += 1
        return super().step(action)

    def save(self, record: EpisodeRecord) -> None:
        """Write the episode as mp4, named by its key and outcome; nothing if no step was made.

        Raises:
            UsageError: the folder cannot be written.
        """
        if not self._frames:
            return
        words = f"{record.task}-{record.split}-{record.scene:04d}-{record.variation}"
        path = self._folder / f"{words}-{record.outcome.lower()}.mp4"
        strip = caption(record, width=self._frames[0].shape[1])
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            frames = [np.concatenate([strip, frame]) for frame in self._frames]
            imageio.mimwrite(path, cast(list[Any], frames), fps=FRAMES_PER_SECOND)
        except OSError as error:
            raise UsageError(
                f"cannot write {path}: {error}. Choose another folder with --out, or drop --video."
            ) from error

    def _render(self) -> UInt8[np.ndarray, "h w 3"]:
        image: Tensor = cast(BaseEnv, self.env.unwrapped).render_rgb_array()[0]
        return image.cpu().numpy()


def caption(record: EpisodeRecord, width: int) -> UInt8[np.ndarray, "h w 3"]:
    """White strip: the instruction, then what was taken and why it ended."""
    took = ", ".join(record.handled) or "nothing"
    verdict = f"{record.outcome}  took: {took}  end: {record.end} {record.reason}"
    strip = np.full((_CAPTION_PIXELS, width, 3), 255, np.uint8)
    lines = [*textwrap.wrap(record.instruction, _CHARACTERS)[:2], verdict[:_CHARACTERS]]
    black, thickness, scale = (0, 0, 0), 1, 0.42
    for row, line in enumerate(lines, start=1):
        start = (6, row * _LINE_PIXELS - 4)
        font, smooth = cv2.FONT_HERSHEY_SIMPLEX, cv2.LINE_AA
        cv2.putText(strip, line, start, font, scale, black, thickness, smooth)
    return strip
