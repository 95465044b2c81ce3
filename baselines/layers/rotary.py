"""Attention by relative position in space: rotary codes (Su et al.) of 3D points, as in Act3D.

Channels come in pairs. Each pair of a query or key is turned by an angle proportional to one
coordinate of its point, so the product of a query and a key depends on where one point lies as
seen from the other, and moving both changes nothing. Three pairs in a row stand for x, y and z;
from three to three the angles fall from `rad_per_m` radians a metre down to nearly the `span`-th
part of that. So every head knows all three directions, and the first heads are the near-sighted
ones (D-act3d-heads).
"""

from dataclasses import dataclass
from typing import TypeAlias

import torch
from einops import rearrange
from jaxtyping import Complex64, Float
from torch import Tensor, nn
from torch.nn import functional

from baselines.layers.attention import attend, linear

Turns: TypeAlias = Complex64[Tensor, "b n pairs"]
"""Numbers of length 1 by whose angles each pair of channels is turned at each point."""


def turns(points_m: Float[Tensor, "b n 3"], width: int, rad_per_m: float, span: float) -> Turns:
    """Rotary code of points (m) for `width` channels, a multiple of 6."""
    triples = width // 6
    falling = span ** (-torch.arange(triples, device=points_m.device) / triples)
    angles = (points_m.float()[..., None, :] * (rad_per_m * falling)[:, None]).flatten(-2)
    return torch.complex(angles.cos(), angles.sin())


def turned(x: Float[Tensor, "b n d"], code: Turns | None) -> Float[Tensor, "b n d"]:
    """Turn the pairs (2i, 2i + 1) of `x`; without a code leave them as they are."""
    if code is None:
        return x
    # As complex numbers: one pass over memory, and one on the way back.
    pairs = torch.view_as_complex(x.float().unflatten(-1, (-1, 2)))
    return torch.view_as_real(pairs * code).flatten(-2).to(x.dtype)


def in_pairs(parameter: Float[Tensor, "d *e"]) -> Float[Tensor, "d *e"]:
    """Weights or biases in the order that `turned` wants: layers keep the first numbers of all
    pairs before the second ones (i, i + d/2)."""
    return rearrange(parameter, "(two p) ... -> (p two) ...", two=2)


@dataclass(frozen=True)
class Context:
    """What can be read: tokens, where they are, and which of them are real."""

    tokens: Float[Tensor, "b t d"]
    code: Turns | None
    """None: position plays no part."""

    bias: Float[Tensor, "b 1 1 t"]
    """Added to attention scores; see `layers.padding_bias`."""


@dataclass(frozen=True)
class Memory:
    """A context as one block reads it."""

    keys: Float[Tensor, "b t d"]
    """Turned."""

    values: Float[Tensor, "b t d"]
    bias: Float[Tensor, "b 1 1 t"]


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
        self, x: Float[Tensor, "b q d"], code: Turns | None, memory: Memory
    ) -> Float[Tensor, "b q d"]:
        """What each token of `x` reads of the memory."""
        q = functional.linear(x, in_pairs(self.to_q.weight), in_pairs(self.to_q.bias))
        parts = (turned(q, code), memory.keys, memory.values)
        q, k, v = (rearrange(y, "b n (h d) -> b h n d", h=self.heads) for y in parts)
        read = attend(q, k, v, bias=memory.bias)
        return self.to_out(rearrange(read, "b h q d -> b q (h d)"))


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
        self, x: Float[Tensor, "b q d"], code: Turns | None, memory: Memory
    ) -> Float[Tensor, "b q d"]:
        """Update the tokens of `x` from the memory."""
        x = self.norm_read(x + self.attention(x, code, memory))
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
        for block, memory in zip(self.blocks, self.memories(context), strict=True):
            x = block(x, code, memory)
        return x

    def memories(self, context: Context) -> list[Memory]:
        """What each block reads. The context stays as it is, so one product makes all of it."""
        attentions = [m for m in self.modules() if isinstance(m, RelativeAttention)]
        weights = [w for a in attentions for w in (in_pairs(a.to_k.weight), a.to_v.weight)]
        biases = [b for a in attentions for b in (in_pairs(a.to_k.bias), a.to_v.bias)]
        parts = functional.linear(context.tokens, torch.cat(weights), torch.cat(biases))
        keys_and_values = parts.chunk(2 * len(attentions), dim=-1)
        return [
            Memory(turned(keys, context.code), values, context.bias)
            for keys, values in zip(keys_and_values[::2], keys_and_values[1::2], strict=True)
        ]
