"""HiveFormer (Guhur et al., CoRL 2022), re-implemented from its published sizes.

    camera images, each with a spot where the gripper is -> U-Net encoder -> 8x8 tokens a camera
          -> tokens of the present step read the words and all steps so far, then each other
          -> U-Net decoder -> one heatmap over the pixels of all cameras
          -> position = mean of the pixels' points + an offset; rotation, gripper from the grids

The preset `paper` has the published sizes (section 3 of that paper); `cpu` keeps its steps at a
size one core can train. The published network reads a whole episode at once; its single layer
takes keys and values from the tokens as they were embedded, so only the present step needs
queries and a decoder here, and earlier steps cost no more than their tokens (D-hiveformer-steps).
Images are cropped, but do not follow when the recipe moves points, gripper and label
(D-hiveformer-augment).
"""

from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from einops import rearrange
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional

from baselines.agent import AgentSpec, Network, Recipe, weighed
from baselines.batch import Batch, Inputs, Labels, Prediction
from baselines.configs import Fraction, Natural, Odd, check_numbers
from baselines.layers.attention import attend, padding_bias
from baselines.layers.heat import divergence, falling_off
from baselines.layers.multiview import trimmed_text
from baselines.layers.pictures import log_heat_over, mean_point, network_images, pooled_points
from baselines.layers.regression import POSE, UNTURNED, Regressed
from baselines.layers.stems import leaky
from baselines.layers.unet import UnetDecoder, UnetEncoder, replicated
from baselines.policy import KeyframePolicy, load_policy
from baselines.scene.sight import CameraSight, Pictures
from baselines.text import TextSpec
from sacil_tasks.errors import UsageError
from sacil_tasks.interface import CAMERAS, IMAGE_PIXELS, MAX_KEYFRAMES, SCENE_BOUNDS

TEMPERATURE = 0.1
"""Of the softmax over pixels."""

UNSEEN_M = 1e3
"""How far from any label a pixel counts that shows no point."""

MAX_WORDS = 77
"""Places in a sentence that have an embedding (the published code's 42 are too few for its own
text encoder)."""

OFFSET = 3
"""Numbers that are added to the position, beside those of the pose (D-hiveformer-offset)."""


@dataclass(frozen=True, kw_only=True)
class HiveFormerConfig:
    """Sizes of HiveFormer; the defaults are the `cpu` preset (D-hiveformer-cpu)."""

    window: int = 8
    """Steps that are remembered, the present one included; 1 forgets everything."""

    past_gradients: bool = False
    """Whether the encoder also learns from what it shows of earlier steps (D-hiveformer-past)."""

    stem: tuple[int, ...] = field(default=(), metadata={"may_be_empty": True})
    """Channels of the convolutions at full resolution."""

    channels: tuple[int, int, int, int] = (16, 16, 32, 64)
    """Channels at 1/2, 1/4, 1/8 and 1/16 of the resolution."""

    fine_kernel: Odd = 1
    """Kernel of the decoder's convolution at half the resolution."""

    width: int = 128
    """Width of the transformer."""

    heads: int = 2
    """Attention heads."""

    hidden: int = 256
    """Hidden units of the feed-forward part."""

    layers: int = 1
    """Transformer layers."""

    pose_channels: int = 64
    """Channels of the head for offset, rotation, gripper and collision."""

    dropout: Fraction = 0.0
    """Dropout on attention probabilities and on what each part adds to a token."""

    heat_weight: float = 1.0
    """Weight of the heatmap's divergence from its label (D-hiveformer-heat)."""

    position_weight: float = 100.0
    """Weight of the squared position error in square metres (D-hiveformer-recipe)."""

    crop_px: Natural = 16
    """How far the frame of the images moves in training, at most (D-hiveformer-augment)."""

    recipe: Recipe = field(default_factory=lambda: Recipe(precision="bf16", augment=UNTURNED))
    """How to train."""

    def __post_init__(self) -> None:
        """Check that the sizes fit each other.

        Raises:
            UsageError: a number makes no network, or the heads do not share the width equally.
        """
        check_numbers(self)
        if self.width % self.heads:
            raise UsageError(
                f"a width of {self.width} cannot be shared by {self.heads} heads. "
                "Choose --width as a multiple of --heads."
            )

    @property
    def grid(self) -> int:
        """Tokens per side of an image."""
        return IMAGE_PIXELS >> len(self.channels)


CPU = HiveFormerConfig()

PAPER = HiveFormerConfig(
    window=MAX_KEYFRAMES,
    past_gradients=True,
    stem=(8, 16),
    channels=(16, 16, 16, 16),
    fine_kernel=3,
    width=64,
    heads=8,
    hidden=64,
    dropout=0.1,
    heat_weight=0.0,
    position_weight=1.0,
    crop_px=0,
    recipe=Recipe(
        samples=100_000 * 32,
        batch=32,
        choice_share=None,
        lr=1e-3,
        weight_decay=5e-4,
        warmup_steps=0,
        ema_decay=0.0,
        rotation_weight=1.0,
    ),
)
"""The published sizes and loss weights; 100K iterations of 32, one step of an episode each."""


@dataclass(frozen=True)
class Choice:
    """What the network says about the next keyframe."""

    log_heat: Float[Tensor, "b k h w"]
    """Logarithm of each pixel's probability; these sum to 1 over all cameras."""

    action: Regressed


class HiveFormer(Network):
    """Multi-view transformer with a memory."""

    def __init__(self, config: HiveFormerConfig, text: TextSpec) -> None:
        """Fresh weights; `text` says how wide a token vector is."""
        super().__init__()
        self.config = config
        self.sight = CameraSight(remembers=True, steps=config.window, crop_px=config.crop_px)
        self.encoder = UnetEncoder(config.stem, config.channels)
        self.tokens = VisualTokens(config)
        self.words = WordTokens(text.dim, config.width)
        self.kinds = NormedTable(2, config.width)
        self.blocks = nn.ModuleList(HistoryBlock(config) for _ in range(config.layers))
        joined = config.channels[-1] + config.width
        self.decoder = UnetDecoder(joined, config.channels, config.fine_kernel)
        self.pose = PoseHead(len(CAMERAS) * joined, config.pose_channels)

    def forward(self, inputs: Inputs[Pictures]) -> Choice:
        """The next keyframe."""
        scene = inputs.scene
        grid, skips = self.encoder(network_images(scene.rgb[:, -1], scene.gripper_px[:, -1]))
        present = (scene.xyz_in_cube[:, -1], scene.seen[:, -1], scene.step[:, -1])
        tokens = self.tokens(grid, *present)
        tokens = self._informed(tokens, self._remembered(scene, tokens), inputs)
        added = rearrange(tokens, "b (k y x) d -> (b k) d y x", k=len(CAMERAS), y=self.config.grid)
        joined = torch.cat([grid, added.to(grid.dtype)], dim=1)
        return self._choose(scene, self.decoder(joined, skips), self.pose(joined))

    def _remembered(
        self, scene: Pictures, tokens: Float[Tensor, "b p d"]
    ) -> Float[Tensor, "b t p d"]:
        """Tokens of all steps; 0 at those that did not happen."""
        memory = tokens.new_zeros(*scene.happened.shape, *tokens.shape[1:])
        memory[:, -1] = tokens
        past = scene.happened.clone()
        past[:, -1] = False
        if past.any():
            with torch.set_grad_enabled(torch.is_grad_enabled() and self.config.past_gradients):
                grid, _ = self.encoder(network_images(scene.rgb[past], scene.gripper_px[past]))
            memory[past] = self.tokens(
                grid, scene.xyz_in_cube[past], scene.seen[past], scene.step[past]
            )
        return memory

    def _informed(
        self, tokens: Float[Tensor, "b p d"], memory: Float[Tensor, "b t p d"], inputs: Inputs
    ) -> Float[Tensor, "b p d"]:
        """Tokens of the present step after the transformer."""
        text, mask = trimmed_text(inputs)
        word_kind, visual_kind = self.kinds()
        words = self.words(text) + word_kind
        # D-hiveformer-masks: the published network reads the padding of short instructions.
        bias = padding_bias(mask)
        informed = torch.empty_like(tokens)
        lengths = inputs.scene.happened.sum(1)
        for steps in lengths.unique().tolist():  # padding short histories would double the cost
            rows = lengths == steps
            seen = memory[rows, -steps:].flatten(1, 2) + visual_kind
            context = torch.cat([seen, words[rows]], dim=1)
            scores = functional.pad(bias[rows], (seen.shape[1], 0))
            informed[rows] = self._transformed(tokens[rows], context, scores)
        return informed

    def _transformed(self, tokens: Tensor, context: Tensor, bias: Tensor) -> Tensor:
        for block in self.blocks:
            tokens = block(tokens, context, bias)
        return tokens

    def _choose(
        self, scene: Pictures, logits: Float[Tensor, "m h w"], pose: Float[Tensor, "b 14"]
    ) -> Choice:
        cameras = logits.unflatten(0, (-1, len(CAMERAS)))
        log_heat = log_heat_over(cameras, scene.seen[:, -1], TEMPERATURE)
        position = mean_point(log_heat.exp(), scene.xyz_in_cube[:, -1]) + pose[:, :OFFSET]
        return Choice(log_heat, Regressed(position, pose[:, OFFSET:]))

    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Behaviour cloning."""
        return cloning_loss(self(batch.inputs), batch, self.config)

    def act(self, inputs: Inputs) -> Prediction:
        """The keyframe that was regressed."""
        return self(inputs).action.prediction


class NormedTable(nn.Module):
    """Learned embeddings of numbers, each with a layer norm after it."""

    def __init__(self, count: int, width: int) -> None:
        """Embeddings of 0 to `count` - 1."""
        super().__init__()
        self.table = nn.Parameter(torch.randn(count, width))
        self.norm = nn.LayerNorm(width)

    def forward(self) -> Float[Tensor, "count d"]:
        """All of them."""
        return self.norm(self.table)


class WordTokens(nn.Module):
    """Words with their places in the sentence."""

    def __init__(self, text_width: int, width: int) -> None:
        """From the width of a token vector to that of the transformer."""
        super().__init__()
        self.lift = nn.Linear(text_width, width)
        self.place = NormedTable(MAX_WORDS, width)

    def forward(self, text: Float[Tensor, "b t e"]) -> Float[Tensor, "b t d"]:
        """Tokens of the words."""
        return self.lift(text) + self.place()[: text.shape[1]]


class VisualTokens(nn.Module):
    """One token a cell of the encoder's grid: feature, point, and which cell, camera and step."""

    def __init__(self, config: HiveFormerConfig) -> None:
        """Sizes as in `config`."""
        super().__init__()
        self.lift = nn.Linear(config.channels[-1] + 3, config.width)
        self.norm = nn.LayerNorm(config.width)
        self.cell = NormedTable(config.grid**2, config.width)
        self.camera = NormedTable(len(CAMERAS), config.width)
        self.step = NormedTable(MAX_KEYFRAMES, config.width)

    def forward(
        self,
        grid: Float[Tensor, "m c y x"],
        xyz_in_cube: Float[Tensor, "n k 3 h w"],
        seen: Bool[Tensor, "n k h w"],
        step: Float[Tensor, "n"],
    ) -> Float[Tensor, "n p d"]:
        """Tokens of each step, camera after camera, row after row."""
        points = pooled_points(xyz_in_cube, seen, grid.shape[-1])
        features = torch.cat([grid, points.flatten(0, 1).to(grid.dtype)], dim=1)
        cells = rearrange(features, "(n k) c y x -> n k (y x) c", k=len(CAMERAS))
        places = self.cell() + self.camera()[:, None]
        steps = self.step()[step.long()]
        return (self.norm(self.lift(cells)) + places + steps[:, None, None]).flatten(1, 2)


class HistoryBlock(nn.Module):
    """The present step reads the context, then itself, then thinks; each part is added and normed.

    The context stays as it was embedded, also for further blocks.
    """

    def __init__(self, config: HiveFormerConfig) -> None:
        """Sizes as in `config`."""
        super().__init__()
        self.across = Reading(config)
        self.within = Reading(config)
        self.rise = nn.Linear(config.width, config.hidden)
        self.fall = nn.Linear(config.hidden, config.width)
        self.norm = nn.LayerNorm(config.width)
        self.dropout = nn.Dropout(config.dropout)

    def forward(
        self,
        tokens: Float[Tensor, "b p d"],
        context: Float[Tensor, "b c d"],
        bias: Float[Tensor, "b 1 1 c"],
    ) -> Float[Tensor, "b p d"]:
        """Update the present step's tokens."""
        tokens = self.across(tokens, context, bias)
        tokens = self.within(tokens, tokens)
        return self.norm(tokens + self.dropout(self.fall(functional.gelu(self.rise(tokens)))))


class Reading(nn.Module):
    """Multi-head attention, added and normed."""

    def __init__(self, config: HiveFormerConfig) -> None:
        """Sizes as in `config`."""
        super().__init__()
        self.heads, self.rate = config.heads, config.dropout
        self.to_q = nn.Linear(config.width, config.width)
        self.to_kv = nn.Linear(config.width, 2 * config.width)
        self.to_out = nn.Linear(config.width, config.width)
        self.norm = nn.LayerNorm(config.width)
        self.dropout = nn.Dropout(config.dropout)

    def forward(
        self,
        tokens: Float[Tensor, "b p d"],
        context: Float[Tensor, "b c d"],
        bias: Float[Tensor, "b 1 1 c"] | None = None,
    ) -> Float[Tensor, "b p d"]:
        """Let every token read the context."""
        q = rearrange(self.to_q(tokens), "b p (h d) -> b h p d", h=self.heads)
        k, v = rearrange(self.to_kv(context), "b c (n h d) -> n b h c d", n=2, h=self.heads)
        read = attend(q, k, v, bias=bias, dropout=self.rate if self.training else 0.0)
        added = self.to_out(rearrange(read, "b h p d -> b p (h d)"))
        return self.norm(tokens + self.dropout(added))


class PoseHead(nn.Module):
    """Offset, rotation, gripper and collision from the grids of all cameras together."""

    def __init__(self, channels: int, width: int) -> None:
        """`channels` of all cameras' grids; `width` of the head."""
        super().__init__()
        self.first = replicated(channels, width, stride=2)
        self.norm = nn.GroupNorm(1, width)
        self.second = replicated(width, width, stride=2)
        self.hidden = nn.Linear(width, width)
        self.out = nn.Linear(width, OFFSET + POSE)

    def forward(self, grids: Float[Tensor, "m c y x"]) -> Float[Tensor, "b 14"]:
        """Offset, then the numbers of the pose."""
        cameras = rearrange(grids, "(b k) c y x -> b (k c) y x", k=len(CAMERAS))
        x = self.second(leaky(self.norm(self.first(cameras))))
        return self.out(leaky(self.hidden(x.mean((-2, -1))))).float()


def cloning_loss(
    choice: Choice, batch: Batch, config: HiveFormerConfig
) -> tuple[Tensor, dict[str, Tensor]]:
    """Divergence of the heat, squared errors of position (m) and grip, cross-entropy of flags."""
    labels = batch.labels
    error_m = (choice.action.position_in_cube - labels.position_in_cube) * (SCENE_BOUNDS.side_m / 2)
    # D-hiveformer-flags: published as the squared error of a sigmoid.
    terms = {
        "bc/heat": divergence(choice.log_heat.flatten(1), heat_labels(batch.inputs.scene, labels)),
        "bc/position": error_m.square().sum(-1).mean(),
        **choice.action.terms(labels),
    }
    weights = {
        "bc/heat": config.heat_weight,
        "bc/position": config.position_weight,
        "bc/rotation": config.recipe.rotation_weight,
    }
    return weighed(terms, weights)


def heat_labels(scene: Pictures, labels: Labels) -> Float[Tensor, "b p"]:
    """Probabilities of the pixels of all cameras; 0 at those that show no point."""
    gaps = (scene.xyz_in_cube[:, -1] - labels.position_in_cube[:, None, :, None, None]).norm(dim=2)
    gaps_m = gaps * (SCENE_BOUNDS.side_m / 2)
    return falling_off(gaps_m.masked_fill(~scene.seen[:, -1], UNSEEN_M).flatten(1))


AGENT = AgentSpec(
    name="hiveformer",
    presets={"cpu": CPU, "paper": PAPER},
    variants={"no_history": lambda config: replace(config, window=1)},
    create=HiveFormer,
)


def load(*, checkpoint: Path | None, tasks: tuple[str, ...], variant: str | None) -> KeyframePolicy:
    """The policy of a trained network; without `checkpoint`, of the released one.

    Raises:
        UsageError: the checkpoint does not fit, or nothing released covers the tasks.
    """
    return load_policy(AGENT.name, checkpoint=checkpoint, tasks=tasks, variant=variant)
