"""Camera images and point maps as HiveFormer reads them.

n counts observations; k, h and w are cameras, rows and columns.
"""

import torch
from einops import rearrange
from jaxtyping import Bool, Float, Shaped, UInt8
from torch import Tensor

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
    rgb: UInt8[Tensor, "n k 3 h w"], gripper_px: Float[Tensor, "n k 2"]
) -> Float[Tensor, "m 4 h w"]:
    """Colours and the gripper's map in [-1, 1], camera after camera, channels last in memory."""
    n, k, _, side, _ = rgb.shape
    images = torch.empty((n, k, side, side, 4), device=rgb.device)
    images[..., :3] = rgb.movedim(2, -1)
    images[..., 3] = 255 * gripper_map(gripper_px, side)
    images = images.div_(127.5).sub_(1)
    return rearrange(images, "n k h w c -> (n k) c h w")


def pooled_points(
    xyz_in_cube: Float[Tensor, "n k 3 h w"], seen: Bool[Tensor, "n k h w"], grid: int
) -> Float[Tensor, "n k 3 y x"]:
    """Mean of the points that each cell of a grid shows; 0 where it shows none."""
    total = _cell_sums(xyz_in_cube, grid)  # unseen pixels are 0
    return total / _cell_sums(seen, grid)[:, :, None].clamp(min=1)


def _cell_sums(x: Shaped[Tensor, "*b h w"], grid: int) -> Shaped[Tensor, "*b y x"]:
    """Sums over square cells; rows first, which is five times as fast as `avg_pool2d`."""
    strips = x.unflatten(-2, (grid, -1)).sum(-2)
    return strips.unflatten(-1, (grid, -1)).sum(-1)


def log_heat_over(
    logits: Float[Tensor, "n k h w"], seen: Bool[Tensor, "n k h w"], temperature: float
) -> Float[Tensor, "n k h w"]:
    """Logarithm of a softmax over the pixels of all cameras that show a point
    (D-hiveformer-masks); uniform if none does."""
    masked = (logits / temperature).masked_fill(~seen, -1e9)
    return masked.flatten(1).log_softmax(-1).view_as(logits)


def mean_point(
    heat: Float[Tensor, "n k h w"], xyz_in_cube: Float[Tensor, "n k 3 h w"]
) -> Float[Tensor, "n 3"]:
    """Mean of the points under a heatmap."""
    return (heat[:, :, None] * xyz_in_cube).sum((1, 3, 4))
