"""The loss of agents that regress an orientation as a quaternion."""

import torch
from jaxtyping import Float
from torch import Tensor


def twin(quaternion_wxyz: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b 4"]:
    """The orientation after half a turn about the tool z axis: the same grasp for two fingers."""
    w, x, y, z = quaternion_wxyz.unbind(-1)
    return torch.stack([-z, y, -x, w], dim=-1)


def grasp_error(
    quaternion_wxyz: Float[Tensor, "*b 4"], label_wxyz: Float[Tensor, "*b 4"]
) -> Float[Tensor, "*b"]:
    """Squared distance of unit quaternions to the nearest of the label, its twin and their
    negatives, all of which are the same grasp (D-twins)."""
    labels = torch.stack([label_wxyz, twin(label_wxyz)], dim=-2)
    cosines = (quaternion_wxyz[..., None, :] * labels).sum(-1).abs()
    return 2 * (1 - cosines.amax(-1))
