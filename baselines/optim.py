"""LAMB, the warm-up and cosine schedule, and the weight average.

LAMB (You et al., ICLR 2020) in the form the RVT family trains with: no bias correction, weight
norms clamped, one parameter group. State lives in plain tensors keyed by parameter name, so that
a training state is a flat, pickle-free file.
"""

import math
from collections.abc import Mapping
from typing import TypeAlias

import torch
from torch import Tensor, nn

TensorTable: TypeAlias = dict[str, Tensor]


class Lamb:
    """Layer-wise adaptive moments; every tensor's step is scaled to the norm of its weights."""

    betas = (0.9, 0.999)
    eps = 1e-6
    max_weight_norm = 10.0

    def __init__(self, network: nn.Module, *, weight_decay: float) -> None:
        """Optimise all trainable parameters of `network`."""
        self.weight_decay = weight_decay
        self.parameters = {n: p for n, p in network.named_parameters() if p.requires_grad}
        self.mean = {n: torch.zeros_like(p) for n, p in self.parameters.items()}
        self.square = {n: torch.zeros_like(p) for n, p in self.parameters.items()}

    @torch.no_grad()
    def step(self, lr: float) -> None:
        """Update the weights from their gradients, then clear the gradients.

        A parameter that took no part in this step's loss is left alone.
        """
        # One tensor at a time: its eight passes then stay in the cache, which on one core beats
        # torch's foreach kernels (one pass over all tensors after another).
        for name, weight in self.parameters.items():
            if weight.grad is not None:
                update = self._update(name, weight, weight.grad)
                weight.add_(update, alpha=-lr * self._trust_ratio(weight, update))
                weight.grad = None

    def _update(self, name: str, weight: Tensor, gradient: Tensor) -> Tensor:
        beta_mean, beta_square = self.betas
        mean, square = self.mean[name], self.square[name]
        mean.lerp_(gradient, 1 - beta_mean)
        square.mul_(beta_square).addcmul_(gradient, gradient, value=1 - beta_square)
        return (mean / square.sqrt().add_(self.eps)).add_(weight, alpha=self.weight_decay)

    def _trust_ratio(self, weight: Tensor, update: Tensor) -> float:
        weight_norm = min(float(weight.norm()), self.max_weight_norm)
        update_norm = float(update.norm())
        # Zero-initialised tensors start with a plain step.
        return weight_norm / update_norm if weight_norm and update_norm else 1.0


def learning_rate(step: int, *, total: int, peak: float, warmup: int) -> float:
    """Learning rate of `step` (from 0): linear warm-up, then a cosine towards a hundredth.

    As in RVT the cosine's period is the whole run, so the last step stays a little above the
    floor. A run too short for `warmup` spends a tenth of its steps on it (D-recipe).
    """
    warmup = min(warmup, max(1, total // 10))
    if step < warmup:
        return peak * (step + 1) / warmup
    floor = peak / 100
    progress = (step + 1 - warmup) / total
    return floor + (peak - floor) * (1 + math.cos(math.pi * progress)) / 2


class Ema:
    """Exponential average of a network's weights (D-average): what is saved and evaluated."""

    def __init__(self, network: nn.Module, *, decay: float) -> None:
        """Start at the weights `network` has now."""
        self.decay = decay
        self._weights = dict(network.named_parameters())
        self.average = {n: w.detach().clone() for n, w in self._weights.items()}

    @torch.no_grad()
    def update(self, step: int) -> None:
        """Move towards the weights after `step` (from 0).

        The decay warms up, or a short run would keep its initial weights.
        """
        decay = min(self.decay, (1 + step) / (10 + step))
        torch._foreach_lerp_(list(self.average.values()), list(self._weights.values()), 1 - decay)

    def weights(self, network: nn.Module) -> TensorTable:
        """State of `network` with the averages in place of its parameters (buffers as they are)."""
        return {n: t.detach() for n, t in network.state_dict().items()} | self.average


def copy_into(target: Mapping[str, Tensor], source: Mapping[str, Tensor]) -> None:
    """Overwrite the values of `target` with those of `source`.

    Raises:
        ValueError: names, shapes or types differ; nothing was overwritten.
    """
    kinds = [{n: (t.shape, t.dtype) for n, t in tensors.items()} for tensors in (target, source)]
    if different := sorted(n for n, _ in kinds[0].items() ^ kinds[1].items()):
        raise ValueError(f"other tensors: {', '.join(different)}")
    with torch.no_grad():
        for name, tensor in target.items():
            tensor.copy_(source[name])
