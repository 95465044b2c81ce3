"""Ghost points: candidate positions in free space, among which Act3D detects the next one.

Uniform in the cube at first, then in a ball around a guess; a ball is cut off at the cube's faces.
"""

from collections.abc import Callable
from functools import cache
from typing import TypeAlias

import torch
from jaxtyping import Float
from torch import Tensor

SPARE = 3
"""Points drawn in a ball's box for each one wanted; at least 52 % of any such box are ball."""

Draw: TypeAlias = Callable[[int, int], Float[Tensor, "#b n 3"]]
"""Rows and count -> points of the unit cube."""


def scattered(rows: int, count: int) -> Float[Tensor, "b n 3"]:
    """Independent uniform points of the unit cube, from torch's global generator."""
    return torch.rand(rows, count, 3)


@cache
def _sequence(count: int) -> Float[Tensor, "1 n 3"]:
    """Additive recurrence with the powers of 1/g, g^4 = g + 1: each prefix is evenly spread."""
    growth = 1.2207440846057596
    steps = torch.arange(1, count + 1, dtype=torch.float64)[:, None]
    ratios = growth ** -torch.arange(1, 4, dtype=torch.float64)
    return ((0.5 + steps * ratios) % 1).float()[None]


def spread(rows: int, count: int) -> Float[Tensor, "1 n 3"]:
    """The same even spread over the unit cube every time and for all rows (D-act3d-spread)."""
    del rows
    return _sequence(count)


def in_cube(draw: Draw, rows: int, count: int) -> Float[Tensor, "b n 3"]:
    """Points all over the cube [-1, 1]^3."""
    return (2 * draw(rows, count) - 1).expand(rows, -1, -1)


def in_ball(
    draw: Draw, center: Float[Tensor, "b 3"], radius: float, count: int
) -> Float[Tensor, "b n 3"]:
    """Points all over the part of a ball that lies in the cube.

    Drawn once in the ball's box inside the cube; the first ones within the ball are taken. Should
    they ever be too few, others are pulled towards the centre, so it ends after one try. A centre
    outside the cube counts as the nearest point of the cube.
    """
    center = center.clamp(-1, 1)[:, None]
    low, high = (center - radius).clamp(min=-1), (center + radius).clamp(max=1)
    unit = draw(len(center), SPARE * count).to(center.device)
    offset = low + unit * (high - low) - center
    distance = offset.norm(dim=-1, keepdim=True)
    first = (distance[..., 0] > radius).sort(dim=-1, stable=True).indices[:, :count, None]
    pulled = offset * (radius / distance.clamp(min=radius))
    return center + pulled.gather(1, first.expand(-1, -1, 3))
