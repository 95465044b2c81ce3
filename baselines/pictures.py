"""Camera images and point maps as HiveFormer reads them.

n counts observations; k, h and w are cameras, rows and columns.
"""

import torch
from einops import rearrange
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn import functional

SPOT_PX = 1.5
"""Width (standard deviation) of the spot that marks the gripper. A single pixel, as published,
would vanish or double when images are resampled (D-hiveformer-spot)."""


def gripper_map(gripper_px: Float[Tensor, "n k 2"], side: int) -> Float[Tensor, "n k h w"]:
    """A spot of height 1 where the gripper is in each image; 0 everywhere if it is outside."""
    centres = torch.arange(side, device=gripper_px.device) + 0.5
    across = (-0.5 * ((centres - gripper_px[..., None]) / SPOT_PX) ** 2).exp()
    column, row = across.unbind(-2)
    return row[..., :, None] * column[..., None, :]


def network_images(
    rgb: UInt8[Tensor, "n k h w 3"], gripper_px: Float[Tensor, "n k 2"]
) -> Float[Tensor, "m 4 h w"]:
    """Colours and the gripper's map in [-1, 1], camera after camera, channels last in memory."""
    n, k, side, _, _ = rgb.shape
    images = torch.empty((n, k, side, side, 4), device=rgb.device)
    images[..., :3] = rgb
    images[..., 3] = 255 * gripper_map(gripper_px, side)
    images = images.div_(127.5).sub_(1)
    return rearrange(images, "n k h w c -> (n k) c h w")


def pooled_points(
    xyz_in_cube: Float[Tensor, "n k 3 h w"], seen: Bool[Tensor, "n k h w"], grid: int
) -> Float[Tensor, "n k 3 y x"]:
    """Mean of the points that each cell of a grid shows; 0 where it shows none."""
    cell = xyz_in_cube.shape[-1] // grid
    total = functional.avg_pool2d(xyz_in_cube.flatten(0, 1), cell)  # unseen pixels are 0
    share = functional.avg_pool2d(seen.flatten(0, 1)[:, None].float(), cell)
    return (total / share.clamp(min=1 / cell**2)).unflatten(0, xyz_in_cube.shape[:2])


def heat_over(
    logits: Float[Tensor, "n k h w"], seen: Bool[Tensor, "n k h w"], temperature: float
) -> Float[Tensor, "n k h w"]:
    """Softmax over the pixels of all cameras that show a point; uniform if none does."""
    masked = (logits / temperature).masked_fill(~seen, -1e9)
    return masked.flatten(1).softmax(-1).view_as(logits)


def mean_point(
    heat: Float[Tensor, "n k h w"], xyz_in_cube: Float[Tensor, "n k 3 h w"]
) -> Float[Tensor, "n 3"]:
    """Mean of the points under a heatmap."""
    return (heat[:, :, None] * xyz_in_cube).sum((1, 3, 4))
