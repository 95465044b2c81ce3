"""The action: logits of its parts, the behaviour-cloning loss, and the keyframe chosen.

RVT's head. The translation is one heatmap per view; rotation (three Euler angles of 72 bins),
gripper and collision are read from the strongest token features of each view and from the
feature maps at the place the heatmap points to.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from baselines.agent import Recipe, weighed
from baselines.batch import Labels, Prediction
from baselines.heatmap import decode, target_heatmaps
from baselines.layers.attention import mlp
from baselines.rotation import BINS, bins_to_quaternion, soft_labels
from baselines.scene.views import VIEWS


@dataclass(frozen=True)
class ActionLogits:
    """What a network says about the next keyframe."""

    heatmaps: Float[Tensor, "b v h w"]
    rotation: Float[Tensor, "b 3 bins"]
    gripper: Float[Tensor, "b 2"]
    collision: Float[Tensor, "b 2"]


def read_at(
    heat: Float[Tensor, "n 1 h w"], features: Float[Tensor, "n c g g"]
) -> Float[Tensor, "n c"]:
    """Mean of a feature map under the heatmap's probabilities.

    The probabilities are detached, as in RVT: otherwise the rotation loss would bend the heatmap.
    """
    mass = heat.detach().float().flatten(1).softmax(-1).view_as(heat)
    share = heat.shape[-1] // features.shape[-1]
    weights = functional.avg_pool2d(mass, share, divisor_override=1) if share > 1 else mass
    return torch.einsum(
        "n p, n p c -> n c", weights.flatten(1), features.permute(0, 2, 3, 1).flatten(1, 2)
    )


class ActionHead(nn.Module):
    """Rotation, gripper and collision from tokens and feature maps (D-head)."""

    def __init__(
        self, token_channels: int, map_channels: Sequence[int], hidden: tuple[int, int]
    ) -> None:
        """`map_channels` are those of the decoder's feature maps."""
        super().__init__()
        features = len(VIEWS) * (token_channels + sum(map_channels))
        self.mlp = mlp((features, *hidden, 3 * BINS + 4))

    def forward(
        self,
        tokens: Float[Tensor, "n c g g"],
        heat: Float[Tensor, "n 1 h w"],
        maps: Sequence[Float[Tensor, "n _ _ _"]],
    ) -> ActionLogits:
        """Logits of the action; `n` counts the views of all samples, sample by sample."""
        reads = [tokens.amax(dim=(-2, -1)), *(read_at(heat, features) for features in maps)]
        features = [rearrange(read, "(b v) c -> b (v c)", v=len(VIEWS)) for read in reads]
        out = self.mlp(torch.cat(features, dim=-1)).float()
        return ActionLogits(
            heatmaps=rearrange(heat, "(b v) 1 h w -> b v h w", v=len(VIEWS)).float(),
            rotation=out[:, : 3 * BINS].unflatten(-1, (3, BINS)),
            gripper=out[:, -4:-2],
            collision=out[:, -2:],
        )


def action_loss(
    logits: ActionLogits, labels: Labels, recipe: Recipe
) -> tuple[Tensor, dict[str, Tensor]]:
    """Negative log-likelihood of the expert's keyframe (Eq. 1) and its terms, weights left out."""
    target = target_heatmaps(
        labels.position_in_cube, logits.heatmaps.shape[-1], recipe.heatmap_sigma_px
    )
    return loss_of_maps(logits, target, labels, recipe)


def loss_of_maps(
    logits: ActionLogits, target: Float[Tensor, "b v h w"], labels: Labels, recipe: Recipe
) -> tuple[Tensor, dict[str, Tensor]]:
    """The same where the network has views of its own: `target` is what its heatmaps should be."""
    terms = {
        "bc/position": _heatmap_loss(logits.heatmaps, target),
        "bc/rotation": _rotation_loss(logits.rotation, labels, recipe.rotation_sigma_bins),
        "bc/gripper": functional.cross_entropy(logits.gripper, labels.gripper_open),
        "bc/collision": functional.cross_entropy(logits.collision, labels.ignore_collisions),
    }
    return weighed(terms, {"bc/rotation": recipe.rotation_weight})


def _heatmap_loss(logits: Float[Tensor, "b v h w"], target: Float[Tensor, "b v h w"]) -> Tensor:
    """Cross-entropy over the pixels of each view, mean over samples and views."""
    flat = logits.flatten(0, 1).flatten(1)
    return functional.cross_entropy(flat, target.flatten(0, 1).flatten(1))


def _rotation_loss(logits: Float[Tensor, "b 3 bins"], labels: Labels, sigma_bins: float) -> Tensor:
    """Sum over the three angles of the cross-entropy with circular labels (D-rotation)."""
    if sigma_bins > 0:
        target = soft_labels(labels.rotation_bins, sigma_bins)
    else:
        target = functional.one_hot(labels.rotation_bins, BINS).float()
    return 3 * functional.cross_entropy(logits.flatten(0, 1), target.flatten(0, 1))


def choose(logits: ActionLogits) -> Prediction:
    """The most likely keyframe."""
    return choose_at(decode(logits.heatmaps), logits)


def choose_at(position_in_cube: Float[Tensor, "b 3"], logits: ActionLogits) -> Prediction:
    """The same where the network finds the position in a way of its own."""
    return Prediction(
        position_in_cube=position_in_cube,
        quaternion_wxyz=bins_to_quaternion(logits.rotation.argmax(-1)),
        gripper_open=logits.gripper.argmax(-1) == 1,
        ignore_collisions=logits.collision.argmax(-1) == 1,
    )
