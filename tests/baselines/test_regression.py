"""The error of a regressed orientation does not see what two parallel fingers cannot tell apart."""

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from baselines.layers.regression import grasp_error, twin
from baselines.rotation import canonical_yaw
from baselines.validate import grip_angle_deg


def quaternions(seed: int) -> np.ndarray:
    return Rotation.random(20, np.random.default_rng(seed)).as_quat(scalar_first=True)


def test_all_four_names_of_a_grasp_are_right() -> None:
    label = torch.from_numpy(quaternions(0))
    for name in (label, -label, twin(label), -twin(label)):
        torch.testing.assert_close(grasp_error(name, label), torch.zeros(20).double())


def test_the_twin_is_half_a_turn_about_the_tool_axis() -> None:
    label = quaternions(0)
    turned = Rotation.from_quat(label, scalar_first=True) * Rotation.from_euler(
        "z", 180, degrees=True
    )
    found = Rotation.from_quat(twin(torch.from_numpy(label)).numpy(), scalar_first=True)
    assert (found.inv() * turned).magnitude().max() < 1e-6
    np.testing.assert_allclose(
        canonical_yaw(twin(torch.from_numpy(label)).numpy()), canonical_yaw(label), atol=1e-12
    )


def test_the_error_grows_with_the_angle_between_grasps() -> None:
    first, second = quaternions(1), quaternions(2)
    error = grasp_error(torch.from_numpy(first), torch.from_numpy(second))
    degrees = [grip_angle_deg(a, b) for a, b in zip(first, second, strict=True)]
    np.testing.assert_allclose(error, 2 * (1 - np.cos(np.radians(degrees) / 2)), atol=1e-9)
