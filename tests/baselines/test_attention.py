"""Attention, stems, decoders and the action head against slow or independent versions."""

import pytest
import torch
from networks import make_batch
from torch import nn
from torch.nn import functional

from baselines.agent import Recipe
from baselines.heatmap import target_heatmaps
from baselines.layers.attention import (
    BlockSizes,
    FeedForward,
    NormedLinear,
    SelfBlock,
    attend,
    padding_bias,
)
from baselines.layers.heads import ActionHead, ActionLogits, action_loss, choose, read_at
from baselines.layers.stems import (
    PatchDecoder,
    PatchStem,
    PyramidDecoder,
    PyramidStem,
    conv_of_upsampled,
    convolution,
    side_by_side,
    with_locations,
)
from baselines.rotation import bins_to_quaternion
from baselines.scene.sight import ViewSight

SIZES = BlockSizes(width=16, heads=2, head_width=8, hidden=24, dropout=0.0)


def slow_attention(q: torch.Tensor, k: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
    scores = torch.einsum("b h q d, b h t d -> b h q t", q, k) / q.shape[-1] ** 0.5
    return torch.einsum("b h q t, b h t d -> b h q d", scores.softmax(-1), v)


@pytest.mark.parametrize("width", [8, 16, 30])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-5), (torch.bfloat16, 0.03)])
def test_attention_is_softmax_of_products(dtype: torch.dtype, tolerance: float, width: int) -> None:
    q, k, v = torch.randn(3, 2, 2, 7, width).unbind()
    found = attend(q.to(dtype), k.to(dtype), v.to(dtype)).float()
    torch.testing.assert_close(found, slow_attention(q, k, v), rtol=0, atol=tolerance)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_padding_is_not_attended_to(dtype: torch.dtype) -> None:
    q, k, v = torch.randn(3, 2, 2, 7, 8, dtype=dtype).unbind()
    real = torch.arange(7).expand(2, 7) < 5
    found = attend(q, k, v, bias=padding_bias(real))
    k[..., 5:, :] = 3.0
    v[..., 5:, :] = 99.0
    assert torch.equal(attend(q, k, v, bias=padding_bias(real)), found)


def test_a_gate_passes_the_gradients_that_autograd_would() -> None:
    torch.manual_seed(0)
    layer, x = FeedForward(SIZES).double(), torch.randn(2, 3, 16, dtype=torch.float64)
    x.requires_grad_()
    inputs = [x, *layer.parameters()]
    value, gate = layer.rise(x).chunk(2, dim=-1)
    expected = layer.fall(value * functional.gelu(gate))
    torch.testing.assert_close(layer(x), expected)
    pairs = (torch.autograd.grad(out.square().sum(), inputs) for out in (layer(x), expected))
    for one, other in zip(*pairs, strict=True):
        torch.testing.assert_close(one, other)


def test_dropout_acts_in_training_only() -> None:
    torch.manual_seed(0)
    block = SelfBlock(BlockSizes(width=16, heads=2, head_width=8, hidden=24, dropout=0.5))
    x = torch.randn(1, 6, 16)
    assert not torch.equal(block(x), block(x))
    block.eval()
    assert torch.equal(block(x), block(x))


def test_a_block_has_the_published_number_of_parameters() -> None:
    block = SelfBlock(BlockSizes(width=512, heads=8, head_width=64, hidden=2048, dropout=0.1))
    assert sum(p.numel() for p in block.parameters()) == 4_201_472


def test_normed_linear_treats_each_row_alone() -> None:
    layer = NormedLinear(6, 8)
    x = torch.randn(2, 3, 6)
    rows = torch.stack([layer(row[None])[0] for row in x.flatten(0, 1)])
    torch.testing.assert_close(layer(x).flatten(0, 1), rows)


def test_pixel_locations_span_minus_one_to_one() -> None:
    images = with_locations(torch.zeros(2, 5, 7, 4, 4))
    line = torch.linspace(-1, 1, 4)
    assert images.shape == (2, 5, 10, 4, 4)
    assert torch.equal(images[1, :, 7, 0, 0], torch.linspace(-1, 1, 5))
    assert torch.equal(images[1, 3, 8, :, 2], line)
    assert torch.equal(images[1, 3, 9, 2, :], line)


@pytest.mark.parametrize(
    ("stem", "decoder"),
    [
        (PatchStem(8, 8), PatchDecoder(12, 8, patch=8, kernel=3)),
        (PyramidStem((8, 12), 8), PyramidDecoder(12, (8, 12))),
    ],
)
def test_decoders_return_to_the_pixels_the_stem_began_with(
    stem: nn.Module, decoder: nn.Module
) -> None:
    tokens, skips = stem(torch.randn(3, 10, 32, 32))
    assert tokens.shape == (3, 8, 4, 4)
    heat, maps = decoder(torch.randn(3, 12, 4, 4), skips)
    assert heat.shape == (3, 1, 32, 32)
    assert tuple(features.shape[1] for features in maps) == decoder.map_channels


@pytest.mark.parametrize(
    ("stem", "decoder"),
    [
        (PatchStem(8, 8), PatchDecoder(8, 8, patch=8, kernel=3)),
        (PyramidStem((8, 12), 8), PyramidDecoder(8, (8, 12))),
    ],
)
def test_single_pixels_reach_the_heatmap_past_the_tokens(
    stem: nn.Module, decoder: nn.Module
) -> None:
    """Two pixels of one 2 x 2 cell differ in their effect: nothing is lost by the skip."""
    images = torch.randn(1, 10, 32, 32)
    tokens, _ = stem(images)
    heats = []
    for column in (8, 9):
        touched = images.clone()
        touched[0, :, 8, column] += 1
        heats.append(decoder(tokens, stem(touched)[1])[0])
    assert not torch.allclose(heats[0], heats[1])


def test_reading_at_the_heatmap_is_a_weighted_mean_without_gradient_to_the_heatmap() -> None:
    heat = torch.randn(2, 1, 8, 8, requires_grad=True)
    features = torch.randn(2, 3, 4, 4, requires_grad=True)
    found = read_at(heat, features)
    mass = heat.detach().flatten(1).softmax(-1).view(2, 8, 8)
    slow = torch.zeros(2, 3)
    for y in range(8):
        for x in range(8):
            slow += mass[:, y, x, None] * features.detach()[:, :, y // 2, x // 2]
    torch.testing.assert_close(found.detach(), slow)
    found.sum().backward()
    assert heat.grad is None
    assert features.grad is not None


def labelled_logits(strength: float = 50.0) -> tuple[ActionLogits, torch.Tensor]:
    """Logits that say what the labels of a batch say."""
    labels = make_batch(ViewSight(32)).labels
    heat = (target_heatmaps(labels.position_in_cube, 32) + 1e-9).log()
    rotation = strength * functional.one_hot(labels.rotation_bins, 72).float()
    gripper = strength * functional.one_hot(labels.gripper_open, 2).float()
    collision = strength * functional.one_hot(labels.ignore_collisions, 2).float()
    return ActionLogits(heat, rotation, gripper, collision), labels.position_in_cube


def test_the_choice_is_what_the_logits_say() -> None:
    logits, position = labelled_logits()
    labels, found = make_batch(ViewSight(32)).labels, choose(logits)
    assert (found.position_in_cube - position).abs().max() < 2 / 32
    assert torch.equal(found.quaternion_wxyz, bins_to_quaternion(labels.rotation_bins))
    assert torch.equal(found.gripper_open, labels.gripper_open == 1)
    assert torch.equal(found.ignore_collisions, labels.ignore_collisions == 1)


def test_one_hot_labels_give_the_plain_sum_of_six_cross_entropies() -> None:
    labels, size = make_batch(ViewSight(32)).labels, 4
    logits = ActionLogits(
        torch.randn(size, 5, 32, 32),
        torch.randn(size, 3, 72),
        torch.randn(size, 2),
        torch.randn(size, 2),
    )
    recipe = Recipe(rotation_weight=1.0, rotation_sigma_bins=0.0)
    total, _ = action_loss(logits, labels, recipe)
    target = target_heatmaps(labels.position_in_cube, 32).flatten(2)
    expected = -(target * logits.heatmaps.flatten(2).log_softmax(-1)).sum(-1).mean()
    for angle in range(3):
        expected = expected + functional.cross_entropy(
            logits.rotation[:, angle], labels.rotation_bins[:, angle]
        )
    expected = expected + functional.cross_entropy(logits.gripper, labels.gripper_open)
    expected = expected + functional.cross_entropy(logits.collision, labels.ignore_collisions)
    torch.testing.assert_close(total, expected)


def test_terms_are_logged_without_their_weights() -> None:
    logits, _ = labelled_logits(strength=1.0)
    labels = make_batch(ViewSight(32)).labels
    light, terms = action_loss(logits, labels, Recipe(rotation_weight=1.0))
    heavy, same = action_loss(logits, labels, Recipe(rotation_weight=3.0))
    assert torch.equal(terms["bc/rotation"], same["bc/rotation"])
    torch.testing.assert_close(heavy - light, 2 * terms["bc/rotation"])


def test_the_head_keeps_views_apart_and_samples_whole() -> None:
    head = ActionHead(4, (3,), (16, 16))
    tokens, heat = torch.randn(10, 4, 2, 2), torch.randn(10, 1, 8, 8)
    maps = [torch.randn(10, 3, 4, 4)]
    both = head(tokens, heat, maps)
    alone = head(tokens[5:], heat[5:], [maps[0][5:]])
    torch.testing.assert_close(both.rotation[1:], alone.rotation)
    assert torch.equal(both.heatmaps[1], heat[5:, 0])


@pytest.mark.parametrize(("kernel", "scale"), [(11, 11), (5, 16), (3, 2), (7, 3), (1, 4)])
def test_convolution_of_an_upsampled_map_needs_no_upsampled_map(kernel: int, scale: int) -> None:
    torch.manual_seed(0)
    x = torch.randn(2, 6, 4, 5, requires_grad=True)
    layer = convolution(6, 3, kernel, padding_mode="replicate")
    larger = functional.interpolate(x, scale_factor=scale, mode="bilinear")
    both = conv_of_upsampled(x, layer, scale), layer(larger)
    torch.testing.assert_close(*both, rtol=0, atol=1e-5)
    direction = torch.randn_like(both[0]) / scale
    wanted = (x, layer.weight, layer.bias)
    ours, theirs = (torch.autograd.grad(out, wanted, direction) for out in both)
    for found, expected in zip(ours, theirs, strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4)


def test_maps_side_by_side_meet_the_weights_of_the_joined_map() -> None:
    torch.manual_seed(0)
    maps = torch.randn(2, 5, 6, 7), torch.randn(2, 3, 6, 7)
    layer = convolution(8, 4, 3, padding_mode="replicate")
    found, expected = side_by_side(layer, *maps), layer(torch.cat(maps, dim=1))
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-5)
