"""Photographs of keyframes -> one picture: a row for each agent, a column for each keyframe.

A white cross is where the expert's keyframe is, a disc where the agent's is: green if the two are
aligned, red if not (figure 3 of the paper). Under each photograph stands how far apart they are.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import cv2
import numpy as np
from jaxtyping import Float64, UInt8

from leaderboard.deviation import Deviation
from sacil_tasks.interface import Keyframe

Image = UInt8[np.ndarray, "h w 3"]
Rgb = tuple[int, int, int]

TILE_PIXELS = 288
EXTRA_COLUMNS = 2
"""Keyframes beyond the expert's number that are still shown."""

GREEN, RED, GREY, WHITE, BLACK = (
    (30, 150, 60),
    (205, 40, 40),
    (120, 120, 120),
    (255, 255, 255),
    (0, 0, 0),
)

_NEAR_M = 0.01
_LINE_PIXELS = 24
_BORDER_PIXELS = 3
_PHOTO_PIXELS = TILE_PIXELS - 2 * _BORDER_PIXELS
_MARK_PIXELS, _THICK_PIXELS = 9, 2


@dataclass(frozen=True)
class Camera:
    """Where the photographs are taken from."""

    intrinsic: Float64[np.ndarray, "3 3"]
    """Pinhole matrix in pixels."""

    base_to_camera: Float64[np.ndarray, "3 4"]
    """x right, y down, z forward."""

    def pixel(self, position_m: Float64[np.ndarray, "3"]) -> tuple[int, int] | None:
        """Column and row at which a point in the base frame is seen; None behind the camera."""
        x, y, z = self.intrinsic @ (self.base_to_camera @ np.append(position_m, 1.0))
        return None if z < _NEAR_M else (round(x / z), round(y / z))

    def scaled(self, factor: float) -> Self:
        """The same camera with so many times the pixels a side."""
        return replace(self, intrinsic=np.diag([factor, factor, 1.0]) @ self.intrinsic)


@dataclass(frozen=True)
class Step:
    """One keyframe of an agent."""

    keyframe: Keyframe
    refusal: str | None
    """Why it was not executed."""

    photo: Image | None
    """The scene after it; None for a keyframe that no strip shows."""


@dataclass(frozen=True)
class Course:
    """What an agent did in a scene."""

    title: str
    start: Image
    """The scene before its first keyframe."""

    steps: Sequence[Step]
    expert: Sequence[Keyframe]
    camera: Camera

    def deviation(self, number: int) -> Deviation | None:
        """Of keyframe `number` from the expert's; None beyond the expert's last."""
        if number >= len(self.expert):
            return None
        return Deviation.of(self.steps[number].keyframe, self.expert[number])


def draw(headline: str, courses: Sequence[Course]) -> Image:
    """The picture of one scene, with its words above."""
    columns = 1 + max(len(_shown(course)) for course in courses)
    rows = [_row(course, columns) for course in courses]
    width = rows[0].shape[1]
    return np.concatenate([_text([headline], width, BLACK), *rows])


def columns_of(expert: Sequence[Keyframe]) -> int:
    """How many keyframes a strip shows."""
    return len(expert) + EXTRA_COLUMNS


def _tile(course: Course, number: int, photo: Image) -> Image:
    """One keyframe: the photograph with both positions marked, and the deviation under it."""
    step, deviation = course.steps[number], course.deviation(number)
    colour = GREY if deviation is None else GREEN if deviation.aligned else RED
    small = _resized(photo)
    if number < len(course.expert):
        camera = course.camera.scaled(_PHOTO_PIXELS / len(photo))
        _mark(small, camera, step.keyframe, course.expert[number], colour)
    caption = "beyond the expert's last" if deviation is None else str(deviation)
    if step.refusal:
        caption, colour = f"{caption}; {step.refusal}", RED
    return _framed(small, f"{number + 1}: {caption}", colour)


def _shown(course: Course) -> list[Image]:
    photos = [step.photo for step in course.steps[: columns_of(course.expert)]]
    return [photo for photo in photos if photo is not None]


def _row(course: Course, columns: int) -> Image:
    photos = _shown(course)
    start = _framed(_resized(course.start), "start", GREY)
    tiles = [start, *(_tile(course, k, photo) for k, photo in enumerate(photos))]
    tiles += [np.full_like(tiles[0], 255)] * (columns - len(tiles))
    hidden = len(course.steps) - len(photos)
    title = course.title + (f" ({hidden} more keyframes not shown)" if hidden else "")
    strip = np.concatenate(tiles, axis=1)
    return np.concatenate([_text([title], strip.shape[1], BLACK), strip])


def _mark(photo: Image, camera: Camera, keyframe: Keyframe, expert: Keyframe, colour: Rgb) -> None:
    """Draw both positions and the way between them into a photograph."""
    ours, theirs = camera.pixel(keyframe.position_m), camera.pixel(expert.position_m)
    size, thick, smooth = _MARK_PIXELS, _THICK_PIXELS, cv2.LINE_AA
    if ours and theirs:
        cv2.line(photo, ours, theirs, colour, thick, smooth)
    if ours:
        cv2.circle(photo, ours, size, colour, cv2.FILLED, smooth)
        cv2.circle(photo, ours, size, WHITE, 1, smooth)
    if theirs:
        cv2.drawMarker(photo, theirs, BLACK, cv2.MARKER_CROSS, size, 2 * thick, smooth)
        cv2.drawMarker(photo, theirs, WHITE, cv2.MARKER_CROSS, size, thick, smooth)


def _resized(photo: Image) -> Image:
    side = (_PHOTO_PIXELS, _PHOTO_PIXELS)
    small: Image = cv2.resize(photo, side, interpolation=cv2.INTER_AREA)
    return small


def _framed(photo: Image, caption: str, colour: Rgb) -> Image:
    """A photograph with a coloured border and a line of text under it."""
    edges = (_BORDER_PIXELS,) * 4
    framed = cv2.copyMakeBorder(photo, *edges, cv2.BORDER_CONSTANT, value=colour)
    return np.concatenate([framed, _text([caption], TILE_PIXELS, colour)])


def _text(lines: Sequence[str], width: int, colour: Rgb) -> Image:
    """Lines on white, made smaller where they are too long."""
    strip = np.full((_LINE_PIXELS * len(lines) + 4, width, 3), 255, np.uint8)
    font, smooth = cv2.FONT_HERSHEY_SIMPLEX, cv2.LINE_AA
    for row, line in enumerate(lines, start=1):
        (wide, _), _ = cv2.getTextSize(line, font, 0.5, 1)
        scale = 0.5 * min(1.0, (width - 12) / max(wide, 1))
        cv2.putText(strip, line, (6, row * _LINE_PIXELS - 6), font, scale, colour, 1, smooth)
    return strip
