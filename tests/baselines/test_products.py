"""Products at full width against 64-bit ones, and who takes them."""

import copy

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional

from baselines.layers import products
from baselines.layers.products import FullWidth, over_rows, product


def drawn(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


FACTORS = {
    "rows": lambda: drawn(7, 5),
    "batches": lambda: drawn(2, 3, 5),
    "transposed": lambda: drawn(5, 7).mT,
    "expanded": lambda: drawn(1, 5).expand(7, 5),
    "expanded batches": lambda: drawn(5).expand(2, 3, 5),
    "every other": lambda: drawn(7, 10)[:, ::2],
    "none": lambda: drawn(0, 5),
}

BIASES = {
    "none": lambda: None,
    "whole": lambda: drawn(4, seed=2),
    "every other": lambda: drawn(8, seed=2)[::2],
    "expanded": lambda: drawn(1, seed=2).expand(4),
}


@pytest.fixture(params=["onednn", "torch"], autouse=True)
def library(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(products, "WORTHWHILE", 1)  # however small
    if request.param == "torch":
        monkeypatch.setattr(products, "ONEDNN", None)
    elif products.ONEDNN is None:
        pytest.skip("this PyTorch has no oneDNN")


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("addend", BIASES)
@pytest.mark.parametrize("name", FACTORS)
def test_product_is_the_exact_one_whatever_lies_where(
    name: str, addend: str, dtype: torch.dtype
) -> None:
    x, bias = FACTORS[name]().to(dtype), BIASES[addend]()
    bias = bias if bias is None else bias.to(dtype)
    for weight in (drawn(4, 5, seed=1).to(dtype), drawn(5, 4, seed=1).to(dtype).mT):
        exact = x.double() @ weight.double().mT + (0 if bias is None else bias.double())
        torch.testing.assert_close(product(x, weight, bias).double(), exact, rtol=0, atol=1e-5)


@pytest.mark.parametrize("shapes", [((9, 3), (9, 6)), ((9, 6), (9, 3)), ((1, 4), (1, 4))])
def test_sums_over_rows_are_exact(shapes: tuple[tuple[int, int], tuple[int, int]]) -> None:
    x, y = drawn(*shapes[0]), drawn(*shapes[1], seed=1)
    exact = x.double().mT @ y.double()
    torch.testing.assert_close(over_rows(x, y).double(), exact, rtol=0, atol=1e-5)


LAYERS = {
    "biased": lambda: nn.Linear(5, 4),
    "unbiased": lambda: nn.Linear(5, 4, bias=False),
    "frozen": lambda: nn.Linear(5, 4).requires_grad_(False),  # noqa: FBT003
}


@pytest.mark.parametrize("kind", LAYERS)
@pytest.mark.parametrize("name", FACTORS)
def test_layers_learn_the_same(name: str, kind: str) -> None:
    layer = LAYERS[kind]()
    x = FACTORS[name]().requires_grad_()
    wanted = [x, *(p for p in layer.parameters() if p.requires_grad)]
    with FullWidth():
        found = torch.autograd.grad(layer(x).square().sum(), wanted)
    exact_layer, exact_x = copy.deepcopy(layer).double(), x.detach().double().requires_grad_()
    exact = [exact_x, *(p for p in exact_layer.parameters() if p.requires_grad)]
    exact = torch.autograd.grad(exact_layer(exact_x).square().sum(), exact)
    for ours, theirs in zip(found, exact, strict=True):
        torch.testing.assert_close(ours.double(), theirs, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize(
    ("x", "weight", "bias"),
    [
        (drawn(5), drawn(4, 5), None),
        (drawn(7, 5), drawn(5), None),
        (drawn(7, 5), drawn(4, 5), drawn(1)),
        (drawn(7, 5), drawn(4, 5), drawn(7, 4)),
        (drawn(7, 0), drawn(4, 0), drawn(4)),
        (drawn(7, 5), drawn(0, 5), None),
    ],
)
def test_unusual_shapes_are_left_to_torch(x: Tensor, weight: Tensor, bias: Tensor | None) -> None:
    expected = functional.linear(x, weight.requires_grad_(), bias)
    with FullWidth():
        assert torch.equal(functional.linear(x, weight, bias), expected)
    with FullWidth(), pytest.raises(RuntimeError, match="shape"):
        functional.linear(drawn(7, 5), drawn(4, 6).requires_grad_())


def test_gradients_of_gradients_are_refused() -> None:
    layer, x = nn.Linear(5, 4), drawn(7, 5).requires_grad_()
    with FullWidth():
        (gradient,) = torch.autograd.grad(layer(x).tanh().sum(), x, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        gradient.square().sum().backward()


def test_small_products_are_left_to_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(products, "WORTHWHILE", 7 * 5 * 4 + 1)
    monkeypatch.setattr(products, "ONEDNN", None if products.ONEDNN is None else pytest.fail)
    product(drawn(7, 5), drawn(4, 5))


def test_only_layers_that_learn_in_32_bits_take_them(monkeypatch: pytest.MonkeyPatch) -> None:
    taken: list[torch.Size] = []

    def counted(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
        taken.append(x.shape)
        return x @ weight.mT

    monkeypatch.setattr(products, "product", counted)
    layer, x = nn.Linear(5, 4), drawn(7, 5).requires_grad_()
    with FullWidth():
        layer(x).sum().backward()
        assert len(taken) == 3, "forward, and the gradients of both factors"
        with torch.no_grad():
            layer(x)
        with torch.autocast("cpu", torch.bfloat16):
            layer(x)
        layer.double()(x.double())
    layer.float()(x)
    assert len(taken) == 3
