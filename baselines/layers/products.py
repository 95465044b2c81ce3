"""Matrix products of 32-bit numbers at a CPU's full width.

PyTorch asks MKL for them, which uses half of the vector's width on processors other than Intel's;
the oneDNN inside PyTorch, which makes its convolutions, uses all of it: 230 GFLOP/s instead of 105
on one core of a Zen 5. Sums have another order, so the last bits differ; training may go this
way, evaluation keeps the bits its published episodes were played with.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional
from torch.overrides import TorchFunctionMode


def _onednn() -> Callable[..., Tensor] | None:
    """What PyTorch's compiler calls for a linear layer; None where this build has none of it."""
    if not torch.backends.mkldnn.is_available():
        return None
    return getattr(torch.ops.mkldnn, "_linear_pointwise", None)


ONEDNN = _onednn()


def product(
    x: Float[Tensor, "*rows k"],
    weight: Float[Tensor, "n k"],
    bias: Float[Tensor, "n"] | None = None,
) -> Float[Tensor, "*rows n"]:
    """`x @ weight.T + bias`, outside of autograd; either factor may be a transposed view."""
    if ONEDNN is None or not _fits(x, weight):
        return functional.linear(x, weight, bias)
    return ONEDNN(_packed(x), _packed(weight), bias, "none", [], "")


def _fits(x: Tensor, weight: Tensor) -> bool:
    """Matrices of 32-bit numbers on a CPU, with something in them."""
    kinds = {(factor.dtype, factor.device.type) for factor in (x, weight)}
    return kinds == {(torch.float32, "cpu")} and x.ndim > 1 and x.numel() > 0


def _packed(x: Tensor) -> Tensor:
    """Without gaps or repetitions: expanded factors take oneDNN's slowest path."""
    return x if x.is_contiguous() or x.mT.is_contiguous() else x.contiguous()


def over_rows(x: Float[Tensor, "rows n"], y: Float[Tensor, "rows k"]) -> Float[Tensor, "n k"]:
    """`x.T @ y`. oneDNN copies the first factor of such a product, so let that be the smaller."""
    if x.shape[1] > y.shape[1]:
        return product(y.mT, x.mT).mT
    return product(x.mT, y.mT)


class _Linear(torch.autograd.Function):
    """A linear layer whose three products are `product`s."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
        ctx.save_for_backward(x, weight)
        return product(x, weight, bias)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        x, weight = ctx.saved_tensors
        gradient = gradients[0]
        rows = gradient.reshape(-1, gradient.shape[-1])
        for_x, for_weight, for_bias = ctx.needs_input_grad
        return (
            product(gradient, weight.mT) if for_x else None,
            over_rows(rows, x.reshape(-1, x.shape[-1])) if for_weight else None,
            rows.sum(0) if for_bias else None,
        )


class FullWidth(TorchFunctionMode):
    """Inside, every linear layer that learns in 32 bits on a CPU takes `product`."""

    def __torch_function__(
        self,
        func: Callable[..., Any],
        types: Sequence[type],
        args: tuple[Any, ...] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> Any:
        """Called by torch in place of each of its functions."""
        if func is functional.linear and _learns(*args, **(kwargs or {})):
            return _linear(*args, **(kwargs or {}))
        return func(*args, **(kwargs or {}))


def _learns(input: Tensor, weight: Tensor, bias: Tensor | None = None) -> bool:
    rough = torch.is_autocast_enabled(input.device.type)
    return torch.is_grad_enabled() and not rough and _fits(input, weight)


def _linear(input: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    return _Linear.apply(input, weight, bias)
