"""Rotary codes: only where things lie relative to each other counts, in all three directions."""

import pytest
import torch
from torch import Tensor

from baselines.layers.attention import padding_bias
from baselines.layers.rotary import Context, Reader, turned, turns

WIDTH, HEADS, RATE, SPAN = 48, 4, 30.0, 1000.0


@pytest.fixture(autouse=True)
def _seeded() -> None:
    torch.manual_seed(0)


def context(tokens: Tensor, points_m: Tensor) -> Context:
    everything = torch.ones(tokens.shape[:2], dtype=torch.bool)
    return Context(tokens, turns(points_m, WIDTH, RATE, SPAN), padding_bias(everything))


def test_a_product_depends_on_the_displacement_alone() -> None:
    q, k = torch.randn(1, 5, WIDTH), torch.randn(1, 7, WIDTH)
    at, to, shift = torch.rand(1, 5, 3), torch.rand(1, 7, 3), torch.tensor([0.3, -0.2, 0.1])

    def products(move: Tensor) -> Tensor:
        codes = turns(at + move, WIDTH, RATE, SPAN), turns(to + move, WIDTH, RATE, SPAN)
        return turned(q, codes[0]) @ turned(k, codes[1]).transpose(-1, -2)

    torch.testing.assert_close(products(shift), products(torch.zeros(3)), rtol=0, atol=1e-4)
    plain = q @ k.transpose(-1, -2)
    assert (products(shift) - plain).abs().max() > 1
    torch.testing.assert_close(turned(q, codes := turns(at, WIDTH, RATE, SPAN)).norm(), q.norm())
    assert codes.shape == (1, 5, WIDTH // 2)


def test_angles_fall_from_the_rate_to_nearly_its_part() -> None:
    code = turns(torch.tensor([[[0.02, 0.0, 0.0]]]), WIDTH, RATE, SPAN)
    angles = code.angle()[0, 0]
    assert angles[0] == pytest.approx(0.02 * RATE)
    assert angles[1] == angles[2] == 0  # y and z
    assert (angles[0::3].diff() < 0).all()
    assert angles[0] / angles[-3] == pytest.approx(SPAN ** (7 / 8), rel=1e-4)  # 8 triples


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_every_head_sees_every_axis(axis: int) -> None:
    reader = Reader(WIDTH, HEADS, blocks=1)
    attention = reader.blocks[0].attention
    attention.to_out = torch.nn.Identity()
    x, tokens = torch.randn(1, 1, WIDTH), torch.randn(1, 6, WIDTH)
    points = torch.rand(1, 6, 3)
    moved = points.clone()
    moved[0, 0, axis] += 10.0  # far enough for the slowest pairs to notice
    code = turns(torch.zeros(1, 1, 3), WIDTH, RATE, SPAN)
    with torch.no_grad():
        before = attention(x, code, *reader.memories(context(tokens, points)))
        after = attention(x, code, *reader.memories(context(tokens, moved)))
    changes = (after - before).unflatten(-1, (HEADS, -1)).abs().amax(dim=-1)
    assert (changes > 1e-4).all()


def test_a_diagonal_is_told_from_its_mirror_image() -> None:
    # Both have the same coordinates on each axis alone.
    tokens = torch.cat([torch.randn(1, 1, WIDTH).expand(1, 2, -1), torch.randn(1, 1, WIDTH)], 1)
    rising = torch.tensor([[[0.05, 0.05, 0.0], [-0.05, -0.05, 0.0], [0.0, 0.0, 0.0]]])
    falling = rising * torch.tensor([1.0, -1.0, 1.0])
    reader = Reader(WIDTH, HEADS, blocks=1)
    query, code = torch.randn(1, 1, WIDTH), turns(torch.zeros(1, 1, 3), WIDTH, RATE, SPAN)
    with torch.no_grad():
        answers = [reader(query, code, context(tokens, points)) for points in (rising, falling)]
    assert (answers[0] - answers[1]).abs().max() > 1e-3


def test_padding_is_not_read() -> None:
    tokens, points = torch.randn(1, 6, WIDTH), torch.rand(1, 6, 3)
    real = torch.tensor([[True] * 4 + [False] * 2])
    loud = torch.where(real[..., None], tokens, torch.tensor(50.0))
    reader, query = Reader(WIDTH, HEADS, blocks=2), torch.randn(1, 3, WIDTH)
    code = turns(torch.rand(1, 3, 3), WIDTH, RATE, SPAN)
    with torch.no_grad():
        answers = [
            reader(query, code, Context(t, turns(points, WIDTH, RATE, SPAN), padding_bias(real)))
            for t in (tokens, loud)
        ]
    assert torch.equal(*answers)


def slow_turned(x: Tensor, code: Tensor) -> Tensor:
    """Channels i and i + d/2 as a plane."""
    first, second = x.chunk(2, dim=-1)
    cos, sin = code.real, code.imag
    return torch.cat([first * cos - second * sin, first * sin + second * cos], dim=-1)


def test_a_reader_is_its_blocks_one_after_the_other() -> None:
    reader, x = Reader(WIDTH, HEADS, blocks=2), torch.randn(2, 3, WIDTH)
    read = context(torch.randn(2, 6, WIDTH), torch.rand(2, 6, 3))
    code = turns(torch.rand(2, 3, 3), WIDTH, RATE, SPAN)
    expected = x
    for block in reader.blocks:
        layers = block.attention
        q, k = (
            slow_turned(layer(tokens), turn).unflatten(-1, (2, HEADS, -1))
            for layer, tokens, turn in (
                (layers.to_q, expected, code),
                (layers.to_k, read.tokens, read.code),
            )
        )
        scores = torch.einsum("b q z h p, b t z h p -> b h q t", q, k) / (WIDTH / HEADS) ** 0.5
        values = layers.to_v(read.tokens).unflatten(-1, (HEADS, -1))
        heard = torch.einsum("b h q t, b t h d -> b q h d", scores.softmax(-1), values)
        expected = block.norm_read(expected + layers.to_out(heard.flatten(-2)))
        expected = block.norm_out(expected + block.fall(block.rise(expected).relu()))
    torch.testing.assert_close(reader(x, code, read), expected)
