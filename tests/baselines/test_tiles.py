"""Attention tile by tile against whole matrices of scores."""

import pytest
import torch

from baselines.layers import tiles
from baselines.layers.attention import padding_bias

DROPOUT = 0.25


def made(queries: int = 7, keys: int = 9) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    shapes = [(2, 3, count, 4) for count in (queries, keys, keys)]
    return [torch.randn(s, generator=generator).double().requires_grad_() for s in shapes]


def bias() -> torch.Tensor:
    return padding_bias(torch.arange(9) < torch.tensor([[9], [5]]))


def whole(q: torch.Tensor, k: torch.Tensor, v: torch.Tensor, seed: int) -> torch.Tensor:
    """The same with every score in memory."""
    weights = (q @ k.mT / q.shape[-1] ** 0.5 + bias().double()).softmax(-1)
    stays = tiles.lose(torch.ones_like(weights), DROPOUT, seed)
    return weights * stays / (1 - DROPOUT) @ v


@pytest.mark.parametrize("many", [1, 130, tiles.MANY])
def test_values_and_gradients_are_those_of_whole_matrices(
    many: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tiles, "MANY", many)
    inputs = made()
    torch.manual_seed(1)
    found = tiles.attend_with_loss(*inputs, bias=bias(), dropout=DROPOUT)
    torch.manual_seed(1)
    expected = whole(*inputs, int(torch.randint(2**62, ())))
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)
    direction = torch.randn_like(found)
    pairs = [torch.autograd.grad(out, inputs, direction) for out in (found, expected)]
    for ours, theirs in zip(*pairs, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("tile", "many"), [(1, 1), (9, 1), (20, 1), (63, 1), (130, 130)])
def test_gradients_are_right_for_any_tile(
    tile: int, many: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tiles, "TILE", tile)
    monkeypatch.setattr(tiles, "MANY", many)

    def attend(*inputs: torch.Tensor) -> torch.Tensor:
        torch.manual_seed(2)
        return tiles.attend_with_loss(*inputs, bias=bias(), dropout=DROPOUT)

    assert torch.autograd.gradcheck(attend, made(), fast_mode=True)


def test_nearly_all_can_be_lost() -> None:
    assert tiles.lose(torch.ones(1000), 1 - 2**-40, seed=0).sum() == 0


@pytest.mark.parametrize("dropout", [0.1, 0.5])
def test_as_many_are_lost_as_asked_for(dropout: float) -> None:
    gone = 1 - tiles.lose(torch.ones(1000, 997), dropout, seed=2**61 + 1)
    for means in (gone.mean(0), gone.mean(1)):
        assert means.mean() == pytest.approx(dropout, abs=2e-3)
        assert means.std() == pytest.approx((dropout * (1 - dropout) / 997) ** 0.5, rel=0.1)


@pytest.mark.parametrize("seed", [0, 5, 2**40])
@pytest.mark.parametrize("change", [1, 2**32, 2**61])
def test_what_is_lost_does_not_follow_from_neighbours_or_from_another_seed(
    seed: int, change: int
) -> None:
    first, other = (tiles.lose(torch.ones(200_000), 0.1, s) for s in (seed, seed + change))
    shifted = [first.roll(by) for by in (1, 2, 16, 777)]
    for others in (other, *shifted):
        correlation = torch.corrcoef(torch.stack([first, others]))[0, 1]
        assert abs(correlation) < 0.01


def test_without_loss_it_is_attention() -> None:
    inputs = made()
    found = tiles.attend_with_loss(*inputs, bias=None, dropout=0.0)
    expected = torch.nn.functional.scaled_dot_product_attention(*inputs)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)
