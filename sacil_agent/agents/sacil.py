"""SACIL: size-aware contrastive imitation learning (paper section 3).

    cloud -> five orthographic views -> stem -> tokens -> two self-attention layers per view
          -> five queries read them --------> Image-Text Contrast with the sentence
          -> + sentence, the queries read again; proprioception joins the tokens
          -> four joint self-attention layers over [words, queries, tokens]
          -> RVT's decoder: heatmaps, rotation, gripper, collision
             queries ----------------------> Current-Goal Contrast with the views at the next
                                             keyframe, encoded by the same stem and view layers

Stem, decoder, head and recipe are those of `rvt`, so the difference between the two is the method.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import torch
from einops import reduce
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from baselines.agent import AgentSpec, Network
from baselines.agents.rvt import PAPER_RECIPE
from baselines.batch import Batch, Inputs, Prediction
from baselines.configs import Natural, Range
from baselines.layers.attention import NormedLinear, linear, mlp, padding_bias
from baselines.layers.heads import ActionLogits, action_loss, choose
from baselines.layers.multiview import (
    ActionDecoder,
    MultiViewConfig,
    ViewEncoder,
    blocks,
    last_token,
    positions,
    roughened,
    trimmed_text,
    within_views,
)
from baselines.layers.stems import Maps
from baselines.policy import KeyframePolicy, load_policy
from baselines.scene.sight import Views, ViewSight
from baselines.scene.views import VIEWS
from baselines.text import TextSpec
from sacil_agent.contrast import Contrast, diagnostics, same_meaning
from sacil_agent.sadq import Read, SizeAwareQueries


@dataclass(frozen=True, kw_only=True)
class SacilConfig(MultiViewConfig):
    """Sizes of SACIL; the defaults are the `cpu` preset."""

    queries: Natural = 5
    """Size-aware query tokens (section 3.4); 0 contrasts the mean visual token instead."""

    instruction_enters: Literal["after_contrast", "before_contrast"] = "after_contrast"
    """When the queries are told the instruction. The paper says before, but then Image-Text
    Contrast compares the words with themselves and teaches nothing (D-order)."""

    image_text_weight: float = 1.0
    """Weight of Image-Text Contrast (Eq. 3); 0 leaves it out."""

    current_goal_weight: float = 1.0
    """Weight of Current-Goal Contrast (Eq. 4); 0 leaves it and the goal views out."""

    proprio_width: Annotated[int, Range(2)] = 2
    """Proprioceptive numbers: gripper open and time (D-proprio); any more are zeros."""

    view_layers: int = 2
    """Self-attention layers within each view (section 3.3)."""

    joint_layers: int = 4
    """Self-attention layers over words, queries and visual tokens (section 3.4)."""


CPU = SacilConfig()

PAPER = SacilConfig(
    pixels=220,
    patch=11,
    stem="patch",
    stem_channels=64,
    upsample_kernel=11,
    lowered_channels=64,
    head_hidden=(128, 64),
    width=512,
    heads=8,
    head_width=64,
    hidden=2048,
    dropout=0.1,
    recipe=PAPER_RECIPE,
)

VARIANTS = {
    "no_queries": lambda config: replace(config, queries=0),
    "no_contrast": lambda config: replace(config, image_text_weight=0.0, current_goal_weight=0.0),
    "image_text": lambda config: replace(config, current_goal_weight=0.0),
    "conditioned_contrast": lambda config: replace(config, instruction_enters="before_contrast"),
    "patch_stem": lambda config: replace(config, stem="patch", stem_channels=16),
}
"""Ablations of tables 3 and 4, and the two choices of ours the paper makes otherwise."""


@dataclass(frozen=True)
class Seen:
    """One pass through the network."""

    logits: ActionLogits
    image: Float[Tensor, "b d"]
    """Where Image-Text Contrast reads: neither words nor proprioception have entered."""

    sentence: Float[Tensor, "b d"]
    """The instruction as Image-Text Contrast and the queries get it."""

    situation: Float[Tensor, "b d"]
    """Where Current-Goal Contrast reads: after the joint layers."""


class Sacil(Network):
    """RVT's frame with size-aware queries and two contrasts."""

    def __init__(self, config: SacilConfig, text: TextSpec) -> None:
        """Fresh weights; `text` says how wide a token vector is."""
        super().__init__()
        self.config = config
        self.sight = ViewSight(config.pixels)
        width = config.width
        self.encoder = ViewEncoder(config)
        self.position = positions(config, config.stem_channels)
        self.lift = linear(config.stem_channels, width)
        self.view_blocks = blocks(config.view_layers, config)
        self.words = NormedLinear(text.dim, width)
        self.sentence = mlp((text.dim, width, width))
        self.queries = _queries(config)
        self.proprio = linear(config.proprio_width, width)
        self.joint_blocks = blocks(config.joint_layers, config)
        self.action = ActionDecoder(config)
        if config.image_text_weight > 0:
            self.image_text = Contrast(width, width, width)
        if config.current_goal_weight > 0:
            self.goal_sight = self.sight
            self.goal_position = positions(config, config.stem_channels)
            self.current_goal = Contrast(width, len(VIEWS) * width, width)

    def forward(self, inputs: Inputs[Views]) -> Seen:
        """From views and words to the action's logits and the features to contrast."""
        tokens, skips = self.visual_tokens(inputs.scene, self.position)
        sentence = self.sentence(last_token(inputs))
        read = self._read(tokens, sentence)
        # Proprioception enters here and not before (D-proprio-late): the time step alone would
        # tell Image-Text Contrast which samples are first keyframes.
        tokens = tokens + self.proprio(inputs.proprio_of(self.config.proprio_width))[:, None]
        tokens, queries = self._join(tokens, read.queries, inputs)
        situation = tokens if self.queries is None else queries
        return Seen(
            logits=self.action(tokens, skips),
            image=read.contrasted,
            sentence=sentence,
            situation=situation.mean(dim=1),
        )

    def visual_tokens(
        self, scene: Views, position: Float[Tensor, "1 t c"]
    ) -> tuple[Float[Tensor, "b t d"], Maps]:
        """The visual encoder (section 3.3), and the stem's skips for the decoder."""
        tokens, skips = self.encoder(scene.views)
        return within_views(self.view_blocks, self.lift(tokens + position)), skips

    def goal_features(self, goal: Views) -> Float[Tensor, "b vd"]:
        """Mean visual token of each view of the goal, one beside the other."""
        tokens, _ = self.visual_tokens(goal, self.goal_position)
        return reduce(tokens, "b (v p) d -> b (v d)", "mean", v=len(VIEWS))

    def _read(self, tokens: Float[Tensor, "b t d"], sentence: Float[Tensor, "b d"]) -> Read:
        """What the queries read, or the mean token where there are none."""
        if self.queries is None:
            return Read(contrasted=tokens.mean(dim=1), queries=tokens[:, :0])
        return self.queries(tokens, sentence)

    def _join(
        self, tokens: Float[Tensor, "b t d"], queries: Float[Tensor, "b q d"], inputs: Inputs
    ) -> tuple[Float[Tensor, "b t d"], Float[Tensor, "b q d"]]:
        """Joint self-attention over words, queries and visual tokens (section 3.4)."""
        text, mask = trimmed_text(inputs)
        joint = torch.cat([self.words(text), queries, tokens], dim=1)
        sizes = [text.shape[1], queries.shape[1], tokens.shape[1]]
        bias = padding_bias(functional.pad(mask, (0, sizes[1] + sizes[2]), value=True))
        for block in self.joint_blocks:
            joint = block(joint, bias)
        _, queries, tokens = joint.split(sizes, dim=1)
        return tokens, queries

    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Behaviour cloning (Eq. 1) plus the contrasts that are switched on (Eq. 3 and 4)."""
        recipe = self.config.recipe
        scene = roughened(batch.inputs.scene, recipe.image_noise)
        seen = self(replace(batch.inputs, scene=scene))
        total, terms = action_loss(seen.logits, batch.labels, recipe)
        same = same_meaning(batch)
        if self.config.image_text_weight > 0:
            loss, cosines = self.image_text(seen.image, seen.sentence, same)
            total = total + self.config.image_text_weight * loss
            terms |= {"itc/loss": loss.detach(), **diagnostics("itc", cosines, batch)}
        if batch.goal is not None and self.goal_sight is not None:
            goals = self.goal_features(roughened(batch.goal, recipe.image_noise))
            loss, cosines = self.current_goal(seen.situation, goals, same)
            total = total + self.config.current_goal_weight * loss
            terms |= {"cgc/loss": loss.detach(), **diagnostics("cgc", cosines, batch)}
        return total, terms

    def act(self, inputs: Inputs) -> Prediction:
        """Highest point of the heatmaps, likeliest rotation, gripper and collision."""
        return choose(self(inputs).logits)


def _queries(config: SacilConfig) -> SizeAwareQueries | None:
    if config.queries == 0:
        return None
    return SizeAwareQueries(
        config.block_sizes,
        queries=config.queries,
        instruction_enters=config.instruction_enters,
    )


AGENT = AgentSpec(
    name="sacil", presets={"cpu": CPU, "paper": PAPER}, variants=VARIANTS, create=Sacil
)


def load(*, checkpoint: Path | None, tasks: tuple[str, ...], variant: str | None) -> KeyframePolicy:
    """The policy of a trained network; without `checkpoint`, of the released one.

    Raises:
        UsageError: the checkpoint does not fit, or nothing released covers the tasks.
    """
    return load_policy(AGENT.name, checkpoint=checkpoint, tasks=tasks, variant=variant)
