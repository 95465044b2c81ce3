"""Attention with dropout on its probabilities, for a CPU.

PyTorch's fused kernel knows no dropout there: it falls back to whole matrices of scores and keeps
several of them for the way back. Here scores exist a tile at a time, small enough for the cache,
and are made again on the way back (Dao et al., FlashAttention, NeurIPS 2022).
"""

from collections.abc import Iterator
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

TILE = 2**17
"""Scores in a tile: half a MB."""

BITS = 16
"""Random bits that decide on one probability; its chance of loss is rounded to so many."""


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


def kept(like: Float[Tensor, "..."], dropout: float, generator: torch.Generator) -> Tensor:
    """1 where a probability stays, 0 where it is lost; `BITS` random bits each."""
    count = like.numel()
    bits = torch.empty(-(-count // (64 // BITS)), dtype=torch.int64)
    numbers = bits.random_(-(2**63), None, generator=generator).view(torch.int16)
    stays = numbers[:count] >= round(dropout * 2**BITS) - 2 ** (BITS - 1)
    # As numbers: multiplying by them is many times faster than masking.
    return stays.to(like.dtype).view(like.shape)


def _tiles(heads: int, queries: int, keys: int) -> Iterator[tuple[slice, slice]]:
    """Heads and queries of each tile: some whole heads, or a part of one."""
    many = max(1, TILE // (queries * keys))
    rows = max(1, TILE // keys)
    for head in range(0, heads, many):
        for row in range(0, queries, rows):
            yield slice(head, head + many), slice(row, row + rows)


class _Attention(torch.autograd.Function):
    """Queries come scaled. Both passes draw the same losses, in the same order."""

    @staticmethod
    def forward(
        ctx: Any, q: Tensor, k: Tensor, v: Tensor, bias: Tensor, dropout: float, seed: int
    ) -> Tensor:
        generator = torch.Generator().manual_seed(seed)
        out = q.new_empty(*q.shape[:2], v.shape[-1])
        for n, rows in _tiles(q.shape[0], q.shape[1], k.shape[1]):
            weights = (q[n, rows] @ k[n].mT).add_(bias[n]).softmax(-1)
            weights.mul_(kept(weights, dropout, generator))
            out[n, rows] = (weights @ v[n]).div_(1 - dropout)
        ctx.save_for_backward(q, k, v, bias, out)
        ctx.dropout, ctx.seed = dropout, seed
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        q, k, v, bias, out = ctx.saved_tensors
        generator = torch.Generator().manual_seed(ctx.seed)
        share = (gradients[0] * out).sum(-1, keepdim=True)
        gradient = gradients[0] / (1 - ctx.dropout)
        to_q, to_k, to_v = torch.empty_like(q), torch.zeros_like(k), torch.zeros_like(v)
        for n, rows in _tiles(q.shape[0], q.shape[1], k.shape[1]):
            weights = (q[n, rows] @ k[n].mT).add_(bias[n]).softmax(-1)
            stays = kept(weights, ctx.dropout, generator)
            to_weights = (gradient[n, rows] @ v[n].mT).mul_(stays)
            to_scores = to_weights.sub_(share[n, rows]).mul_(weights)
            to_v[n].baddbmm_(weights.mul_(stays).mT, gradient[n, rows])
            to_q[n, rows] = to_scores @ k[n]
            to_k[n].baddbmm_(to_scores.mT, q[n, rows])
        return to_q, to_k, to_v, None, None, None
