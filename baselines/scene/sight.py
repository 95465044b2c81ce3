"""From what the cameras saw to the tensors a network reads.

A network names its `Sight`. Training and acting look through the same one, so that what a network
was trained on is what it gets.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, UInt8
from torch import Tensor

from baselines.scene import crop
from baselines.scene.augment import Augmentation
from baselines.scene.cloud import Cloud, crop_to_cube, point_maps, unproject
from baselines.scene.views import (
    CHANNELS,
    THREE_VIEWS,
    VIEWS,
    View,
    apply_affine,
    cube_from_base,
    render_views,
)
from sacil_tasks.interface import CAMERAS, IMAGE_PIXELS, Observation

STILL = Augmentation(0.0, np.zeros(3))


@dataclass(frozen=True)
class Moment:
    """An observation, and how it is to be shown."""

    seen: Observation

    move: Augmentation = STILL
    """How the scene is moved before it is looked at."""

    before: Sequence[Observation] = ()
    """Earlier observations of the episode, the first one first; empty unless they are wanted."""

    seed: int = 0
    """For random choices, among points for example: drawn anew in training, 0 when acting."""

    @property
    def gripper_in_cube(self) -> Float32[np.ndarray, "7"]:
        """Gripper pose after the move: position in the cube, quaternion wxyz."""
        return gripper_in_cube(self.seen, self.move)


class Sight(Protocol):
    """What a network reads of a scene; `look` gives a dataclass of tensors, samples first."""

    @property
    def remembers(self) -> bool:
        """Whether earlier observations are wanted."""

    def look(self, moments: Sequence[Moment]) -> Any:
        """All moments as one batch; no row depends on another."""


def gripper_in_cube(seen: Observation, move: Augmentation) -> Float32[np.ndarray, "7"]:
    """Gripper pose of an observation: position in the cube, quaternion wxyz."""
    pose = move.move_pose(seen.tcp_in_base.astype(np.float64))
    position = apply_affine(cube_from_base(), pose[:3])
    return np.concatenate([position, pose[3:]]).astype(np.float32)


def gripper_px(seen: Observation) -> Float32[np.ndarray, "k 2"]:
    """Column and row at which each camera sees the gripper's position; -inf behind the camera."""
    rotation, origin = seen.camera_in_base[:, :3, :3], seen.camera_in_base[:, :3, 3]
    in_camera = np.einsum("kij,ki->kj", rotation, seen.tcp_in_base[:3] - origin)
    u, v, depth = np.einsum("kij,kj->ik", seen.intrinsics, in_camera)
    ahead = depth > 0
    scale = 1 / np.where(ahead, depth, 1)
    return np.where(ahead, [u * scale, v * scale], -np.inf).T.astype(np.float32)


@dataclass(frozen=True)
class Views:
    """Virtual views of the merged cloud."""

    views: Float[Tensor, "b v 7 h w"]
    """xyz (cube), rgb ([0, 1]), depth; see `baselines.scene.views`."""


class ViewSight:
    """Draws virtual views, by default RVT's five."""

    remembers = False

    def __init__(self, pixels: int, shown: tuple[View, ...] = VIEWS) -> None:
        """Views of `pixels` a side."""
        self.pixels = pixels
        self.shown = shown

    def look(self, moments: Sequence[Moment]) -> Views:
        """Unproject, move and draw each scene."""
        shape = (len(self.shown), len(CHANNELS), self.pixels, self.pixels)
        views = np.empty((len(moments), *shape), np.float32)
        for moment, out in zip(moments, views, strict=True):
            cloud, move = _cloud(moment.seen), moment.move.to_cube()
            render_views(cloud.xyz_in_base, cloud.rgb, move, self.pixels, out, self.shown)
        return Views(torch.from_numpy(views))


@dataclass(frozen=True)
class CubeCloud:
    """A coloured cloud, moved and cropped to the cube; host memory, for the renderer."""

    xyz_in_cube: Float32[np.ndarray, "n 3"]
    rgb: UInt8[np.ndarray, "n 3"]


@dataclass(frozen=True)
class ZoomScene(Views):
    """RVT-2's views, and the clouds they show, so that a part of the scene can be drawn larger."""

    clouds: tuple[CubeCloud, ...]
    """One a sample."""

    draws: Float[Tensor, "b r"]
    """Uniform in [0, 1): the random choices of training, so that a loss needs no generator."""

    def closer(self, centers: Float[Tensor, "b 3"], zoom: float) -> Views:
        """The views of a cube of side 2 / `zoom` about each centre, as large as those of the whole.

        A point p of the cube is drawn at `zoom * (p - center)`; what leaves [-1, 1]^3 is dropped
        (D-zoom-crop).
        """
        turn = zoom * torch.eye(3).expand(len(centers), 3, 3)
        shift = -zoom * centers.detach().float().cpu()
        transforms = torch.cat([turn, shift[..., None]], dim=-1).numpy()
        views = _three_views(self.clouds, transforms, self.views.shape[-1])
        return Views(views.to(self.views.device))


class ZoomSight:
    """Draws RVT-2's three views and keeps the clouds."""

    remembers = False

    def __init__(self, pixels: int, *, draws: int) -> None:
        """Views of `pixels` a side, and so many random numbers a sample."""
        self.pixels = pixels
        self.draws = draws

    def look(self, moments: Sequence[Moment]) -> ZoomScene:
        """Unproject, move, crop and draw each scene."""
        clouds = tuple(
            CubeCloud(*crop_to_cube(_cloud(moment.seen), moment.move.to_cube()))
            for moment in moments
        )
        whole = np.broadcast_to(np.eye(3, 4, dtype=np.float32), (len(clouds), 3, 4))
        draws = [np.random.default_rng(moment.seed).random(self.draws) for moment in moments]
        return ZoomScene(
            views=_three_views(clouds, whole, self.pixels),
            clouds=clouds,
            draws=torch.tensor(np.stack(draws), dtype=torch.float32),
        )


def _cloud(seen: Observation) -> Cloud:
    return unproject(seen.rgb, seen.depth_mm, seen.intrinsics, seen.camera_in_base)


def _three_views(
    clouds: Sequence[CubeCloud], transforms: Float32[np.ndarray, "b 3 4"], pixels: int
) -> Float[Tensor, "b 3 7 h w"]:
    """Each cloud's views after its transform."""
    views = np.empty((len(clouds), len(THREE_VIEWS), len(CHANNELS), pixels, pixels), np.float32)
    for cloud, transform, out in zip(clouds, transforms, views, strict=True):
        render_views(cloud.xyz_in_cube, cloud.rgb, transform, pixels, out, THREE_VIEWS)
    return torch.from_numpy(views)


@dataclass(frozen=True)
class Pictures:
    """What the cameras saw, with the place of every pixel: now, and before if that is wanted.

    The present comes last; shorter histories begin with steps that did not happen.
    """

    rgb: UInt8[Tensor, "b t k 3 h w"]

    xyz_in_cube: Float[Tensor, "b t k 3 h w"]
    """Where each pixel's point is; 0 where nothing was seen."""

    seen: Bool[Tensor, "b t k h w"]
    """Whether the pixel shows a point inside the cube."""

    gripper_in_cube: Float[Tensor, "b t 7"]
    """Position in the cube, quaternion wxyz."""

    gripper_px: Float[Tensor, "b t k 2"]
    """Where in each image the gripper's position is: column, row; pixel j covers [j, j + 1).
    -inf behind the camera and at steps that did not happen."""

    happened: Bool[Tensor, "b t"]
    """False at steps that only pad."""

    step: Float[Tensor, "b t"]
    """Keyframes executed before."""


class CameraSight:
    """Moves the points of camera images; crops the images only if it is told to."""

    def __init__(self, *, remembers: bool, steps: int = 1, crop_px: int = 0) -> None:
        """Show the last `steps` observations, the present one included; in training in a frame
        that is up to `crop_px` columns and rows off."""
        self.remembers = remembers
        self.steps = steps
        self.crop_px = crop_px

    def look(self, moments: Sequence[Moment]) -> Pictures:
        """Images and point maps, as long a history as the longest in the batch."""
        shown = [[*moment.before, moment.seen][-self.steps :] for moment in moments]
        longest = max(len(observations) for observations in shown)
        pictures = _blank(len(moments), longest)
        for row, (moment, observations) in enumerate(zip(moments, shown, strict=True)):
            # D-hiveformer-augment. One frame an episode, as published: steps stay comparable.
            frame = crop.draw(moment.seed, self.crop_px) if moment.seed else crop.WHOLE
            first = longest - len(observations)
            for images in (pictures.rgb, pictures.xyz_in_cube, pictures.seen):
                images[row, :first] = 0
            for t, seen in enumerate(observations, start=first):
                _fill((pictures, row, t), seen, moment.move, frame)
        return pictures


def _blank(rows: int, steps: int) -> Pictures:
    """Steps that did not happen, but for the images, which hold anything."""
    frames, side = (rows, steps, len(CAMERAS)), IMAGE_PIXELS
    # In memory colours come last, as the cameras give them and as convolutions like them.
    return Pictures(
        rgb=torch.empty((*frames, side, side, 3), dtype=torch.uint8).movedim(-1, 3),
        xyz_in_cube=torch.empty((*frames, 3, side, side)),
        seen=torch.empty((*frames, side, side), dtype=torch.bool),
        gripper_in_cube=torch.zeros((rows, steps, 7)),
        gripper_px=torch.full((*frames, 2), -torch.inf),
        happened=torch.zeros((rows, steps), dtype=torch.bool),
        step=torch.zeros((rows, steps)),
    )


def _fill(
    place: tuple[Pictures, int, int], seen: Observation, move: Augmentation, frame: crop.Crop
) -> None:
    pictures, row, t = place
    shown = frame.show(seen)
    xyz_in_cube, inside = point_maps(
        shown.depth_mm, seen.intrinsics, seen.camera_in_base, move.to_cube(), shown.sources
    )
    pictures.rgb[row, t] = torch.from_numpy(shown.rgb).permute(0, 3, 1, 2)
    pictures.xyz_in_cube[row, t] = torch.from_numpy(xyz_in_cube)
    pictures.seen[row, t] = torch.from_numpy(inside)
    pictures.gripper_in_cube[row, t] = torch.from_numpy(gripper_in_cube(seen, move))
    pictures.gripper_px[row, t] = torch.from_numpy(gripper_px(seen) - frame.corner_px)
    pictures.happened[row, t] = True
    pictures.step[row, t] = seen.step
