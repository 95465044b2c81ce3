"""SACIL-RVT-2: the two contrasts on RVT-2 as it is (paper table 5).

RVT-2 has no queries, so the contrasts read the mean visual token of its coarse stage, which sees
the whole scene and picks the object:

    coarse views -> tokens -> layers within views -> mean -> Image-Text Contrast with the sentence
                 -> joint layers with the words   -> mean -> Current-Goal Contrast with the coarse
                                                             views at the next keyframe

Acting, it is `rvt2`: the projections of the contrasts only train.
"""

from dataclasses import dataclass
from pathlib import Path

from einops import reduce
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from baselines.agent import AgentSpec
from baselines.agents.rvt2 import PAPER as RVT2_PAPER
from baselines.agents.rvt2 import Rvt2, Rvt2Config
from baselines.batch import Batch
from baselines.layers.attention import mlp
from baselines.layers.multiview import last_token, positions, roughened, within_views
from baselines.policy import KeyframePolicy, load_policy
from baselines.scene.sight import Views, ViewSight, ZoomScene
from baselines.text import TextSpec
from sacil_agent.contrast import Contrast, diagnostics, same_meaning


@dataclass(frozen=True, kw_only=True)
class SacilRvt2Config(Rvt2Config):
    """Sizes of RVT-2 and weights of the contrasts; the defaults are the `cpu` preset."""

    image_text_weight: float = 0.1
    """Weight of Image-Text Contrast (Eq. 3; D-zoom-weights)."""

    current_goal_weight: float = 0.1
    """Weight of Current-Goal Contrast (Eq. 4; D-zoom-weights)."""


CPU = SacilRvt2Config()

PAPER = SacilRvt2Config(**vars(RVT2_PAPER), image_text_weight=1.0, current_goal_weight=1.0)


class SacilRvt2(Rvt2):
    """RVT-2 whose coarse stage is contrasted with the sentence and with the goal."""

    def __init__(self, config: SacilRvt2Config, text: TextSpec) -> None:
        """Fresh weights; `text` says how wide a token vector is."""
        super().__init__(config, text)
        self.config: SacilRvt2Config = config
        self.goal_sight = ViewSight(config.pixels, config.views)
        width = config.width
        self.sentence = mlp((text.dim, width, width))
        self.image_text = Contrast(width, width, width)
        self.goal_position = positions(config, config.stem_channels + config.proprio_channels)
        self.current_goal = Contrast(width, len(config.views) * width, width)

    def goal_features(self, goal: Views) -> Float[Tensor, "b vd"]:
        """Mean visual token of each coarse view of the goal, one beside the other.

        Proprioception at the goal is not known: its channels hold what the embedding puts there.
        """
        coarse = self.coarse
        tokens, _ = coarse.encoder(goal.views)
        padded = functional.pad(tokens, (0, self.config.proprio_channels))
        tokens = coarse.lift(padded + self.goal_position)
        tokens = within_views(coarse.view_blocks, tokens, coarse.views)
        return reduce(tokens, "b (v p) d -> b (v d)", "mean", v=coarse.views)

    def loss(self, batch: Batch[ZoomScene]) -> tuple[Tensor, dict[str, Tensor]]:
        """Behaviour cloning (Eq. 1) plus the contrasts (Eq. 3 and 4)."""
        config, same = self.config, same_meaning(batch)
        look = self.coarse_look(batch)
        total, terms = self.cloning_loss(look, batch)
        # D-zoom-proprio: RVT-2 has let proprioception in before the first layer.
        image, sentence = look.read.alone.mean(dim=1), self.sentence(last_token(batch.inputs))
        loss, cosines = self.image_text(image, sentence, same)
        total = total + config.image_text_weight * loss
        terms |= {"itc/loss": loss.detach(), **diagnostics("itc", cosines, batch)}
        if batch.goal is not None:
            goals = self.goal_features(roughened(batch.goal, config.recipe.image_noise))
            loss, cosines = self.current_goal(look.read.joined.mean(dim=1), goals, same)
            total = total + config.current_goal_weight * loss
            terms |= {"cgc/loss": loss.detach(), **diagnostics("cgc", cosines, batch)}
        return total, terms


AGENT = AgentSpec(name="sacil_rvt2", presets={"cpu": CPU, "paper": PAPER}, create=SacilRvt2)


def load(*, checkpoint: Path | None, tasks: tuple[str, ...], variant: str | None) -> KeyframePolicy:
    """The policy of a trained network; without `checkpoint`, of the released one.

    Raises:
        UsageError: the checkpoint does not fit, or nothing released covers the tasks.
    """
    return load_policy(AGENT.name, checkpoint=checkpoint, tasks=tasks, variant=variant)
