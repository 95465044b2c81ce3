"""Size-Aware Dynamic Query Transformer (paper section 3.4).

A few learnt query tokens read the visual tokens through cross-attention. Image-Text Contrast
looks at them after the first block, when they have seen neither words nor proprioception; then
the instruction is added to every query and they read again.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from baselines.layers.attention import BlockSizes, CrossBlock

QUERY_STD = 0.02
"""Spread of the initial queries (D-queries). They must differ: equal queries get equal gradients
for ever."""


@dataclass(frozen=True)
class Read:
    """What the queries found in the image."""

    contrasted: Float[Tensor, "b d"]
    """Their mean where Image-Text Contrast reads."""

    queries: Float[Tensor, "b q d"]
    """The queries that enter the joint layers."""


class SizeAwareQueries(nn.Module):
    """Queries, two cross-attention blocks, and the instruction between them or before them."""

    def __init__(
        self,
        sizes: BlockSizes,
        *,
        queries: int,
        instruction_enters: Literal["after_contrast", "before_contrast"],
    ) -> None:
        """`instruction_enters` says on which side of Image-Text Contrast."""
        super().__init__()
        self.instruction_enters = instruction_enters
        self.initial = nn.Parameter(torch.randn(1, queries, sizes.width) * QUERY_STD)
        self.first = CrossBlock(sizes)
        self.second = CrossBlock(sizes)

    def forward(self, tokens: Float[Tensor, "b t d"], instruction: Float[Tensor, "b d"]) -> Read:
        """Read the visual tokens twice; `instruction` is the projected sentence vector."""
        queries, words = self.initial.expand(len(tokens), -1, -1), instruction[:, None]
        if self.instruction_enters == "before_contrast":
            queries = queries + words
        queries = self.first(queries, tokens)
        contrasted = queries.mean(dim=1)
        if self.instruction_enters == "after_contrast":
            queries = queries + words
        return Read(contrasted=contrasted, queries=self.second(queries, tokens))
