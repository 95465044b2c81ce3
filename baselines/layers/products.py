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
from torch.autograd.function import once_differentiable
from torch.nn import functional
from torch.overrides import TorchFunctionMode

WORTHWHILE = 2**20
"""Multiplications from which a product is faster here: oneDNN takes some 10 us to set one up."""


def _onednn() -> Callable[..., Tensor] | None:
    """What PyTorch's compiler calls for a linear layer.

    None where this build has none, or one with other arguments: it is not part of PyTorch's API.
    """
    one = torch.ones(1, 1)
    try:
        linear = getattr(torch.ops.mkldnn, "_linear_pointwise")  # noqa: B009 (private: SLF001)
        linear(one, one, None, "none", [], "")
    except (AttributeError, RuntimeError, TypeError):
        return None
    return linear


ONEDNN = _onednn()


def product(
    x: Float[Tensor, "*rows k"],
    weight: Float[Tensor, "n k"],
    bias: Float[Tensor, "n"] | None = None,
) -> Float[Tensor, "*rows n"]:
    """`x @ weight.T + bias`, outside of autograd; all of them may be views."""
    if ONEDNN is None or not _fits(x, weight, bias):
        return functional.linear(x, weight, bias)
    bias = bias if bias is None else bias.contiguous()
    return ONEDNN(_packed(x), _packed(weight), bias, "none", [], "")


def _fits(x: Tensor, weight: Tensor, bias: Tensor | None) -> bool:
    """Matrices, large enough, of 32-bit numbers on a CPU; what is wrong is left to PyTorch."""
    factors = (x, weight) if bias is None else (x, weight, bias)
    return (
        {(factor.dtype, factor.device.type) for factor in factors} == {(torch.float32, "cpu")}
        and x.ndim > 1
        and weight.ndim == 2
        and x.shape[-1] == weight.shape[1]
        and (bias is None or bias.shape == weight.shape[:1])
        and x.numel() * len(weight) >= WORTHWHILE
    )


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
    @once_differentiable
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
    """Inside, linear layers of 32-bit numbers on a CPU take `product` while gradients are kept."""

    def __torch_function__(
        self,
        func: Callable[..., Any],
        types: Sequence[type],
        args: tuple[Any, ...] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> Any:
        """Called by torch in place of each of its functions."""
        if func is functional.linear:
            return _linear(*args, **(kwargs or {}))
        return func(*args, **(kwargs or {}))


def _linear(input: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    rough = torch.is_autocast_enabled(input.device.type)
    if rough or not torch.is_grad_enabled() or not _fits(input, weight, bias):
        return functional.linear(input, weight, bias)
    return _Linear.apply(input, weight, bias)
