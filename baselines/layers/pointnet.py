"""Layers of a point network: set abstraction, feature propagation, and a decoder layer.

As in PointNeXt-S (Qian et al., NeurIPS 2022) and PolarNet (Chen et al., CoRL 2023). A stage's
points are a prefix of the stage's before (`baselines.scene.points`), so nothing is searched here.
Where a linear layer reads gathered points it is applied before they are gathered: the same numbers
for a fraction of the products.
"""

from typing import Any, Literal, TypeAlias

import torch
from einops import rearrange
from jaxtyping import Float, Int32
from torch import Tensor, nn
from torch.nn import functional

from baselines.layers.attention import attend

Norm: TypeAlias = Literal["batch", "layer"]
"""`batch`: as published; `layer`: rows of a batch stay apart (D-polarnet-norm)."""

EPS = 1e-12
"""Of the decoder's layer norms."""

MOMENTUM = 0.1
"""Share of a batch in the running statistics of batch norm."""


def gathered(
    features: Float[Tensor, "b n c"], index: Int32[Tensor, "b m k"]
) -> Float[Tensor, "b m k c"]:
    """The rows of each sample that `index` names."""
    samples, points, _ = features.shape
    first = torch.arange(samples, dtype=index.dtype, device=index.device) * points
    flat = features.flatten(0, 1).index_select(0, (index + first[:, None, None]).flatten())
    return flat.view(*index.shape, features.shape[-1])


def interpolated(
    features: Float[Tensor, "b m c"],
    parents: Int32[Tensor, "b u 3"],
    shares: Float[Tensor, "b u 3"],
) -> Float[Tensor, "b n c"]:
    """Features at the points of a finer stage: kept ones as they are, then the means of parents."""
    mixed = (gathered(features, parents) * shares.to(features.dtype)[..., None]).sum(-2)
    return torch.cat([features, mixed], dim=1)


class PerRow(nn.Module):
    """Batch norm over all rows, whatever axes they are counted by."""

    def __init__(self, channels: int) -> None:
        """Learned scale and shift."""
        super().__init__()
        self.norm = nn.BatchNorm1d(channels, momentum=MOMENTUM)

    def forward(self, x: Float[Tensor, "*rows c"]) -> Float[Tensor, "*rows c"]:
        """Normalise each channel."""
        # No view where none is needed: what is done to a view in place costs two more passes.
        return self.norm(x) if x.ndim == 2 else self.norm(x.flatten(0, -2)).view_as(x)

    def strongest(
        self, x: Float[Tensor, "b m k d"], weight: Float[Tensor, "c d"]
    ) -> Float[Tensor, "b m c"]:
        """`strongest` of the normalised products of `x` and `weight`, without normalising others.

        A norm keeps the order within a channel; where its scale is negative it turns it round, so
        there the product is turned round before.
        """
        sign = torch.where(self.norm.weight.detach() < 0, -1.0, 1.0)
        best, mean, variance = _Peaks.apply(functional.linear(x, weight * sign[:, None]))
        kept = dict(self.norm.named_buffers())
        if self.training:
            count = x.shape[:-1].numel()
            kept["num_batches_tracked"].add_(1)
            news = {"mean": sign * mean, "var": count / (count - 1) * variance}
            for name, new in news.items():
                old = kept[f"running_{name}"]
                old.lerp_(new.detach().to(old.dtype), MOMENTUM)
        else:
            mean, variance = sign * kept["running_mean"], kept["running_var"]
        scale = sign * self.norm.weight * (variance + self.norm.eps).rsqrt()
        return (best - mean) * scale + self.norm.bias


class _Peaks(torch.autograd.Function):
    """The maximum over neighbours, and mean and variance over all rows.

    The way back is one pass: what reaches a row through the statistics is a line in its value.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        mean, variance = torch.batch_norm_update_stats(x.flatten(0, 2), None, None, 0.0)
        best, index = functional.max_pool2d(
            rearrange(x, "b m k c -> b c m k"), (1, x.shape[2]), return_indices=True
        )
        ctx.save_for_backward(x, mean, index)
        return rearrange(best, "b c m 1 -> b m c"), mean, variance

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        x, mean, index = ctx.saved_tensors
        to_best, to_mean, to_variance = gradients
        count = x.shape[:-1].numel()
        slope = 2 / count * to_variance
        gradient = torch.addcmul(to_mean / count - slope * mean, x, slope)
        rows = rearrange(index, "b c m 1 -> b m c")  # counted through a sample's neighbourhoods
        gradient.flatten(1, 2).scatter_add_(1, rows, to_best)
        return gradient


def point_norm(norm: Norm, channels: int) -> nn.Module:
    """Normalisation of points after a linear layer."""
    return PerRow(channels) if norm == "batch" else nn.LayerNorm(channels)


def neighbour_norm(norm: Norm, channels: int) -> nn.Module:
    """Normalisation of neighbours; with layer norm it is left to the points, of which there are
    fewer."""
    return PerRow(channels) if norm == "batch" else nn.Identity()


class SetAbstraction(nn.Module):
    """Centres take the maximum of what their neighbours say, beside what they were."""

    def __init__(self, fan_in: int, fan_out: int, *, radius: float, norm: Norm) -> None:
        """`radius` is the reach of a neighbourhood, in the unit of the positions."""
        super().__init__()
        self.radius = radius
        batch = norm == "batch"
        self.offset = nn.Linear(3, fan_in, bias=False)
        self.lift = nn.Linear(fan_in, fan_in, bias=not batch)
        self.neighbours = nn.Sequential(
            neighbour_norm(norm, fan_in),
            nn.ReLU(inplace=True),
            nn.Linear(fan_in, fan_in, bias=not batch),
            neighbour_norm(norm, fan_in),
            nn.ReLU(inplace=True),
            nn.Linear(fan_in, fan_out, bias=not batch),
            neighbour_norm(norm, fan_out),
        )
        self.skip = nn.Linear(fan_in, fan_out)
        self.norm = nn.Identity() if batch else nn.LayerNorm(fan_out)

    def forward(
        self,
        features: Float[Tensor, "b n c"],
        xyz: Float[Tensor, "b p 3"],
        near: Int32[Tensor, "b m k"],
    ) -> Float[Tensor, "b m e"]:
        """Features of the first `m` points from those of `n`; `xyz` may go on after these."""
        count = near.shape[1]
        with torch.autocast(xyz.device.type, enabled=False):  # differences of large numbers
            places = self.offset(xyz[:, : features.shape[1]] / self.radius)
        lifted = self.lift(features)
        # Added, not subtracted: the way back would negate every neighbour's gradient.
        joined = gathered(lifted + places, near) + -places[:, :count, None]
        hidden = self.neighbours[:-2](joined.flatten(0, 2).to(lifted.dtype))
        said = self._strongest(hidden.unflatten(0, near.shape)) + self.skip(features[:, :count])
        return functional.relu(self.norm(said))

    def _strongest(self, hidden: Float[Tensor, "b m k c"]) -> Float[Tensor, "b m e"]:
        """Maximum over the neighbours of the last layer, normalised."""
        last, norm = self.neighbours[-2], self.neighbours[-1]
        if isinstance(norm, PerRow):
            return norm.strongest(hidden, last.get_parameter("weight"))
        return strongest(last(hidden))


class FeaturePropagation(nn.Module):
    """Coarse features spread over the points of a finer stage and join theirs."""

    def __init__(self, coarse: int, fine: int, *, norm: Norm) -> None:
        """As many channels come out as `fine` ones go in."""
        super().__init__()
        bias = norm == "layer"
        self.coarse = nn.Linear(coarse, fine, bias=False)
        self.fine = nn.Linear(fine, fine, bias=bias)
        self.mix = nn.Sequential(
            point_norm(norm, fine),
            nn.ReLU(),
            nn.Linear(fine, fine, bias=bias),
            point_norm(norm, fine),
            nn.ReLU(),
        )

    def forward(
        self,
        coarse: Float[Tensor, "b m c"],
        fine: Float[Tensor, "b n e"],
        parents: Int32[Tensor, "b u 3"],
        shares: Float[Tensor, "b u 3"],
    ) -> Float[Tensor, "b n e"]:
        """Features of the finer stage."""
        return self.mix(interpolated(self.coarse(coarse), parents, shares) + self.fine(fine))


def strongest(x: Float[Tensor, "b m k c"]) -> Float[Tensor, "b m c"]:
    """Maximum over the neighbours; pooling passes gradients back faster than `amax` on a CPU."""
    maps = rearrange(x, "b m k c -> b c m k")  # channels last in memory
    return rearrange(functional.max_pool2d(maps, (1, x.shape[2])), "b c m 1 -> b m c")


class DecoderLayer(nn.Module):
    """Points read each other, then the words; post-norm, GELU."""

    def __init__(self, width: int, *, heads: int, hidden: int, dropout: float) -> None:
        """`heads` must divide `width`."""
        super().__init__()
        self.itself = MultiHead(width, heads=heads, dropout=dropout)
        self.words = MultiHead(width, heads=heads, dropout=dropout)
        self.feed_forward = nn.Sequential(
            nn.Linear(width, hidden), nn.GELU(), nn.Dropout(dropout), nn.Linear(hidden, width)
        )
        self.norms = nn.ModuleList(nn.LayerNorm(width, eps=EPS) for _ in range(3))
        self.dropout = nn.Dropout(dropout)

    def forward(
        self,
        x: Float[Tensor, "b n d"],
        words: Float[Tensor, "b t d"],
        padding: Float[Tensor, "b 1 1 t"],
    ) -> Float[Tensor, "b n d"]:
        """Mix the points with each other and with the words."""
        after_self, after_words, after_hidden = self.norms
        x = after_self(x + self.dropout(self.itself(x, x, None)))
        x = after_words(x + self.dropout(self.words(x, words, padding)))
        return after_hidden(x + self.dropout(self.feed_forward(x)))


class MultiHead(nn.Module):
    """Multi-head attention with biases everywhere, Xavier-initialised."""

    def __init__(self, width: int, *, heads: int, dropout: float) -> None:
        """`heads` must divide `width`."""
        super().__init__()
        self.heads, self.dropout = heads, dropout
        self.query = nn.Linear(width, width)
        self.key_value = nn.Linear(width, 2 * width)
        self.out = nn.Linear(width, width)
        for layer in (self.query, self.key_value):
            nn.init.xavier_uniform_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(
        self,
        x: Float[Tensor, "b q d"],
        context: Float[Tensor, "b t d"],
        bias: Float[Tensor, "b 1 1 t"] | None,
    ) -> Float[Tensor, "b q d"]:
        """Let every token of `x` read `context`."""
        split = "b t (parts h d) -> parts b h t d"
        q = rearrange(self.query(x), "b q (h d) -> b h q d", h=self.heads)
        k, v = rearrange(self.key_value(context), split, parts=2, h=self.heads).unbind()
        read = attend(q, k, v, bias=bias, dropout=self.dropout if self.training else 0.0)
        return self.out(rearrange(read, "b h q d -> b q (h d)"))
