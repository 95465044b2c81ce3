"""Ghost points lie where they should, end in finite time, and are dense enough to find a pose."""

import pytest
import torch
from torch import Tensor

from baselines.agents.act3d import CPU, METRES, PAPER, Act3dConfig
from baselines.layers.ghosts import Draw, in_ball, in_cube, scattered, spread

DRAWS = pytest.mark.parametrize("draw", [scattered, spread])
RADIUS = 0.2


@pytest.fixture(autouse=True)
def _seeded() -> None:
    torch.manual_seed(0)


def uniform(count: int) -> Tensor:
    """Targets all over the cube."""
    return 2 * torch.rand(count, 3) - 1


@DRAWS
def test_ghosts_lie_in_cube_and_ball(draw: Draw) -> None:
    center = 1.1 * uniform(200)  # some at the faces, some outside
    found = in_ball(draw, center, RADIUS, 128)
    assert found.shape == (200, 128, 3)
    assert found.abs().max() <= 1 + 1e-6
    assert ((found - center.clamp(-1, 1)[:, None]).norm(dim=-1) <= RADIUS + 1e-6).all()
    assert in_cube(draw, 2, 100).abs().max() <= 1


@DRAWS
def test_a_centre_far_outside_ends_at_the_nearest_face(draw: Draw) -> None:
    found = in_ball(draw, torch.tensor([[1 + 1 / METRES, 0.3, -9.0]]), RADIUS, 64)
    assert ((found - torch.tensor([1.0, 0.3, -1.0])).norm(dim=-1) <= RADIUS + 1e-6).all()


@DRAWS
def test_ghosts_fill_a_ball_evenly(draw: Draw) -> None:
    found = in_ball(draw, torch.zeros(50, 3), RADIUS, 500) / RADIUS
    radii = found.norm(dim=-1).flatten()
    # Half of a ball's volume lies within 0.794 of its radius.
    assert (radii < 0.5 ** (1 / 3)).float().mean() == pytest.approx(0.5, abs=0.02)
    assert found.mean(dim=(0, 1)).abs().max() < 0.03


def test_too_few_points_in_the_ball_are_made_up_for() -> None:
    def corners(rows: int, count: int) -> Tensor:
        return torch.ones(rows, count, 3)  # never within the ball

    found = in_ball(corners, torch.zeros(1, 3), RADIUS, 10)
    torch.testing.assert_close(found.norm(dim=-1), torch.full((1, 10), RADIUS))


def test_acting_ghosts_are_the_same_for_every_row_and_every_time() -> None:
    center = uniform(3)
    before = torch.get_rng_state()
    together = in_ball(spread, center, RADIUS, 64)
    assert torch.equal(torch.get_rng_state(), before)
    assert torch.equal(together, in_ball(spread, center, RADIUS, 64))
    for row in range(3):
        assert torch.equal(together[row : row + 1], in_ball(spread, center[[row]], RADIUS, 64))
    assert not torch.equal(scattered(1, 9), scattered(1, 9))


def errors_mm(draw: Draw, config: Act3dConfig, targets: Tensor) -> tuple[Tensor, Tensor]:
    """Distance of the guess from each target after the first and the last level.

    A perfect scorer: at every level the ghost nearest to the target is the guess.
    """
    guess, first = torch.zeros_like(targets), torch.tensor(0.0)
    for level, count in enumerate(config.ghosts_acting):
        if level == 0:
            found = in_cube(draw, len(targets), count)
        else:
            found = in_ball(draw, guess, config.radii_m[level - 1] / METRES, count)
        distance = (found - targets[:, None]).norm(dim=-1)
        guess = found[torch.arange(len(targets)), distance.argmin(dim=-1)]
        if level == 0:
            first = distance.amin(dim=-1)
    return 1000 * METRES * first, 1000 * METRES * (guess - targets).norm(dim=-1)


@pytest.mark.parametrize(("config", "worst_mm"), [(CPU, 4.0), (PAPER, 3.0)])
def test_a_perfect_scorer_ends_near_the_target(config: Act3dConfig, worst_mm: float) -> None:
    first, last = errors_mm(spread, config, uniform(500))
    assert first.max() < 80, "the first guess must leave the target in the next ball"
    assert last.max() < worst_mm


def test_training_counts_would_be_too_few_to_act_with() -> None:
    few = Act3dConfig(ghosts_acting=(128, 128, 128))
    first, last = errors_mm(scattered, few, uniform(500))
    assert (first > 80).float().mean() > 0.1
    assert (last > 5).float().mean() > 0.3
