"""What every agent that looks at virtual views shares: config, encoder of views, action decoder.

views -> ViewEncoder -> tokens, skips -> (the agent's transformer) -> ActionDecoder -> logits
"""

from dataclasses import dataclass, field
from typing import ClassVar, Literal

import torch
from einops import rearrange
from jaxtyping import Bool, Float
from torch import Tensor, nn

from baselines.agent import Recipe
from baselines.batch import Inputs
from baselines.configs import Fraction, Odd, check_numbers
from baselines.layers.attention import BlockSizes, SelfBlock, linear
from baselines.layers.heads import ActionHead, ActionLogits
from baselines.layers.stems import (
    Maps,
    PatchDecoder,
    PatchStem,
    PyramidDecoder,
    PyramidStem,
    with_locations,
)
from baselines.scene.sight import Views
from baselines.scene.views import VIEWS, View
from sacil_tasks.errors import UsageError


@dataclass(frozen=True, kw_only=True)
class MultiViewConfig:
    """Sizes of a view-based network; the defaults are the `cpu` preset (D-cpu)."""

    views: ClassVar[tuple[View, ...]] = VIEWS
    """Which views it looks at."""

    pixels: int = 96
    """Pixels per side of a virtual view."""

    patch: int = 16
    """Pixels per side of the square that becomes one token."""

    stem: Literal["pyramid", "patch"] = "pyramid"
    """`pyramid`: strided convolutions (D-stem); `patch`: RVT's one convolution per patch."""

    pyramid: tuple[int, ...] = (16, 32, 64)
    """Channels at 1/2, 1/4, ... of the resolution, down to twice the token grid's."""

    stem_channels: int = 64
    """Channels of the stem's token map (and of the full-resolution skip of `patch`)."""

    upsample_kernel: Odd = 5
    """Kernel of the two large convolutions of the `patch` stem's decoder."""

    lowered_channels: int = 64
    """Channels of the tokens on their way back to pixels."""

    head_hidden: tuple[int, int] = (192, 96)
    """Hidden units of the head for rotation, gripper and collision."""

    width: int = 96
    """Width of the transformer."""

    heads: int = 2
    """Attention heads."""

    head_width: int = 48
    """Width of one head."""

    hidden: int = 192
    """Hidden units of the gated feed-forward layers."""

    dropout: Fraction = 0.0
    """Dropout on attention probabilities."""

    recipe: Recipe = field(default_factory=lambda: Recipe(precision="bf16"))
    """How to train."""

    def __post_init__(self) -> None:
        """Check that the sizes fit each other.

        Raises:
            UsageError: a number makes no network, views are not a whole number of patches, or the
                pyramid ends elsewhere.
        """
        check_numbers(self)
        if self.pixels % self.patch:
            raise UsageError(
                f"views of {self.pixels} pixels cannot be cut into patches of {self.patch}. "
                "Choose --pixels as a multiple of --patch."
            )
        folded = 2 ** (len(self.pyramid) + 1)
        if self.stem == "pyramid" and self.patch != folded:
            raise UsageError(
                f"a pyramid of {len(self.pyramid)} levels makes patches of {folded} pixels, not "
                f"{self.patch}. Change --patch or --pyramid."
            )

    @property
    def grid(self) -> int:
        """Tokens per side of a view."""
        return self.pixels // self.patch

    def stem_module(self) -> nn.Module:
        """A fresh stem: images to token map and skips."""
        if self.stem == "patch":
            return PatchStem(self.stem_channels, self.patch)
        return PyramidStem(self.pyramid, self.stem_channels)

    @property
    def block_sizes(self) -> BlockSizes:
        """Sizes of every transformer block."""
        return BlockSizes(
            width=self.width,
            heads=self.heads,
            head_width=self.head_width,
            hidden=self.hidden,
            dropout=self.dropout,
        )


class ViewEncoder(nn.Module):
    """Views to tokens, each token with a learned positional embedding."""

    def __init__(self, config: MultiViewConfig) -> None:
        """Sizes as in `config`."""
        super().__init__()
        self.stem = config.stem_module()

    def forward(self, views: Float[Tensor, "b v 7 h w"]) -> tuple[Float[Tensor, "b t c"], Maps]:
        """Tokens, view by view and row by row, and the skips for the decoder."""
        tokens, skips = self.stem(with_locations(views).flatten(0, 1))
        return rearrange(tokens, "(b v) c y x -> b (v y x) c", v=views.shape[1]), skips


class ActionDecoder(nn.Module):
    """RVT's: tokens after the transformer, and the stem's skips, to the action's logits."""

    def __init__(self, config: MultiViewConfig) -> None:
        """Sizes as in `config`."""
        super().__init__()
        self.grid = config.grid
        lowered = config.lowered_channels
        self.lower = linear(config.width, lowered)
        self.decoder: PatchDecoder | PyramidDecoder
        if config.stem == "patch":
            self.decoder = PatchDecoder(
                lowered, config.stem_channels, patch=config.patch, kernel=config.upsample_kernel
            )
        else:
            self.decoder = PyramidDecoder(lowered, config.pyramid)
        self.head = ActionHead(lowered, self.decoder.map_channels, config.head_hidden)

    def forward(self, tokens: Float[Tensor, "b t d"], skips: Maps) -> ActionLogits:
        """Heatmaps from tokens and skips; the rest from what they show where they peak."""
        shape = {"v": len(VIEWS), "y": self.grid, "x": self.grid}
        grid = rearrange(self.lower(tokens), "b (v y x) c -> (b v) c y x", **shape)
        heat, maps = self.decoder(grid, skips)
        return self.head(grid, heat, maps)


def positions(config: MultiViewConfig, channels: int) -> nn.Parameter:
    """A learned embedding of every token's place.

    Wide at first, N(0, 1), as in RVT beside its patch stem; small beside the pyramid, where it
    would drown what the convolutions found (D-position).
    """
    spread = 1.0 if config.stem == "patch" else 0.02
    return nn.Parameter(spread * torch.randn(1, len(config.views) * config.grid**2, channels))


def blocks(count: int, config: MultiViewConfig) -> nn.ModuleList:
    """Self-attention blocks of the config's sizes."""
    return nn.ModuleList(SelfBlock(config.block_sizes) for _ in range(count))


def within_views(
    layers: nn.ModuleList, tokens: Float[Tensor, "b t d"], views: int = len(VIEWS)
) -> Float[Tensor, "b t d"]:
    """Apply blocks to each view's tokens alone."""
    each = rearrange(tokens, "b (v p) d -> (b v) p d", v=views)
    for block in layers:
        each = block(each)
    return rearrange(each, "(b v) p d -> b (v p) d", v=views)


def last_token(inputs: Inputs) -> Float[Tensor, "b e"]:
    """The end-of-text token, which stands for the sentence."""
    last = inputs.text_mask.sum(-1) - 1
    return inputs.text[torch.arange(len(last), device=last.device), last]


def trimmed_text(inputs: Inputs) -> tuple[Float[Tensor, "b t e"], Bool[Tensor, "b t"]]:
    """Text tokens and mask without the columns that are padding in the whole batch."""
    longest = int(inputs.text_mask.sum(-1).max())
    return inputs.text[:, :longest], inputs.text_mask[:, :longest]


def roughened(scene: Views, amplitude: float) -> Views:
    """RVT's image noise: one amplitude a batch, up to `amplitude`, then uniform on every value.

    Draws from torch's global generator, like dropout.
    """
    if amplitude == 0:
        return scene
    reach = amplitude * torch.rand(())
    noise = reach * (2 * torch.rand_like(scene.views) - 1)
    return Views((scene.views + noise).clamp(-1, 1))
