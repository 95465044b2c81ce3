"""RVT (Goyal et al., CoRL 2023), re-implemented from its published sizes.

    cloud -> five orthographic views -> stem -> tokens, one per patch, + proprioception
          -> self-attention within each view -> joint self-attention with the words
          -> one heatmap per view -> 3D point; rotation, gripper, collision where it peaks

The preset `paper` is the published network (section 3 of that paper; 36,348,093 parameters with
512-wide text and four proprioceptive numbers); `cpu` keeps its steps at a size one core can train.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor, nn

from baselines.agent import AgentSpec, Network, Recipe
from baselines.batch import Batch, Inputs, Prediction
from baselines.configs import Range
from baselines.layers.attention import NormedLinear, linear, padding_bias
from baselines.layers.heads import ActionLogits, action_loss, choose
from baselines.layers.multiview import (
    ActionDecoder,
    MultiViewConfig,
    ViewEncoder,
    blocks,
    positions,
    roughened,
    trimmed_text,
    within_views,
)
from baselines.layers.stems import Maps
from baselines.policy import KeyframePolicy, load_policy
from baselines.scene.augment import AugmentConfig
from baselines.scene.sight import Views, ViewSight
from baselines.text import TextSpec


@dataclass(frozen=True, kw_only=True)
class RvtConfig(MultiViewConfig):
    """Sizes of RVT; the defaults are the `cpu` preset."""

    proprio_width: Annotated[int, Range(2)] = 2
    """Proprioceptive numbers: gripper open and time. RVT has two more, the finger joints, which
    would tell the size of what is held (D-proprio); any more are zeros here."""

    proprio_channels: int = 64
    """Channels of proprioception beside those of every image token."""

    view_layers: int = 2
    """Self-attention layers within each view."""

    joint_layers: int = 4
    """Self-attention layers over all tokens and the words."""


CPU = RvtConfig()

PAPER_RECIPE = Recipe(
    samples=133_000 * 18,
    batch=18,
    choice_share=None,
    lr=1.8e-3,
    warmup_steps=2000,
    ema_decay=0.0,
    rotation_weight=1.0,
    rotation_sigma_bins=0.0,
    image_noise=0.1,
    augment=AugmentConfig(translation_m=0.125),
)
"""The paper's section 4.1: 133K iterations, batch 18, LAMB at 1.8e-3, 2K steps of warm-up."""

PAPER = RvtConfig(
    pixels=220,
    patch=11,
    stem="patch",
    stem_channels=64,
    upsample_kernel=11,
    lowered_channels=128,
    head_hidden=(192, 96),
    width=512,
    heads=8,
    head_width=64,
    hidden=2048,
    dropout=0.1,
    view_layers=4,
    joint_layers=4,
    recipe=PAPER_RECIPE,
)


@dataclass(frozen=True)
class Read:
    """Visual tokens on their way through the transformer."""

    alone: Float[Tensor, "b t d"]
    """After the layers within each view, which know no words."""

    joined: Float[Tensor, "b t d"]
    """After the layers over all tokens and the words."""

    skips: Maps
    """What the stem keeps for the decoder."""


class Transformer(nn.Module):
    """RVT up to the tokens that its decoder reads."""

    def __init__(self, config: RvtConfig, text: TextSpec) -> None:
        """Fresh weights; `text` says how wide a token vector is."""
        super().__init__()
        self.views = len(config.views)
        joined = config.stem_channels + config.proprio_channels
        self.encoder = ViewEncoder(config)
        self.proprio_width = config.proprio_width
        self.proprio = NormedLinear(config.proprio_width, config.proprio_channels)
        self.position = positions(config, joined)
        self.text = NormedLinear(text.dim, joined)
        self.lift = linear(joined, config.width)
        self.view_blocks = blocks(config.view_layers, config)
        self.joint_blocks = blocks(config.joint_layers, config)

    def read(self, views: Float[Tensor, "b v 7 h w"], inputs: Inputs) -> Read:
        """Look at the views with the words and the proprioception of `inputs`."""
        tokens, skips = self.encoder(views)
        state = self.proprio(inputs.proprio_of(self.proprio_width))
        proprio = state[:, None].expand(-1, tokens.shape[1], -1)
        tokens = self.lift(torch.cat([tokens, proprio], dim=-1) + self.position)
        alone = within_views(self.view_blocks, tokens, self.views)
        return Read(alone=alone, joined=self._with_words(alone, inputs), skips=skips)

    def _with_words(self, tokens: Float[Tensor, "b t d"], inputs: Inputs) -> Float[Tensor, "b t d"]:
        """Joint self-attention of words and image tokens; the words are dropped after it."""
        text, mask = trimmed_text(inputs)
        words = self.lift(self.text(text))
        joint = torch.cat([words, tokens], dim=1)
        # D-text-mask: RVT lets tokens look at the padding of short instructions.
        bias = padding_bias(torch.cat([mask, mask.new_ones(tokens.shape[:2])], dim=1))
        for block in self.joint_blocks:
            joint = block(joint, bias)
        return joint[:, words.shape[1] :]


class Rvt(Transformer, Network):
    """Multi-view transformer."""

    def __init__(self, config: RvtConfig, text: TextSpec) -> None:
        """Fresh weights; `text` says how wide a token vector is."""
        super().__init__(config, text)
        self.config = config
        self.sight = ViewSight(config.pixels)
        self.action = ActionDecoder(config)

    def forward(self, inputs: Inputs[Views]) -> ActionLogits:
        """Logits of the next keyframe."""
        read = self.read(inputs.scene.views, inputs)
        return self.action(read.joined, read.skips)

    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Behaviour cloning only."""
        recipe = self.config.recipe
        scene = roughened(batch.inputs.scene, recipe.image_noise)
        return action_loss(self(replace(batch.inputs, scene=scene)), batch.labels, recipe)

    def act(self, inputs: Inputs) -> Prediction:
        """Highest point of the heatmaps, likeliest rotation, gripper and collision."""
        return choose(self(inputs))


AGENT = AgentSpec(
    name="rvt",
    presets={"cpu": CPU, "paper": PAPER},
    # The same network under another name: tables let this row have more samples than the others,
    # as many as `sacil`'s core-minutes buy.
    variants={"equal_compute": lambda config: config},
    create=Rvt,
)


def load(*, checkpoint: Path | None, tasks: tuple[str, ...], variant: str | None) -> KeyframePolicy:
    """The policy of a trained network; without `checkpoint`, of the released one.

    Raises:
        UsageError: the checkpoint does not fit, or nothing released covers the tasks.
    """
    return load_policy(AGENT.name, checkpoint=checkpoint, tasks=tasks, variant=variant)
