"""From camera images to feature maps of one width.

    images (n, 3, h, w) -> trunk -> maps, fine to coarse -> Pyramid -> a coarse and a fine map

`SmallTrunk` is made for one core; `baselines.layers.resnet` holds the published one.
"""

from collections.abc import Sequence
from itertools import pairwise

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn
from torch.nn import functional

from baselines.layers.stems import Maps

MEAN, SPREAD = (0.4815, 0.4578, 0.4082), (0.2686, 0.2613, 0.2758)
"""Of red, green and blue in [0, 1], as CLIP's trunk expects them."""

NORM_GROUPS = 8


def normalised(rgb: UInt8[Tensor, "n 3 h w"]) -> Float[Tensor, "n 3 h w"]:
    """Colours as a trunk wants them."""
    mean, spread = (torch.tensor(v, device=rgb.device)[:, None, None] for v in (MEAN, SPREAD))
    # Channels last: 2 to 4 times faster on a CPU, forwards and backwards.
    return ((rgb / 255 - mean) / spread).contiguous(memory_format=torch.channels_last)


class SmallTrunk(nn.Module):
    """Patches of 4 x 4 pixels, then stages of two convolutions, each at half the resolution."""

    first_stride = 4
    """Pixels of a side of the finest map's cells; each further map doubles them."""

    def __init__(self, channels: tuple[int, ...]) -> None:
        """`channels` of the maps, multiples of 8."""
        super().__init__()
        self.channels = channels
        steps = [nn.Conv2d(a, b, 3, 2, 1) for a, b in pairwise(channels)]
        self.steps = nn.ModuleList([nn.Conv2d(3, channels[0], 4, 4), *steps])
        self.mixers = nn.ModuleList(nn.Conv2d(c, c, 3, 1, 1) for c in channels)
        self.norms = nn.ModuleList(nn.GroupNorm(NORM_GROUPS, c) for c in channels)

    def forward(self, images: Float[Tensor, "n 3 h w"]) -> Maps:
        """One map a stage, fine to coarse."""
        maps, x = [], images
        for step, mixer, norm in zip(self.steps, self.mixers, self.norms, strict=True):
            x = functional.relu(norm(mixer(functional.relu(step(x)))))
            maps.append(x)
        return maps


class Pyramid(nn.Module):
    """Feature pyramid (Lin et al.): maps at some levels that know what the coarser ones saw.

    Only the levels that are read have an output convolution (D-act3d-outputs).
    """

    def __init__(
        self, channels: Sequence[int], width: int, levels: Sequence[int], kernel: int
    ) -> None:
        """`levels` index `channels`; `kernel` is that of the output convolutions."""
        super().__init__()
        self.levels = tuple(levels)
        self.laterals = nn.ModuleList(nn.Conv2d(c, width, 1) for c in channels)
        outputs = [nn.Conv2d(width, width, kernel, padding=kernel // 2) for _ in levels]
        self.outputs = nn.ModuleList(outputs)

    def forward(self, maps: Maps) -> Maps:
        """Maps of `levels`, in that order."""
        merged = [self.laterals[-1](maps[-1])]
        for lateral, features in zip(self.laterals[-2::-1], maps[-2::-1], strict=True):
            risen = functional.interpolate(merged[0], size=features.shape[-2:])
            merged.insert(0, lateral(features) + risen)
        return [out(merged[i]) for out, i in zip(self.outputs, self.levels, strict=True)]
