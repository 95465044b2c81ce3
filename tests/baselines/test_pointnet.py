"""Layers of the point network against the same steps written out."""

import pytest
import torch
from torch import Tensor

from baselines.layers.pointnet import Norm, SetAbstraction

SAMPLES, POINTS, CENTRES, NEIGHBOURS, CHANNELS = 2, 12, 5, 4, 8


def written_out(block: SetAbstraction, features: Tensor, xyz: Tensor, near: Tensor) -> Tensor:
    """Gather first, then subtract, then multiply."""
    rows = torch.arange(SAMPLES)[:, None, None]
    centres = xyz[:, :CENTRES, None]
    offsets = (xyz[rows, near.long()] - centres) / block.radius
    joined = block.lift(features[rows, near.long()]) + block.offset(offsets)
    said = block.neighbours(joined.flatten(0, 2)).unflatten(0, near.shape).amax(2)
    return block.norm(said + block.skip(features[:, :CENTRES])).relu()


@pytest.mark.parametrize("norm", ["batch", "layer"])
def test_an_abstraction_is_the_maximum_over_neighbours(norm: Norm) -> None:
    torch.manual_seed(0)
    block = SetAbstraction(CHANNELS, 2 * CHANNELS, radius=0.05, norm=norm)
    features = torch.randn(SAMPLES, POINTS, CHANNELS, requires_grad=True)
    xyz = torch.rand(SAMPLES, POINTS + 3, 3)
    near = torch.randint(POINTS, (SAMPLES, CENTRES, NEIGHBOURS), dtype=torch.int32)
    inputs = [features, *block.parameters()]
    expected = written_out(block, features, xyz, near)
    found = block(features, xyz, near)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4)
    pairs = (torch.autograd.grad(out.square().sum(), inputs) for out in (found, expected))
    for one, other in zip(*pairs, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-3)


def test_places_are_not_rounded_in_bf16() -> None:
    torch.manual_seed(0)
    block = SetAbstraction(CHANNELS, 2 * CHANNELS, radius=0.05, norm="layer")
    features, near = torch.zeros(1, 2, CHANNELS), torch.tensor([[[1]]], dtype=torch.int32)
    close = torch.tensor([[[0.95, 0.9, 0.92], [0.953, 0.9, 0.92]]])
    seen: list[Tensor] = []
    block.neighbours.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0].clone()))
    with torch.autocast("cpu", torch.bfloat16):
        block(features, close, near)
    offset = block.offset((close[:, 1] - close[:, 0]) / block.radius)
    expected = offset + block.lift(features[:, 1])
    torch.testing.assert_close(seen[0].float(), expected, rtol=0.02, atol=2e-3)
