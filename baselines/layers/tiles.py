"""Attention with dropout on its probabilities, for a CPU.

PyTorch's fused kernel knows no dropout there: it falls back to whole matrices of scores and keeps
several of them for the way back. Here scores exist a tile at a time, small enough for the cache,
and are made again on the way back (Dao et al., FlashAttention, NeurIPS 2022).
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from baselines.layers.products import product
from baselines.scene.compiled import compiled

TILE = 2**18
"""Scores in a tile, at most: one MB."""

MANY = 2**15
"""Scores of a head from which it has tiles of its own; smaller ones share them."""

MIXERS = (np.uint32(0x21F0AAAD), np.uint32(0x735A2D97), np.uint32(0x846CA68B))
"""Odd numbers that mix the bits of a 32-bit integer by multiplication (Wellons' prospector)."""

STRIDE = np.uint32(0x9E3779B9)
"""Between neighbours, before mixing: 2**32 over the golden ratio."""


def attend_with_loss(
    q: Float[Tensor, "b h q d"],
    k: Float[Tensor, "b h t d"],
    v: Float[Tensor, "b h t d"],
    *,
    bias: Float[Tensor, "b 1 1 t"] | None,
    dropout: float,
) -> Float[Tensor, "b h q d"]:
    """Softmax attention that loses probabilities; gradients reach all but `bias`.

    Draws one number from torch's global generator.
    """
    if bias is None:
        bias = q.new_zeros(len(q), 1, 1, k.shape[2])
    rows = bias.to(q.dtype)[:, 0].expand(-1, q.shape[1], -1).flatten(0, 1)[:, None]
    seed = int(torch.randint(2**62, ()))
    heads = [x.flatten(0, 1) for x in (q * q.shape[-1] ** -0.5, k, v)]
    return _Attention.apply(*heads, rows, dropout, seed).view(*q.shape[:3], v.shape[-1])


def lose(
    probabilities: Float[Tensor, "..."], dropout: float, seed: int, first: int = 0
) -> Float[Tensor, "..."]:
    """Set a share of `dropout` of them to 0, in place: contiguous, 32 or 64 bits, on a CPU.

    Which ones are lost is a function of the seed (64 bits) and of their numbers, counted from
    `first` modulo 2**32; both passes ask for it tile by tile.
    """
    low, high = np.uint32(seed & 2**32 - 1), np.uint32(seed >> 32)
    limit = np.uint32(min(round(dropout * 2**32), 2**32 - 1))
    _lose(probabilities.view(-1).numpy(), limit, low, high, first)
    return probabilities


@compiled
def _lose(
    probabilities: np.ndarray, limit: np.uint32, low: np.uint32, high: np.uint32, first: int
) -> None:
    """A hash of each number decides: unlike PyTorch's CPU generator it can begin at any tile."""
    one, two, three = MIXERS
    for i in range(len(probabilities)):
        bits = np.uint32(np.uint32(first + i) * STRIDE + low)
        bits = np.uint32(np.uint32((bits ^ bits >> np.uint32(16)) * one) + high)
        bits = np.uint32((bits ^ bits >> np.uint32(15)) * two)
        bits = np.uint32((bits ^ bits >> np.uint32(15)) * three)
        stays = np.uint32(bits ^ bits >> np.uint32(16)) >= limit
        probabilities[i] = probabilities[i] if stays else probabilities.dtype.type(0)


def _tiles(heads: int, queries: int, keys: int) -> Iterator[tuple[slice, slice, int]]:
    """Heads and queries of each tile, and the number of its first score."""
    many = max(1, MANY // (queries * keys))
    rows = max(1, TILE // keys)
    for head in range(0, heads, many):
        for row in range(0, queries, rows):
            yield slice(head, head + many), slice(row, row + rows), (head * queries + row) * keys


def _each(x: Float[Tensor, "n q d"], y: Float[Tensor, "n k d"]) -> Float[Tensor, "n q k"]:
    """`x @ y.T` of each head."""
    return product(x[0], y[0])[None] if len(x) == 1 else x @ y.mT


class _Attention(torch.autograd.Function):
    """Queries come scaled. Both passes lose the same probabilities."""

    @staticmethod
    def forward(
        ctx: Any, q: Tensor, k: Tensor, v: Tensor, bias: Tensor, dropout: float, seed: int
    ) -> Tensor:
        out = q.new_empty(*q.shape[:2], v.shape[-1])
        for n, rows, first in _tiles(q.shape[0], q.shape[1], k.shape[1]):
            weights = _each(q[n, rows], k[n]).add_(bias[n]).softmax(-1)
            out[n, rows] = _each(lose(weights, dropout, seed, first), v[n].mT)
        ctx.save_for_backward(q, k, v, bias, out.div_(1 - dropout))
        ctx.dropout, ctx.seed = dropout, seed
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        q, k, v, bias, out = ctx.saved_tensors
        share = (gradients[0] * out).sum(-1, keepdim=True)
        gradient = gradients[0] / (1 - ctx.dropout)
        to_q, to_k, to_v = torch.empty_like(q), torch.zeros_like(k), torch.zeros_like(v)
        for n, rows, first in _tiles(q.shape[0], q.shape[1], k.shape[1]):
            weights = _each(q[n, rows], k[n]).add_(bias[n]).softmax(-1)
            to_weights = lose(_each(gradient[n, rows], v[n]), ctx.dropout, ctx.seed, first)
            to_scores = to_weights.sub_(share[n, rows]).mul_(weights)
            left = lose(weights, ctx.dropout, ctx.seed, first)
            # The longer factor comes last: see `products.over_rows`.
            to_v[n] += _each(gradient[n, rows].mT, left.mT).mT
            to_q[n, rows] = _each(to_scores, k[n].mT)
            to_k[n] += _each(q[n, rows].mT, to_scores.mT).mT
        return to_q, to_k, to_v, None, None, None
