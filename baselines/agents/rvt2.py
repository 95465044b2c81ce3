"""RVT-2 (Goyal et al., RSS 2024), re-implemented from its published sizes.

    cloud -> three orthographic views -> coarse stage -> one heatmap per view -> 3D point
          -> the cloud about that point, four times as large -> three views -> fine stage
          -> one heatmap per view -> 3D point; rotation, gripper, collision from what lies there

A stage is RVT's transformer with its own weights; its heatmaps are convex mixes of a logit per
token. In training the fine stage looks at a point near the label, so it needs no good coarse
stage to learn, and nothing it learns reaches the coarse one.

The preset `paper` is the published network (section III of that paper; 72,288,678 parameters with
512-wide text and four proprioceptive numbers); `cpu` keeps its steps at a size one core can train.
"""

import math
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import torch
from einops import rearrange
from jaxtyping import Float, Int64
from torch import Tensor, nn
from torch.nn import functional

from baselines.agent import AgentSpec, Network
from baselines.agents.rvt import PAPER_RECIPE, Read, RvtConfig, Transformer
from baselines.batch import Batch, Inputs, Labels, Prediction
from baselines.configs import Odd, Range
from baselines.heatmap import decode, target_heatmaps
from baselines.layers.attention import init_leaky, linear, mlp
from baselines.layers.heads import ActionLogits, choose_at, loss_of_maps
from baselines.layers.multiview import roughened
from baselines.layers.stems import IMAGE_CHANNELS, Maps, PyramidStem, leaky
from baselines.policy import KeyframePolicy, load_policy
from baselines.rotation import BINS
from baselines.scene.sight import Views, ZoomScene, ZoomSight
from baselines.scene.views import THREE_VIEWS, View, project
from baselines.text import TextSpec

NEIGHBOURS = 9
"""Token logits that a pixel's logit is mixed from: its own cell's and those around it."""

SHARE_SCALE = 0.1
"""Keeps the mixing shares nearly equal at first, as published."""

JITTER = (-2, 2)
"""Range of the bins by which the angles shown to the next ones are off in training; the upper end
is not reached, as published."""

DRAWS = 5
"""Random numbers per sample: where the zoom strays (3), how far the angles shown are off (2)."""


@dataclass(frozen=True, kw_only=True)
class Rvt2Config(RvtConfig):
    """Sizes of RVT-2, those of a stage unless said otherwise; the defaults are the `cpu` preset."""

    views: ClassVar[tuple[View, ...]] = THREE_VIEWS

    zoom: Annotated[float, Range(1)] = 4.0
    """How much larger the fine stage sees the scene."""

    stray: float = 0.1
    """How far from the label the zoom may be centred in training, along each axis of the cube."""

    upsample_kernel: Odd = 3
    """Kernel of the decoder's convolutions over tokens."""

    convex_channels: int = 32
    """Channels of the decoder's convolutions."""

    head_norm: Literal["layer", "batch"] = "layer"
    """Normalises what the angles are read from; RVT-2: `batch` (D-zoom-norm)."""

    view_layers: int = 1
    joint_layers: int = 2

    def stem_module(self) -> nn.Module:
        """A fresh stem: images to token map and skips."""
        if self.stem == "patch":
            return BareStem(self.stem_channels, self.patch)
        return PyramidStem(self.pyramid, self.stem_channels)


CPU = Rvt2Config()

# D-zoom-recipe: the iterations and the batch of SACIL's paper.
PAPER = Rvt2Config(
    pixels=224,
    patch=14,
    stem="patch",
    stem_channels=64,
    lowered_channels=128,
    convex_channels=256,
    head_hidden=(256, 128),
    head_norm="batch",
    width=512,
    heads=8,
    head_width=64,
    hidden=2048,
    dropout=0.1,
    view_layers=4,
    joint_layers=4,
    recipe=replace(PAPER_RECIPE, weight_decay=1e-4, image_noise=0.0),
)


class BareStem(nn.Module):
    """RVT-2's: one convolution per patch and no skip."""

    def __init__(self, channels: int, patch: int) -> None:
        """`patch` is the side of a patch in pixels."""
        super().__init__()
        self.patches = nn.Conv2d(IMAGE_CHANNELS, channels, patch, patch)
        init_leaky(self.patches)
        self.norm = nn.GroupNorm(4, channels)

    def forward(self, images: Float[Tensor, "n 10 h w"]) -> tuple[Float[Tensor, "n c g g"], Maps]:
        """Token map."""
        return leaky(self.norm(self.patches(images))), []


def convex_mix(
    cells: Float[Tensor, "n 1 g g"], shares: Float[Tensor, "n s g g"]
) -> Float[Tensor, "n 1 h w"]:
    """Each pixel's mix of the 3 x 3 cells about its own; beyond the edge they are 0.

    `shares` are logits, for each of the nine those of all pixels of a cell, row by row; a softmax
    over the nine makes them convex.
    """
    n, _, g, _ = cells.shape
    around = rearrange(functional.unfold(cells, 3, padding=1), "n k c -> (n c) 1 k")
    weights = rearrange(shares, "n (k p) y x -> (n y x) k p", k=NEIGHBOURS).softmax(1)
    mixed = around.to(weights.dtype) @ weights
    side = math.isqrt(mixed.shape[-1])
    return rearrange(mixed, "(n y x) 1 (i j) -> n 1 (y i) (x j)", n=n, y=g, i=side)


class ConvexDecoder(nn.Module):
    """Token maps to heatmaps: a logit per token, up-sampled by shares that each token gives out.

    No map of full resolution is ever convolved.
    """

    def __init__(self, config: Rvt2Config) -> None:
        """Sizes as in `config`."""
        super().__init__()
        fan_in, channels = config.lowered_channels, config.convex_channels
        kernel = config.upsample_kernel
        conv = partial(nn.Conv2d, kernel_size=kernel, padding=kernel // 2)
        cells = (conv(fan_in, channels), nn.ReLU(), conv(channels, channels), nn.ReLU())
        self.cells = nn.Sequential(*cells, conv(channels, 1))
        pixels = NEIGHBOURS * config.patch**2
        self.shares = nn.Sequential(
            conv(fan_in, channels), nn.ReLU(), nn.Conv2d(channels, pixels, 1)
        )

    def forward(self, tokens: Float[Tensor, "n c g g"]) -> Float[Tensor, "n 1 h w"]:
        """Heatmap logits."""
        return convex_mix(self.cells(tokens), SHARE_SCALE * self.shares(tokens))


@dataclass(frozen=True)
class Look:
    """What a stage makes of its views; `n` counts the views of all samples, sample by sample."""

    read: Read
    """The transformer's tokens, for who wants to contrast them."""

    heatmaps: Float[Tensor, "b v h w"]
    tokens: Float[Tensor, "n c g g"]

    def features_at(self, positions: Float[Tensor, "b 3"]) -> Float[Tensor, "b f"]:
        """Strongest token features of each view, and those where `positions` are."""
        places = project(positions, 2, THREE_VIEWS).flatten(0, 1) - 1
        reads = [self.tokens.amax(dim=(-2, -1)), sample(self.tokens, places)]
        views = self.heatmaps.shape[1]
        return torch.cat([rearrange(r, "(b v) c -> b (v c)", v=views) for r in reads], dim=-1)


def sample(
    features: Float[Tensor, "n c g g"], places: Float[Tensor, "n 2"]
) -> Float[Tensor, "n c"]:
    """A map's features at (u, v), each from -1 to 1 edge to edge: bilinear, constant beyond the
    centres of the outermost cells (D-zoom-sample)."""
    read = functional.grid_sample(
        features.float(), places[:, None, None].float(), padding_mode="border", align_corners=False
    )
    return read[..., 0, 0]


class Stage(Transformer):
    """One of the two networks: views to heatmaps and feature maps."""

    def __init__(self, config: Rvt2Config, text: TextSpec) -> None:
        """Fresh weights; `text` says how wide a token vector is."""
        super().__init__(config, text)
        self.grid = config.grid
        self.lower = linear(config.width, config.lowered_channels)
        self.decoder = ConvexDecoder(config)

    def forward(self, scene: Views, inputs: Inputs) -> Look:
        """Look at a scene with the words and the proprioception of `inputs`."""
        read = self.read(scene.views, inputs)
        shape = {"v": self.views, "y": self.grid, "x": self.grid}
        tokens = rearrange(self.lower(read.joined), "b (v y x) c -> (b v) c y x", **shape)
        heat = rearrange(self.decoder(tokens), "(b v) 1 h w -> b v h w", v=self.views)
        return Look(read=read, heatmaps=heat.float(), tokens=tokens)


class WaypointHead(nn.Module):
    """Gripper, collision, and the angles one after the other: each knows those before it."""

    codes: Tensor

    def __init__(self, config: Rvt2Config) -> None:
        """Sizes as in `config`."""
        super().__init__()
        width = len(config.views) * 2 * config.lowered_channels
        self.flags = mlp((width, *config.head_hidden, 4))
        self.norm = nn.BatchNorm1d(width) if config.head_norm == "batch" else nn.LayerNorm(width)
        self.angles = nn.ModuleList(mlp((width, *config.head_hidden, BINS)) for _ in range(3))
        self.register_buffer("codes", bin_codes(width), persistent=False)

    def forward(
        self, features: Float[Tensor, "b f"], shown: Int64[Tensor, "b 2"] | None
    ) -> tuple[Float[Tensor, "b 3 bins"], Float[Tensor, "b 4"]]:
        """Logits of the three angles, and of gripper and collision.

        `shown` are the first two angles' bins to go by; None takes the likeliest.
        """
        known, rotation = self.norm(features), []
        for index, angle in enumerate(self.angles):
            rotation.append(angle(known).float())
            if index < 2:
                bins = rotation[-1].argmax(-1) if shown is None else shown[:, index]
                known = known + self.codes[bins]
        return torch.stack(rotation, dim=1), self.flags(features).float()


def bin_codes(width: int) -> Float[Tensor, "bins {width}"]:
    """Fixed sinusoids that tell rotation bins apart: sines, then cosines."""
    half = width // 2
    angles = torch.arange(BINS)[:, None] * 10_000 ** (-torch.arange(half) / half)
    return torch.cat([angles.sin(), angles.cos()], dim=-1)


class Rvt2(Network):
    """Two stages, the second one zoomed in on what the first one found."""

    def __init__(self, config: Rvt2Config, text: TextSpec) -> None:
        """Fresh weights; `text` says how wide a token vector is."""
        super().__init__()
        self.config = config
        self.sight = ZoomSight(config.pixels, draws=DRAWS)
        self.coarse = Stage(config, text)
        self.fine = Stage(config, text)
        self.head = WaypointHead(config)

    def loss(self, batch: Batch[ZoomScene]) -> tuple[Tensor, dict[str, Tensor]]:
        """Behaviour cloning only."""
        coarse = self.coarse_look(batch)
        return self.cloning_loss(coarse, batch)

    def coarse_look(self, batch: Batch[ZoomScene]) -> Look:
        """The coarse stage as it trains."""
        scene = roughened(batch.inputs.scene, self.config.recipe.image_noise)
        return self.coarse(scene, batch.inputs)

    def cloning_loss(
        self, coarse: Look, batch: Batch[ZoomScene]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The fine stage as it trains, and the loss of both: their heatmaps count alike."""
        config, labels, scene = self.config, batch.labels, batch.inputs.scene
        position = labels.position_in_cube
        center = position + config.stray * (2 * scene.draws[:, :3] - 1)
        zoomed = config.zoom * (position - center)
        near = roughened(scene.closer(center, config.zoom), config.recipe.image_noise)
        fine = self.fine(near, batch.inputs)
        logits = self._logits(fine, zoomed, shown_angles(labels, scene.draws[:, 3:]))
        logits = replace(logits, heatmaps=torch.cat([coarse.heatmaps, fine.heatmaps], dim=1))
        target = torch.cat([self._target(position), self._target(zoomed)], dim=1)
        return loss_of_maps(logits, target, labels, config.recipe)

    def _target(self, position: Float[Tensor, "b 3"]) -> Float[Tensor, "b v h w"]:
        sigma_px = self.config.recipe.heatmap_sigma_px
        return target_heatmaps(position, self.config.pixels, sigma_px, THREE_VIEWS)

    def _logits(
        self, fine: Look, position: Float[Tensor, "b 3"], shown: Int64[Tensor, "b 2"] | None
    ) -> ActionLogits:
        """The action at `position` of the zoomed cube."""
        rotation, flags = self.head(fine.features_at(position), shown)
        return ActionLogits(
            heatmaps=fine.heatmaps, rotation=rotation, gripper=flags[:, :2], collision=flags[:, 2:]
        )

    def act(self, inputs: Inputs[ZoomScene]) -> Prediction:
        """Highest point of the heatmaps, there once more from close by, and what to do there."""
        coarse = self.coarse(inputs.scene, inputs)
        center = decode(coarse.heatmaps, THREE_VIEWS)
        fine = self.fine(inputs.scene.closer(center, self.config.zoom), inputs)
        zoomed = decode(fine.heatmaps, THREE_VIEWS)
        position = (center + zoomed / self.config.zoom).clamp(-1, 1)
        return choose_at(position, self._logits(fine, zoomed, None))


def shown_angles(labels: Labels, draws: Float[Tensor, "b 2"]) -> Int64[Tensor, "b 2"]:
    """The expert's first two angles, a little off: so will be those that the network finds."""
    low, high = JITTER
    jitter = (low + (high - low) * draws).floor().long()
    return (labels.rotation_bins[:, :2] + jitter) % BINS


AGENT = AgentSpec(name="rvt2", presets={"cpu": CPU, "paper": PAPER}, create=Rvt2)


def load(*, checkpoint: Path | None, tasks: tuple[str, ...], variant: str | None) -> KeyframePolicy:
    """The policy of a trained network; without `checkpoint`, of the released one.

    Raises:
        UsageError: the checkpoint does not fit, or nothing released covers the tasks.
    """
    return load_policy(AGENT.name, checkpoint=checkpoint, tasks=tasks, variant=variant)
