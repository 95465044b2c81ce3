"""From virtual views to a grid of tokens, and back from tokens to one heatmap per view.

    images (n, 10, h, w) -> stem -> token map (n, c, g, g), skips, fine to coarse
    token map, skips -> decoder -> heatmap logits (n, 1, h, w), feature maps, fine to coarse

Two pairs with this interface, n being batch x views: RVT's own, one patch convolution with a
full-resolution skip, and a strided pyramid of convolutions that a CPU can train.
"""

from functools import cache
from typing import Literal, TypeAlias

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from baselines.layers.attention import LEAK, init_leaky, init_plain
from baselines.scene.views import CHANNELS

IMAGE_CHANNELS = len(CHANNELS) + 3
"""What is rendered, and three constant channels that say where a pixel lies."""

Maps: TypeAlias = list[Float[Tensor, "n _ _ _"]]
"""Feature maps of decreasing resolution."""

Padding: TypeAlias = Literal["zeros", "replicate"]


def with_locations(views: Float[Tensor, "b v 7 h w"]) -> Float[Tensor, "b v 10 h w"]:
    """Append view, row and column of each pixel, each from -1 to 1: RVT's constant channels
    (D-channels)."""
    b, v, _, h, w = views.shape
    axes = [torch.linspace(-1, 1, steps, device=views.device) for steps in (v, h, w)]
    places = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=1).to(views.dtype)
    return torch.cat([views, places.expand(b, v, 3, h, w)], dim=2)


def leaky(x: Tensor) -> Tensor:
    """LeakyReLU with RVT's slope."""
    return functional.leaky_relu(x, LEAK)


def convolution(
    fan_in: int, fan_out: int, kernel: int, *, stride: int = 1, padding_mode: Padding = "zeros"
) -> nn.Conv2d:
    """A convolution to be followed by `leaky`; an odd kernel at stride 1 keeps the map's size."""
    padding = kernel // 2 if kernel % 2 else 0
    layer = nn.Conv2d(fan_in, fan_out, kernel, stride, padding, padding_mode=padding_mode)
    init_leaky(layer)
    return layer


def side_by_side(layer: nn.Conv2d, *maps: Float[Tensor, "n _ h w"]) -> Float[Tensor, "n c h w"]:
    """`layer`, which keeps a map's size and replicates its edge, over maps side by side.

    Each map meets its own part of the weights: joined first they would take half as long again,
    most of it on the way back through slices of the gradient.
    """
    parts = layer.weight.split([x.shape[1] for x in maps], dim=1)
    edge = layer.kernel_size[0] // 2
    if edge:  # padding by nothing would still copy
        maps = tuple(functional.pad(x, (edge,) * 4, mode="replicate") for x in maps)
    out = functional.conv2d(maps[0], parts[0], layer.bias)
    for x, part in zip(maps[1:], parts[1:], strict=True):
        out = out + functional.conv2d(x, part)
    return out


@cache
def bilinear_taps(kernel: int, scale: int) -> Float[Tensor, "{scale} {kernel} cells"]:
    """For each pixel of a cell and each tap of a kernel about it, the shares of the cells around in
    what bilinear up-sampling by `scale` puts under the tap, along one axis."""
    pixel, tap = torch.meshgrid(torch.arange(scale), torch.arange(kernel), indexing="ij")
    place = (pixel + tap - kernel // 2 + 0.5) / scale - 0.5  # in cells from the pixel's own
    reach = int(place.abs().max().ceil())
    cells = torch.arange(-reach, reach + 1)
    return (1 - (place[..., None] - cells).abs()).clamp(min=0)


def conv_of_upsampled(
    x: Float[Tensor, "n c y x"], layer: nn.Conv2d, scale: int
) -> Float[Tensor, "n e h w"]:
    """`layer`, an odd kernel with replicated edges, over `x` up-sampled bilinearly by `scale`.

    The larger map is never made. All pixels at the same place in their cells see the same mix of
    the cells around, so this is a convolution of `x` with as many outputs as a cell has pixels,
    3 x 3 where the kernel is no larger than a cell: RVT's 11 x 11 takes 9 products instead of 121.
    Replicating the edge before or after bilinear up-sampling is the same.
    """
    taps = bilinear_taps(layer.kernel_size[0], scale).to(x.device)
    with torch.autocast(x.device.type, enabled=False):
        across = torch.einsum("e c u v, q v j -> e c u q j", layer.weight, taps)
        weight = torch.einsum("e c u q j, p u i -> p q e c i j", across, taps).flatten(0, 2)
    bias = None if layer.bias is None else layer.bias.repeat(scale**2)
    edge = taps.shape[-1] // 2
    padded = functional.pad(x, (edge,) * 4, mode="replicate")
    padded = padded.contiguous(memory_format=torch.channels_last)
    cells = functional.conv2d(padded, weight, bias)
    # Channels stay last in memory.
    full = rearrange(cells, "n (p q e) y x -> n (y p) (x q) e", p=scale, q=scale)
    return full.permute(0, 3, 1, 2)


def separable(fan_in: int, fan_out: int) -> nn.Sequential:
    """A 3x3 convolution of each channel alone, then a 1x1: a third of the time of a full 3x3."""
    alone = nn.Conv2d(fan_in, fan_in, 3, padding=1, groups=fan_in)
    mixed = nn.Conv2d(fan_in, fan_out, 1)
    for layer in (alone, mixed):
        init_plain(layer)
    return nn.Sequential(alone, mixed)


class PatchStem(nn.Module):
    """RVT's: a 1x1 convolution, whose output is the skip, then one convolution per patch."""

    def __init__(self, channels: int, patch: int) -> None:
        """`patch` is the side of a patch in pixels."""
        super().__init__()
        self.pixelwise = convolution(IMAGE_CHANNELS, channels, 1)
        self.patches = nn.Conv2d(channels, channels, patch, patch)
        init_leaky(self.patches)
        self.norm = nn.GroupNorm(4, channels)

    def forward(self, images: Float[Tensor, "n 10 h w"]) -> tuple[Float[Tensor, "n c g g"], Maps]:
        """Token map, and the full-resolution map as the only skip."""
        # Channels last: 2 to 4 times faster on a CPU, forwards and backwards.
        skip = leaky(self.pixelwise(images.contiguous(memory_format=torch.channels_last)))
        return leaky(self.norm(self.patches(skip))), [skip]


class PatchDecoder(nn.Module):
    """RVT's: large convolution, bilinear up-sampling, large convolution, skip, 3x3."""

    def __init__(self, token_channels: int, channels: int, *, patch: int, kernel: int) -> None:
        """`kernel` is that of the two large convolutions."""
        super().__init__()
        self.patch = patch
        self.map_channels = (channels,)
        self.coarse = convolution(token_channels, channels, kernel, padding_mode="replicate")
        self.fine = convolution(channels, channels, kernel, padding_mode="replicate")
        self.merge = convolution(2 * channels, channels, 3, padding_mode="replicate")
        self.heat = nn.Conv2d(channels, 1, 3, padding=1, padding_mode="replicate")
        init_plain(self.heat)

    def forward(
        self, tokens: Float[Tensor, "n c g g"], skips: Maps
    ) -> tuple[Float[Tensor, "n 1 h w"], Maps]:
        """Heatmap logits and the map they are read from."""
        coarse = leaky(self.coarse(tokens))
        fine = leaky(conv_of_upsampled(coarse, self.fine, self.patch))
        merged = leaky(side_by_side(self.merge, fine, skips[0]))
        return self.heat(merged), [merged]


class PyramidStem(nn.Module):
    """Convolutions with stride 2 (D-stem).

    The first one folds 2 x 2 pixels into one cell, so its map, the finest skip, holds every pixel
    of the image at a quarter of the cost of a full-resolution map.
    """

    def __init__(self, pyramid: tuple[int, ...], channels: int) -> None:
        """`pyramid` lists the channels of the skips, `channels` are those of the tokens."""
        super().__init__()
        self.fold = convolution(IMAGE_CHANNELS, pyramid[0], 2, stride=2)
        steps = zip(pyramid, (*pyramid[1:], channels), strict=True)
        self.steps = nn.ModuleList(convolution(a, b, 3, stride=2) for a, b in steps)
        self.norm = nn.GroupNorm(4, channels)

    def forward(self, images: Float[Tensor, "n 10 h w"]) -> tuple[Float[Tensor, "n c g g"], Maps]:
        """Token map, and the map before each step as skips."""
        # Channels last: 2 to 4 times faster on a CPU, forwards and backwards.
        x = self.fold(images.contiguous(memory_format=torch.channels_last))
        skips = []
        for step in self.steps:
            skips.append(leaky(x))
            x = step(skips[-1])
        return leaky(self.norm(x)), skips


class PyramidDecoder(nn.Module):
    """The way back up the pyramid: at each level coarse map and skip are added (D-stem)."""

    def __init__(self, token_channels: int, pyramid: tuple[int, ...]) -> None:
        """`pyramid` lists the channels of the skips."""
        super().__init__()
        self.map_channels = (*pyramid, token_channels)
        steps = zip(pyramid, (*pyramid[1:], token_channels), strict=True)
        self.risers = nn.ModuleList(convolution(b, a, 1) for a, b in steps)
        self.laterals = nn.ModuleList(convolution(a, a, 1) for a in pyramid)
        self.mixers = nn.ModuleList(separable(a, a) for a in pyramid[1:])
        self.heat = separable(pyramid[0], 4)

    def forward(
        self, tokens: Float[Tensor, "n c g g"], skips: Maps
    ) -> tuple[Float[Tensor, "n 1 h w"], Maps]:
        """Heatmap logits, four to a cell of the finest level, and the map of each level."""
        maps = [tokens]
        for level in reversed(range(len(skips))):
            risen = functional.interpolate(self.risers[level](maps[0]), scale_factor=2)
            x = leaky(risen + self.laterals[level](skips[level]))
            maps.insert(0, x if level == 0 else leaky(self.mixers[level - 1](x)))
        return functional.pixel_shuffle(self.heat(maps[0]), 2), maps
