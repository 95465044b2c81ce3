"""Labels and loss for heat over the points of a scene (D-polarnet-heat, D-hiveformer-heat).

n counts samples; p the points, or the pixels of all cameras, that share a sample's heat.
"""

from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

REACH_M = 0.01
"""A point this much farther from the label than another gets 1/e of its share of the heat."""


def falling_off(gaps_m: Float[Tensor, "n p"]) -> Float[Tensor, "n p"]:
    """Probabilities that fall exponentially with the distance from the label (m)."""
    return (-gaps_m / REACH_M).softmax(-1)


def divergence(log_heat: Float[Tensor, "n p"], label: Float[Tensor, "n p"]) -> Tensor:
    """Kullback-Leibler divergence: 0 where the heat is the label, mean over samples."""
    return functional.kl_div(log_heat, label, reduction="batchmean")
