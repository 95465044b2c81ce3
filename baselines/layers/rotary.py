"""Attention by relative position in space: rotary codes (Su et al.) of 3D points, as in Act3D.

Channels come in pairs. Each pair of a query or key is turned by an angle proportional to one
coordinate of its point, so the product of a query and a key depends on where one point lies as
seen from the other, and moving both changes nothing. Three pairs in a row stand for x, y and z;
from three to three the angles fall from `rad_per_m` radians a metre down to nearly a
ten-thousandth of that. So every head knows all three directions, and the first heads are the
near-sighted ones (D-act3d-heads).
"""

from dataclasses import dataclass

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from baselines.layers.attention import attend, linear

SPAN = 10_000
"""Ratio of the fastest to the slowest angle."""


@dataclass(frozen=True)
class Turns:
    """Cosine and sine by which each pair of channels is turned at each point."""

    cos: Float[Tensor, "b n pairs"]
    sin: Float[Tensor, "b n pairs"]


def turns(points_m: Float[Tensor, "b n 3"], width: int, rad_per_m: float) -> Turns:
    """Rotary code of points (m) for `width` channels, a multiple of 6."""
    triples = width // 6
    falling = SPAN ** (-torch.arange(triples, device=points_m.device) / triples)
    angles = (points_m.float()[..., None, :] * (rad_per_m * falling)[:, None]).flatten(-2)
    return Turns(angles.cos(), angles.sin())


def turned(x: Float[Tensor, "b n d"], code: Turns | None) -> Float[Tensor, "b n d"]:
    """Turn the pairs (i, i + d/2) of `x`; without a code leave them as they are."""
    if code is None:
        return x
    first, second = x.chunk(2, dim=-1)
    whole = [first * code.cos - second * code.sin, first * code.sin + second * code.cos]
    return torch.cat(whole, dim=-1).to(x.dtype)


@dataclass(frozen=True)
class Context:
    """What can be read: tokens, where they are, and which of them are real."""

    tokens: Float[Tensor, "b t d"]
    code: Turns | None
    """None: position plays no part."""

    bias: Float[Tensor, "b 1 1 t"]
    """Added to attention scores; see `layers.padding_bias`."""


class RelativeAttention(nn.Module):
    """Multi-head cross-attention; queries and keys are turned, values are not."""

    def __init__(self, width: int, heads: int) -> None:
        """Every head takes whole triples of pairs: `width` is a multiple of 6 * `heads`."""
        super().__init__()
        self.heads = heads
        self.to_q = linear(width, width)
        self.to_k = linear(width, width)
        self.to_v = linear(width, width)
        self.to_out = nn.Linear(width, width)
        nn.init.zeros_(self.to_out.bias)

    def forward(
        self, x: Float[Tensor, "b q d"], code: Turns | None, context: Context
    ) -> Float[Tensor, "b q d"]:
        """What each token of `x` reads of `context`."""
        q = self._pairs(turned(self.to_q(x), code))
        k = self._pairs(turned(self.to_k(context.tokens), context.code))
        v = rearrange(self.to_v(context.tokens), "b t (h d) -> b h t d", h=self.heads)
        read = attend(q, k, v, bias=context.bias)
        return self.to_out(rearrange(read, "b h q d -> b q (h d)"))

    def _pairs(self, x: Float[Tensor, "b n d"]) -> Float[Tensor, "b h n _"]:
        """Heads made of neighbouring pairs."""
        return rearrange(x, "b n (two h p) -> b h n (two p)", two=2, h=self.heads)


class RelativeBlock(nn.Module):
    """Cross-attention and a feed-forward part of the same width, each with residual and norm."""

    def __init__(self, width: int, heads: int) -> None:
        """Fresh weights."""
        super().__init__()
        self.attention = RelativeAttention(width, heads)
        self.norm_read = nn.LayerNorm(width)
        self.rise = linear(width, width)
        self.fall = linear(width, width)
        self.norm_out = nn.LayerNorm(width)

    def forward(
        self, x: Float[Tensor, "b q d"], code: Turns | None, context: Context
    ) -> Float[Tensor, "b q d"]:
        """Update the tokens of `x` from the context."""
        x = self.norm_read(x + self.attention(x, code, context))
        return self.norm_out(x + self.fall(functional.relu(self.rise(x))))


class Reader(nn.Module):
    """Some blocks that read the same context one after another."""

    def __init__(self, width: int, heads: int, blocks: int) -> None:
        """Fresh weights."""
        super().__init__()
        self.blocks = nn.ModuleList(RelativeBlock(width, heads) for _ in range(blocks))

    def forward(
        self, x: Float[Tensor, "b q d"], code: Turns | None, context: Context
    ) -> Float[Tensor, "b q d"]:
        """Update the tokens of `x` from the context; they never see each other."""
        for block in self.blocks:
            x = block(x, code, context)
        return x
