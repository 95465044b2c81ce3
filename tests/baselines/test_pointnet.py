"""Layers of the point network against the same steps written out."""

from copy import deepcopy

import pytest
import torch
from torch import Tensor

from baselines.layers.pointnet import Norm, PerRow, SetAbstraction

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
    for parameter in block.parameters():  # scales of both signs
        torch.nn.init.normal_(parameter)
    features = torch.randn(SAMPLES, POINTS, CHANNELS, requires_grad=True)
    xyz = torch.rand(SAMPLES, POINTS + 3, 3)
    near = torch.randint(POINTS, (SAMPLES, CENTRES, NEIGHBOURS), dtype=torch.int32)
    twin, answers = deepcopy(block), []
    for network, out in (
        (block, block(features, xyz, near)),
        (twin, written_out(twin, features, xyz, near)),
    ):
        inputs = [features, *network.parameters()]
        answers.append([out, *torch.autograd.grad(out.square().sum(), inputs)])
    for one, other in zip(*answers, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-3)


def test_places_are_not_rounded_in_bf16() -> None:
    torch.manual_seed(0)
    block = SetAbstraction(CHANNELS, 2 * CHANNELS, radius=0.05, norm="layer")
    features, near = torch.zeros(1, 2, CHANNELS), torch.tensor([[[1]]], dtype=torch.int32)
    close = torch.tensor([[[0.95, 0.9, 0.92], [0.953, 0.9, 0.92]]])
    seen: list[Tensor] = []
    block.neighbours[0].register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0].clone()))
    with torch.autocast("cpu", torch.bfloat16):
        block(features, close, near)
    offset = block.offset((close[:, 1] - close[:, 0]) / block.radius)
    expected = offset + block.lift(features[:, 1])
    torch.testing.assert_close(seen[0].float(), expected, rtol=0.02, atol=2e-3)


def test_batch_norm_keeps_its_statistics_where_only_the_strongest_are_normalised() -> None:
    torch.manual_seed(0)
    rows, weight = torch.randn(2, 3, 4, CHANNELS), torch.randn(6, CHANNELS)
    ours, reference = PerRow(6), PerRow(6)
    for norm in (ours, reference):
        norm.norm.weight.data = torch.tensor([1.0, -1.0, 0.5, -0.5, 0.0, 2.0])
    for training in (True, True, False):
        found = ours.train(training).strongest(rows, weight)
        expected = reference.train(training)(rows @ weight.T).amax(2)
        torch.testing.assert_close(found, expected)
    for name, value in reference.state_dict().items():
        torch.testing.assert_close(ours.state_dict()[name], value)
