"""Transformer parts shared by the view-based agents: attention, GEGLU, pre-norm blocks.

Sizes and initialisation follow RVT (Goyal et al., CoRL 2023): pre-norm, query and key-value
projections without bias, GEGLU feed-forward, no final norm.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from einops import rearrange
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional

from baselines.layers.tiles import attend_with_loss

LEAK = 0.02
"""Negative slope of every LeakyReLU in RVT's convolutions and projections."""

LANES = 16
"""Numbers of a processor's vector, at most."""


@dataclass(frozen=True, kw_only=True)
class BlockSizes:
    """Sizes of one transformer block."""

    width: int
    heads: int
    head_width: int

    hidden: int
    """Hidden units of the feed-forward part."""

    dropout: float
    """Dropout on attention probabilities."""


def attend(
    q: Float[Tensor, "b h q d"],
    k: Float[Tensor, "b h t d"],
    v: Float[Tensor, "b h t d"],
    *,
    bias: Float[Tensor, "b 1 1 t"] | None = None,
    dropout: float = 0.0,
) -> Float[Tensor, "b h q d"]:
    """Softmax attention; `bias` is added to the scores, `dropout` acts on the probabilities."""
    if q.device.type == "cpu" and q.dtype == torch.bfloat16:
        # On a CPU the fused kernel is 1.5 to 10 times slower in bf16 than two products at these
        # sequence lengths; in fp32 and on a GPU it is the faster one.
        scores = (q * q.shape[-1] ** -0.5) @ k.transpose(-1, -2)
        weights = (scores if bias is None else scores + bias.to(q.dtype)).softmax(-1)
        return functional.dropout(weights, dropout, training=dropout > 0) @ v
    if q.device.type == "cpu" and dropout > 0:
        return attend_with_loss(q, k, v, bias=bias, dropout=dropout)
    mask = None if bias is None else bias.to(q.dtype)
    width = q.shape[-1]
    if q.device.type == "cpu" and width % LANES:
        # Whole vectors: a width of 30 takes a third longer than one of 32.
        q, k, v = (functional.pad(x, (0, -width % LANES)) for x in (q, k, v))
    read = functional.scaled_dot_product_attention(
        q, k, v, attn_mask=mask, dropout_p=dropout, scale=width**-0.5
    )
    return read[..., :width]


def padding_bias(real: Bool[Tensor, "b t"]) -> Float[Tensor, "b 1 1 t"]:
    """Scores to add so that no query looks at padding: 0 at real tokens, very low elsewhere."""
    return torch.where(real, 0.0, -1e4)[:, None, None, :]


class Attention(nn.Module):
    """Multi-head attention, without bias before and with bias after."""

    def __init__(self, sizes: BlockSizes) -> None:
        """Queries, keys and values are each `heads * head_width` wide."""
        super().__init__()
        self.heads, self.dropout = sizes.heads, sizes.dropout
        inner = sizes.heads * sizes.head_width
        # One matrix: self-attention takes one product where three would do.
        self.to_qkv = nn.Linear(sizes.width, 3 * inner, bias=False)
        self.to_out = nn.Linear(inner, sizes.width)

    def forward(
        self, x: Float[Tensor, "b t d"], bias: Float[Tensor, "b 1 1 t"] | None = None
    ) -> Float[Tensor, "b t d"]:
        """Let every token of `x` read all of them."""
        q, k, v = self._heads(self.to_qkv(x), 3)
        return self._read(q, k, v, bias)

    def across(
        self, x: Float[Tensor, "b q d"], context: Float[Tensor, "b t d"]
    ) -> Float[Tensor, "b q d"]:
        """Let every token of `x` read `context`."""
        inner = self.to_out.in_features
        (q,) = self._heads(functional.linear(x, self.to_qkv.weight[:inner]), 1)
        k, v = self._heads(functional.linear(context, self.to_qkv.weight[inner:]), 2)
        return self._read(q, k, v, None)

    def _heads(self, projected: Float[Tensor, "b t _"], parts: int) -> tuple[Tensor, ...]:
        pattern = "b t (parts h d) -> parts b h t d"
        return rearrange(projected, pattern, parts=parts, h=self.heads).unbind()

    def _read(self, q: Tensor, k: Tensor, v: Tensor, bias: Tensor | None) -> Tensor:
        dropout = self.dropout if self.training else 0.0
        read = attend(q, k, v, bias=bias, dropout=dropout)
        return self.to_out(rearrange(read, "b h q d -> b q (h d)"))


class FeedForward(nn.Module):
    """GEGLU: one half of the hidden units gates the other."""

    def __init__(self, sizes: BlockSizes) -> None:
        """Rise to twice `hidden`, gate, fall back to the width."""
        super().__init__()
        self.rise = nn.Linear(sizes.width, 2 * sizes.hidden)
        self.fall = nn.Linear(sizes.hidden, sizes.width)

    def forward(self, x: Float[Tensor, "b t d"]) -> Float[Tensor, "b t d"]:
        """Two linear layers with the gate between them."""
        return self.fall(_Gated.apply(self.rise(x)))


class _Gated(torch.autograd.Function):
    """One half of the channels times the GELU of the other.

    On the way back both halves are written where they belong; autograd would make each on its own
    and then join them, a copy of the network's largest tensors.
    """

    @staticmethod
    def forward(ctx: Any, halves: Tensor) -> Tensor:
        value, gate = halves.chunk(2, dim=-1)
        passed = functional.gelu(gate)
        ctx.save_for_backward(halves, passed)
        return value * passed

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        halves, passed = ctx.saved_tensors
        value, gate = halves.chunk(2, dim=-1)
        gradient = torch.empty_like(halves)
        to_value, to_gate = gradient.chunk(2, dim=-1)
        torch.mul(gradients[0], passed, out=to_value)
        torch.mul(gradients[0], value, out=to_gate)
        to_gate.copy_(torch.ops.aten.gelu_backward(to_gate, gate))
        return gradient


class SelfBlock(nn.Module):
    """Pre-norm self-attention and feed-forward, each with a residual."""

    def __init__(self, sizes: BlockSizes) -> None:
        """Fresh weights."""
        super().__init__()
        self.norm_attention = nn.LayerNorm(sizes.width)
        self.attention = Attention(sizes)
        self.norm_hidden = nn.LayerNorm(sizes.width)
        self.feed_forward = FeedForward(sizes)

    def forward(
        self, x: Float[Tensor, "b t d"], bias: Float[Tensor, "b 1 1 t"] | None = None
    ) -> Float[Tensor, "b t d"]:
        """Mix the tokens of `x`."""
        x = x + self.attention(self.norm_attention(x), bias)
        return x + self.feed_forward(self.norm_hidden(x))


class CrossBlock(nn.Module):
    """Pre-norm cross-attention and feed-forward: queries read a context that stays as it is."""

    def __init__(self, sizes: BlockSizes) -> None:
        """Fresh weights."""
        super().__init__()
        self.norm_query = nn.LayerNorm(sizes.width)
        self.norm_context = nn.LayerNorm(sizes.width)
        self.attention = Attention(sizes)
        self.norm_hidden = nn.LayerNorm(sizes.width)
        self.feed_forward = FeedForward(sizes)

    def forward(
        self, queries: Float[Tensor, "b q d"], context: Float[Tensor, "b t d"]
    ) -> Float[Tensor, "b q d"]:
        """Update the queries from the context."""
        read = self.attention.across(self.norm_query(queries), self.norm_context(context))
        queries = queries + read
        return queries + self.feed_forward(self.norm_hidden(queries))


def init_leaky(layer: nn.Linear | nn.Conv2d) -> None:
    """Kaiming-uniform weights for a layer followed by LeakyReLU; zero bias."""
    nn.init.kaiming_uniform_(layer.weight, a=LEAK, nonlinearity="leaky_relu")
    if layer.bias is not None:
        nn.init.zeros_(layer.bias)


def init_plain(layer: nn.Linear | nn.Conv2d) -> None:
    """Xavier-uniform weights for a layer without activation; zero bias."""
    nn.init.xavier_uniform_(layer.weight)
    if layer.bias is not None:
        nn.init.zeros_(layer.bias)


def linear(fan_in: int, fan_out: int) -> nn.Linear:
    """A linear layer without activation, Xavier-initialised."""
    layer = nn.Linear(fan_in, fan_out)
    init_plain(layer)
    return layer


class NormedLinear(nn.Module):
    """Linear, GroupNorm over four groups of its channels, LeakyReLU; each row on its own."""

    def __init__(self, fan_in: int, fan_out: int) -> None:
        """Kaiming-initialised; `fan_out` must be a multiple of four."""
        super().__init__()
        self.linear = nn.Linear(fan_in, fan_out)
        init_leaky(self.linear)
        self.norm = nn.GroupNorm(4, fan_out)

    def forward(self, x: Float[Tensor, "*rows d"]) -> Float[Tensor, "*rows e"]:
        """Project the last axis; statistics never mix over rows."""
        y = self.linear(x)
        # GroupNorm reads (rows, channels): a token axis would otherwise count as channels.
        return functional.leaky_relu(self.norm(y.flatten(0, -2)).view_as(y), LEAK)


def mlp(sizes: tuple[int, ...]) -> nn.Sequential:
    """Linear layers with ReLU between them, PyTorch's default initialisation."""
    layers: list[nn.Module] = []
    for fan_in, fan_out in pairwise(sizes):
        layers += [nn.Linear(fan_in, fan_out), nn.ReLU()]
    return nn.Sequential(*layers[:-1])
