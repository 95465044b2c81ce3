"""Labels, targets and decoding agree with each other and with brute force."""

import itertools

import numpy as np
import pytest
import torch

from baselines.heatmap import SIGMA_PX, decode, target_heatmaps
from baselines.scene.views import BACK, THREE_VIEWS, TOP, VIEWS, project

CHOICES = pytest.mark.parametrize(
    "views", [VIEWS, THREE_VIEWS, (TOP, BACK)], ids=["five", "three", "two"]
)
CORNERS = torch.tensor(list(itertools.product((-1.0, 1.0), repeat=3)))


def random_points(seed, count=64):
    return 2 * torch.rand(count, 3, generator=torch.Generator().manual_seed(seed)) - 1


def cell_centers(pixels):
    """All cells of the grid, in the order x, y, z."""
    line = (torch.arange(pixels) + 0.5) * 2 / pixels - 1
    return torch.cartesian_prod(line, line, line)


def brute_force_scores(logits, views=VIEWS):
    """Sum of log-softmaxes at every cell, read where `project` puts the cell's centre."""
    pixels = logits.shape[-1]
    uv = project(cell_centers(pixels), pixels, views)
    u, v = (uv - 0.5).round().long().unbind(-1)
    heights = logits.double().flatten(-2).log_softmax(-1).unflatten(-1, (pixels, pixels))
    return sum(heights[:, k, v[:, k], u[:, k]] for k in range(len(views)))


def brute_force_decode(logits, views, reach=2):
    """Best cell, then the weighted mean of the cells about it, each read from all scores."""
    pixels = logits.shape[-1]
    centers, points = cell_centers(pixels).double(), []
    for scores in brute_force_scores(logits, views):
        best = torch.tensor(np.unravel_index(int(scores.argmax()), (pixels,) * 3))
        radius = torch.minimum(best, pixels - 1 - best).clamp(max=reach)
        cell = ((centers + 1) * pixels / 2 - 0.5).round().long()
        near = ((cell - best).abs() <= radius).all(dim=-1)
        points.append(scores[near].softmax(0) @ centers[near])
    return torch.stack(points)


def logits_of(points, pixels, views=VIEWS):
    return (target_heatmaps(points, pixels, views=views) + 1e-9).log()


@pytest.mark.parametrize("pixels", [16, 21])
@pytest.mark.parametrize("scale", [0.1, 1.0, 8.0])
@CHOICES
def test_decoding_equals_brute_force(pixels, scale, views):
    generator = torch.Generator().manual_seed(pixels)
    noise = torch.randn(6, len(views), pixels, pixels, generator=generator)
    logits = scale * noise + logits_of(random_points(1, 6), pixels, views).clamp(min=-8)
    torch.testing.assert_close(
        decode(logits, views).double(), brute_force_decode(logits, views), atol=1e-5, rtol=0
    )


@pytest.mark.parametrize("views", [VIEWS, THREE_VIEWS], ids=["five", "three"])
def test_best_cell_of_the_full_grid_is_found_in_noise(views):
    logits = torch.randn(1, len(views), 128, 128, generator=torch.Generator().manual_seed(0))
    logits = 100 * logits  # so peaked that the mean is the best cell itself
    best = cell_centers(128)[brute_force_scores(logits, views)[0].argmax()]
    torch.testing.assert_close(decode(logits, views)[0], best, atol=1e-3, rtol=0)


@pytest.mark.parametrize("pixels", [64, 128, 220])
@pytest.mark.parametrize("points", [CORNERS, random_points(0)], ids=["corners", "random"])
@pytest.mark.parametrize("views", [VIEWS, THREE_VIEWS], ids=["five", "three"])
def test_decoded_targets_lie_within_half_a_cell_diagonal(points, pixels, views):
    error_px = (decode(logits_of(points, pixels, views), views) - points).norm(dim=-1) * pixels / 2
    assert error_px.max() <= np.sqrt(3) / 2 + 1e-4


@pytest.mark.parametrize("pixels", [128, 220])
def test_away_from_the_faces_the_mean_is_much_finer_than_a_cell(pixels):
    points = 0.9 * random_points(2)
    error_px = (decode(logits_of(points, pixels)) - points).abs() * pixels / 2
    assert error_px.max() < 0.05


@pytest.mark.parametrize("pixels", [128, 220])
def test_noise_of_five_percent_moves_the_point_by_less_than_a_cell(pixels):
    points = 0.9 * random_points(3)
    heights = target_heatmaps(points, pixels)
    noise = torch.rand(heights.shape, generator=torch.Generator().manual_seed(0))
    noisy = (heights + 0.05 * heights.amax() * noise + 1e-9).log()
    error_px = (decode(noisy) - points).norm(dim=-1) * pixels / 2
    assert error_px.max() <= np.sqrt(3) / 2


def test_a_bad_view_is_outvoted_by_the_others():
    points = 0.5 * random_points(4, 1)
    logits = (target_heatmaps(points, 64) + 1e-4).log()
    logits[:, 1] = (target_heatmaps(-points, 64)[:, 1] + 1e-4).log()
    assert (decode(logits) - points).norm() * 32 < 1


def test_logits_may_be_shifted_per_view():
    logits = logits_of(random_points(5, 4), 32)
    shifted = logits + torch.randn(4, 5, 1, 1, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(decode(shifted), decode(logits), atol=1e-5, rtol=0)


def test_decoding_carries_no_gradient_and_takes_other_layouts_and_types():
    logits = logits_of(random_points(6, 2), 32).requires_grad_()
    points = decode(logits)
    assert not points.requires_grad
    strided = logits.detach().permute(0, 1, 3, 2).contiguous().permute(0, 1, 3, 2)
    torch.testing.assert_close(decode(strided), points)
    assert decode(logits.detach().bfloat16()).dtype == torch.float32


@pytest.mark.parametrize("pixels", [32, 128])
@pytest.mark.parametrize("points", [CORNERS, random_points(7, 8)], ids=["corners", "random"])
@CHOICES
def test_targets_equal_a_gaussian_evaluated_at_every_pixel_centre(points, pixels, views):
    line = torch.arange(pixels) + 0.5
    u, v = project(points, pixels, views)[..., None, None].unbind(2)
    square = (line[None, :] - u).square() + (line[:, None] - v).square()
    heights = torch.exp(-square / (2 * SIGMA_PX**2)) * (square <= (3 * SIGMA_PX) ** 2)
    expected = heights / heights.sum(dim=(-2, -1), keepdim=True)
    found = target_heatmaps(points, pixels, views=views)
    torch.testing.assert_close(found, expected, atol=1e-6, rtol=1e-4)


def test_targets_sum_to_one_in_every_view():
    sums = target_heatmaps(torch.cat([CORNERS, random_points(8)]), 64).sum(dim=(-2, -1))
    torch.testing.assert_close(sums, torch.ones_like(sums))
