"""Grips as numbers: one value for what two parallel fingers cannot tell apart."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from baselines.layers.regression import grip_error, grip_numbers, grip_quaternion
from baselines.rotation import canonical_yaw
from baselines.validate import grip_angle_deg

HALF_TURN = Rotation.from_euler("z", 180, degrees=True)


def quaternions(seed: int) -> np.ndarray:
    return Rotation.random(20, np.random.default_rng(seed)).as_quat(scalar_first=True)


def test_all_four_names_of_a_grip_are_right() -> None:
    label = quaternions(0)
    twin = (Rotation.from_quat(label, scalar_first=True) * HALF_TURN).as_quat(scalar_first=True)
    numbers = grip_numbers(torch.from_numpy(label))
    for name in (label, -label, twin, -twin):
        error = grip_error(numbers, torch.from_numpy(name))
        torch.testing.assert_close(error, torch.zeros(20).double())


def test_numbers_become_the_orientation_they_were_made_from() -> None:
    label = quaternions(1)
    found = grip_quaternion(grip_numbers(torch.from_numpy(label)))
    np.testing.assert_allclose(found, canonical_yaw(label), atol=1e-9)


def test_the_error_is_the_distance_of_approach_and_closing_line() -> None:
    first, second = quaternions(2), quaternions(3)
    a, b = (Rotation.from_quat(q, scalar_first=True).as_matrix() for q in (first, second))
    lines = [m[:, :, :1] * m[:, :, :1].transpose(0, 2, 1) for m in (a, b)]
    approach = ((a[:, :, 2] - b[:, :, 2]) ** 2).sum(-1)
    expected = approach + ((lines[0] - lines[1]) ** 2).sum((1, 2))
    found = grip_error(grip_numbers(torch.from_numpy(first)), torch.from_numpy(second))
    np.testing.assert_allclose(found, expected, atol=1e-12)


@pytest.mark.parametrize("noise", [0.05, 0.3])
def test_noisy_numbers_give_a_grip_nearby_and_never_one_along_the_approach(noise: float) -> None:
    label = quaternions(4)
    rng = np.random.default_rng(5)
    numbers = grip_numbers(torch.from_numpy(label)).numpy() + rng.normal(0, noise, (20, 9))
    found = grip_quaternion(torch.from_numpy(numbers)).numpy()
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1)
    degrees = [grip_angle_deg(a, b) for a, b in zip(found, label, strict=True)]
    assert np.median(degrees) < 120 * noise


def test_doubt_between_two_grips_keeps_the_approach_they_share() -> None:
    """Grips a quarter turn apart: their mean has no closing line, but still points down."""
    down = Rotation.from_euler("x", 180, degrees=True)
    both = [down * Rotation.from_euler("z", yaw, degrees=True) for yaw in (-45, 45)]
    numbers = [grip_numbers(torch.from_numpy(r.as_quat(scalar_first=True))) for r in both]
    found = grip_quaternion(torch.stack(numbers).mean(0, keepdim=True)).numpy()
    turned = Rotation.from_quat(found[0], scalar_first=True)
    np.testing.assert_allclose(turned.as_matrix()[:, 2], [0, 0, -1], atol=1e-9)
