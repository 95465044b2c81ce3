"""PolarNet (Chen et al., CoRL 2023), re-implemented from its published sizes.

    cloud around the gripper -> PointNeXt encoder -> bottleneck points
          -> + step, gripper pose and place -> they read each other and the words
          -> PointNeXt decoder -> one logit and one offset a point -> mean of (point + offset)
          rotation, gripper, collision from the bottleneck's maximum over the points

The preset `paper` is the published network (section 3 of that paper; 14,150,537 parameters with
512-wide text, before our collision logit); `cpu` keeps its steps at a size one core can train.
"""

import math
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor, nn

from baselines.agent import AgentSpec, Network, Recipe, weighed
from baselines.batch import Batch, Inputs, Labels, Prediction
from baselines.configs import Fraction, Positive, Range, check_numbers
from baselines.layers.attention import LEAK, padding_bias
from baselines.layers.heat import divergence, falling_off
from baselines.layers.multiview import trimmed_text
from baselines.layers.pointnet import DecoderLayer, FeaturePropagation, Norm, SetAbstraction
from baselines.layers.regression import POSE, UNTURNED, Regressed, tool_axes
from baselines.policy import KeyframePolicy, load_policy
from baselines.scene.neighbours import Pyramid
from baselines.scene.points import HALF_SIDE_M, CloudSight, PointCloud
from baselines.text import TextSpec
from sacil_tasks.errors import UsageError

TEMPERATURE = 0.1
"""Of the softmax over points."""

POINT_CHANNELS = 10
"""Position, colour, normal, height."""


@dataclass(frozen=True, kw_only=True)
class PolarNetConfig:
    """Sizes of PolarNet; the defaults are the `cpu` preset (D-polarnet-cpu)."""

    voxel_m: Annotated[float, Range(1e-4)] = 0.005
    """Edge of the cells in which points are averaged (D-polarnet-voxel)."""

    points: int = 2048
    """Points that enter the network. With the arm at home the scenes of lifting and pushing have
    900 to 1,500 voxels, and all of them enter; with the arm in view up to 7,600, and a block of
    29 mm keeps 25 to 50 points, one of 50 mm 70 to 110."""

    stages: tuple[int, ...] = (512, 256, 128, 64)
    """Points that each stage of the encoder keeps."""

    radius: Positive = 0.05
    """Reach of the first stage's neighbourhoods, in units of the cloud's; 2.5 times as far with
    each stage."""

    neighbours: int = 16
    """Points in a neighbourhood."""

    stem_channels: int = 24
    """Channels of a point; twice as many after each stage."""

    norm: Norm = "layer"
    """Normalisation of points: `layer` or, as published, `batch`."""

    width: int = 192
    """Width of the transformer."""

    heads: int = 6
    """Attention heads."""

    hidden: int = 768
    """Hidden units of the transformer's feed-forward layers."""

    layers: int = 1
    """Layers of the transformer."""

    dropout: Fraction = 0.0
    """Dropout in the transformer."""

    heat_weight: float = 1.0
    """Weight of the heatmap's divergence from its label (D-polarnet-heat)."""

    vote_weight: float = 100.0
    """Weight of the squared error in square metres of what each point says by itself, where the
    heat should be (D-polarnet-votes)."""

    position_weight: float = 100.0
    """Weight of the squared position error in square metres; `recipe.rotation_weight` is that of
    the grip's (D-polarnet-weights)."""

    recipe: Recipe = field(
        default_factory=lambda: Recipe(lr=3e-3, precision="bf16", augment=UNTURNED)
    )
    """How to train."""

    def __post_init__(self) -> None:
        """Check that the sizes fit each other.

        Raises:
            UsageError: a number makes no network, a stage keeps more points than there are, or the
                heads do not share the width equally.
        """
        check_numbers(self)
        if self.width % self.heads:
            raise UsageError(
                f"a width of {self.width} cannot be shared by {self.heads} heads. "
                "Choose --width as a multiple of --heads."
            )
        _ = self.pyramid

    @property
    def pyramid(self) -> Pyramid:
        """How the cloud is thinned out."""
        return Pyramid(
            voxel_m=self.voxel_m,
            points=self.points,
            stages=self.stages,
            radius=self.radius,
            growth=2.5,
            neighbours=self.neighbours,
        )

    @property
    def channels(self) -> tuple[int, ...]:
        """Channels of the stem and of each stage."""
        return tuple(self.stem_channels << level for level in range(len(self.stages) + 1))


CPU = PolarNetConfig()

PAPER = PolarNetConfig(
    points=2048,
    stages=(1024, 512, 256, 128),
    neighbours=32,
    stem_channels=64,
    norm="batch",
    width=512,
    heads=8,
    hidden=2048,
    layers=2,
    dropout=0.1,
    heat_weight=0.0,
    vote_weight=0.0,
    position_weight=1.0,
    recipe=Recipe(  # D-polarnet-recipe
        samples=200_000 * 8 * 5,
        batch=40,
        choice_share=None,
        lr=5e-4,
        warmup_steps=2000,
        weight_decay=1e-3,
        ema_decay=0.0,
        rotation_weight=1.0,
    ),
)


@dataclass(frozen=True)
class Guess:
    """What the network says about the next keyframe."""

    heat: Float[Tensor, "b n"]
    """Logits over the points."""

    votes: Float[Tensor, "b n 3"]
    """Where each point, with its offset, says the gripper should go, in the cube."""

    action: Regressed


class PolarNet(Network):
    """Point network with a transformer at its bottleneck."""

    def __init__(self, config: PolarNetConfig, text: TextSpec) -> None:
        """Fresh weights (D-polarnet-scratch); `text` says how wide a token vector is."""
        super().__init__()
        self.config = config
        self.sight = CloudSight(config.pyramid)
        channels, width, norm = config.channels, config.width, config.norm
        self.stem = nn.Linear(POINT_CHANNELS, channels[0])
        self.encoder = nn.ModuleList(
            SetAbstraction(fan_in, 2 * fan_in, radius=radius, norm=norm)
            for fan_in, radius in zip(channels, config.pyramid.radii, strict=False)
        )
        self.bottleneck = Bottleneck(config, text.dim)
        coarse = (*channels[1:-1], channels[-1] + width)
        self.decoder = nn.ModuleList(
            FeaturePropagation(above, fine, norm=norm)
            for above, fine in zip(coarse, channels[:-1], strict=True)
        )
        self.heat = nn.Linear(channels[0], 4)
        self.pose = nn.Sequential(  # D-polarnet-heads
            nn.Linear(coarse[-1], width * 3 // 2),
            nn.LeakyReLU(LEAK),
            nn.Linear(width * 3 // 2, POSE),
        )

    def forward(self, inputs: Inputs[PointCloud]) -> Guess:
        """What to do next."""
        cloud = inputs.scene
        levels = [self.stem(torch.cat([cloud.xyz, cloud.features], dim=-1))]
        for block, near in zip(self.encoder, cloud.near.split(self.config.stages, 1), strict=True):
            levels.append(block(levels[-1], cloud.xyz, near))
        fused = torch.cat([levels[-1], self.bottleneck(levels[-1], inputs)], dim=-1)
        points = self._decoded(fused, levels[:-1], cloud)
        return self._guess(self.heat(points).float(), self.pose(fused.amax(1)).float(), inputs)

    def _decoded(self, fused: Tensor, levels: list[Tensor], cloud: PointCloud) -> Tensor:
        """Features of all points: from the bottleneck back up."""
        sizes = (self.config.points, *self.config.stages)
        dropped = [before - after for before, after in pairwise(sizes)][::-1]
        parents, shares = cloud.parents.split(dropped, 1), cloud.shares.split(dropped, 1)
        points = fused
        steps = zip(self.decoder[::-1], levels[::-1], parents, shares, strict=True)
        for block, level, *links in steps:
            points = block(points, level, *links)
        return points

    def _guess(self, points: Tensor, pose: Tensor, inputs: Inputs[PointCloud]) -> Guess:
        heat = points[..., 0] / TEMPERATURE
        hand, reach = inputs.gripper_in_cube[:, None, :3], inputs.scene.reach[:, None, None]
        votes = hand + reach * (inputs.scene.xyz + points[..., 1:])
        return Guess(heat, votes, Regressed(read_out(heat, votes), pose))

    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Behaviour cloning; terms without their weights."""
        guess, labels = self(batch.inputs), batch.labels
        error_m = (guess.action.position_in_cube - labels.position_in_cube) * HALF_SIDE_M
        gaps_m = (guess.votes - labels.position_in_cube[:, None]) * HALF_SIDE_M
        label = heat_labels(batch.inputs, labels)
        terms = {
            "bc/heat": divergence(guess.heat.log_softmax(-1), label),
            "bc/votes": (label * gaps_m.square().mean(-1)).sum(-1).mean(),
            "bc/position": error_m.square().mean(),
            **guess.action.terms(labels),
        }
        weights = {
            "bc/heat": self.config.heat_weight,
            "bc/votes": self.config.vote_weight,
            "bc/position": self.config.position_weight,
            "bc/rotation": self.config.recipe.rotation_weight,
        }
        return weighed(terms, weights)

    def act(self, inputs: Inputs[PointCloud]) -> Prediction:
        """The mean place, the rotation, and the likelier states."""
        return self(inputs).action.prediction


class Bottleneck(nn.Module):
    """The coarsest points, told where the gripper is and what was said."""

    def __init__(self, config: PolarNetConfig, text_dim: int) -> None:
        """Sizes as in `config`."""
        super().__init__()
        width = config.width
        self.lower = nn.Linear(config.channels[-1], width)
        self.place = nn.Linear(3, width)
        self.text = nn.Linear(text_dim, width)
        self.position, self.turn = nn.Linear(3, width), nn.Linear(6, width)
        self.open = nn.Embedding(2, width)
        self.norm = nn.LayerNorm(width)
        self.layers = nn.ModuleList(
            DecoderLayer(width, heads=config.heads, hidden=config.hidden, dropout=config.dropout)
            for _ in range(config.layers)
        )

    def forward(self, features: Float[Tensor, "b m c"], inputs: Inputs) -> Float[Tensor, "b m d"]:
        """Features after the transformer."""
        state = self._gripper(inputs) + step_code(inputs.step, self.lower.out_features)
        place = self.place(inputs.scene.xyz[:, : features.shape[1]])
        x = self.lower(features) + place + state[:, None]
        text, mask = trimmed_text(inputs)
        words, padding = self.text(text), padding_bias(mask)
        for layer in self.layers:
            x = layer(x, words, padding)
        return x

    def _gripper(self, inputs: Inputs) -> Float[Tensor, "b d"]:
        """The current pose (D-polarnet-pose), which PolarNet calls the previous action."""
        pose = inputs.gripper_in_cube
        codes = self.position(pose[:, :3]) + self.turn(tool_axes(pose[:, 3:]))
        return self.norm(codes + self.open(inputs.proprio[:, 0].long()))


def read_out(heat: Float[Tensor, "b n"], places: Float[Tensor, "b n 3"]) -> Float[Tensor, "b 3"]:
    """The mean of the places under the heat's probabilities."""
    return torch.einsum("b n, b n c -> b c", heat.softmax(-1), places)


def heat_labels(inputs: Inputs[PointCloud], labels: Labels) -> Float[Tensor, "b n"]:
    """Probabilities of the points, falling exponentially with their distance from the label."""
    scene = inputs.scene
    aim = labels.position_in_cube - inputs.gripper_in_cube[:, :3]
    gaps = (scene.xyz * scene.reach[:, None, None] - aim[:, None]).norm(dim=-1)
    return falling_off(gaps * HALF_SIDE_M)


def step_code(step: Tensor, width: int) -> Float[Tensor, "b d"]:
    """Sines, then cosines, of the step at wavelengths from 2 pi to 20,000 pi."""
    rates = torch.exp(torch.arange(0, width, 2, device=step.device) * (-math.log(1e4) / width))
    angles = step[:, None] * rates
    return torch.cat([angles.sin(), angles.cos()], dim=-1)


AGENT = AgentSpec(name="polarnet", presets={"cpu": CPU, "paper": PAPER}, create=PolarNet)


def load(*, checkpoint: Path | None, tasks: tuple[str, ...], variant: str | None) -> KeyframePolicy:
    """The policy of a trained network; without `checkpoint`, of the released one.

    Raises:
        UsageError: the checkpoint does not fit, or nothing released covers the tasks.
    """
    return load_policy(AGENT.name, checkpoint=checkpoint, tasks=tasks, variant=variant)
