"""Products at full width against 64-bit ones, and who takes them."""

import pytest
import torch
from torch import Tensor, nn

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


@pytest.fixture(params=["onednn", "torch"], autouse=True)
def library(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if request.param == "torch":
        monkeypatch.setattr(products, "ONEDNN", None)
    elif products.ONEDNN is None:
        pytest.skip("this PyTorch has no oneDNN")


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("bias", [None, drawn(4, seed=2)], ids=["", "biased"])
@pytest.mark.parametrize("name", FACTORS)
def test_product_is_the_exact_one_whatever_lies_where(
    name: str, bias: Tensor | None, dtype: torch.dtype
) -> None:
    x, bias = FACTORS[name]().to(dtype), bias if bias is None else bias.to(dtype)
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
    exact = torch.autograd.grad(layer(x).square().sum(), wanted)
    with FullWidth():
        found = torch.autograd.grad(layer(x).square().sum(), wanted)
    for ours, theirs in zip(found, exact, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-4)


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
