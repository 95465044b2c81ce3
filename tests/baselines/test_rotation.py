"""Rotation classes against SciPy, and labels that do not jump where grippers live."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from baselines.rotation import (
    BINS,
    bins_to_quaternion,
    canonical_yaw,
    multiply,
    quaternion_to_bins,
    soft_labels,
)

RANDOM = Rotation.random(2000, rng=0)
HALF_TURN = np.array([0.0, 0.0, 0.0, 1.0])


def wxyz(rotation):
    return rotation.as_quat(scalar_first=True)


def downward(yaw_deg, tilt_deg=(0.0, 0.0)):
    """A gripper that points down, turned by a yaw and tilted a little."""
    tilted = Rotation.from_euler("xyz", [180 + tilt_deg[0], tilt_deg[1], 0], degrees=True)
    return wxyz(Rotation.from_euler("z", yaw_deg, degrees=True) * tilted)


def circular_distance(first, second):
    gap = np.abs(first - second) % BINS
    return np.minimum(gap, BINS - gap)


def test_identity_is_the_middle_bin():
    assert quaternion_to_bins(np.array([1.0, 0, 0, 0])).tolist() == [36, 36, 36]
    assert bins_to_quaternion(torch.tensor([36, 36, 36])).tolist() == [1, 0, 0, 0]


def test_bins_are_rounded_scipy_angles():
    angles = RANDOM.as_euler("xyz", degrees=True)
    free = np.abs(angles[:, 1]) < 89
    expected = np.rint((angles + 180) / 5).astype(int) % BINS
    np.testing.assert_array_equal(quaternion_to_bins(wxyz(RANDOM))[free], expected[free])


def test_bin_centres_are_scipy_rotations_with_positive_w():
    bins = np.random.default_rng(0).integers(0, BINS, (500, 3))
    quaternion = bins_to_quaternion(torch.from_numpy(bins)).numpy()
    expected = Rotation.from_euler("xyz", bins * 5 - 180, degrees=True)
    error = (expected.inv() * Rotation.from_quat(quaternion, scalar_first=True)).magnitude()
    assert error.max() < 1e-5
    assert (quaternion[:, 0] >= 0).all()


def test_round_trip_stays_within_half_a_bin_per_axis():
    bins = quaternion_to_bins(wxyz(RANDOM))
    decoded = Rotation.from_quat(
        bins_to_quaternion(torch.from_numpy(bins)).numpy()[:, [1, 2, 3, 0]]
    )
    error_deg = np.degrees((RANDOM.inv() * decoded).magnitude())
    assert error_deg.max() < 3 * 2.5


@pytest.mark.parametrize("scale", [-1.0, 0.5, 3.0])
def test_sign_and_length_of_the_quaternion_do_not_matter(scale):
    quaternion = wxyz(RANDOM)
    np.testing.assert_array_equal(
        quaternion_to_bins(scale * quaternion), quaternion_to_bins(quaternion)
    )


@pytest.mark.parametrize("pitch_deg", [-90.0, -89.2, 89.2, 89.9999, 90.0])
def test_gimbal_lock_puts_all_turning_into_x(pitch_deg):
    """On the lock x - z (or x + z) is what counts: it goes to x, and z is 0."""
    for x_deg, z_deg in ((0, 0), (40, 15), (-120, 77), (170, -100)):
        rotation = Rotation.from_euler("xyz", [x_deg, pitch_deg, z_deg], degrees=True)
        bins = quaternion_to_bins(wxyz(rotation))
        together = x_deg - np.sign(pitch_deg) * z_deg
        assert bins[1] == (54 if pitch_deg > 0 else 18)
        assert bins[2] == 36
        assert circular_distance(bins[0], (together + 180) / 5) <= 0.51


@pytest.mark.parametrize("yaw_deg", [-85, -40, 0, 15, 60, 90])
def test_a_downward_gripper_has_its_yaw_in_z_and_x_at_the_seam(yaw_deg):
    assert quaternion_to_bins(downward(yaw_deg)).tolist() == [0, 36, (yaw_deg + 180) // 5]


def test_jitter_about_straight_down_moves_no_label_by_more_than_its_size():
    """x flips between +180 and -180 degrees; its bin stays, y and z do not notice."""
    rng = np.random.default_rng(0)
    for yaw_deg in range(-88, 90, 5):  # between bin borders
        for tilt_deg in rng.normal(0, 0.5, (20, 2)):
            bins = quaternion_to_bins(downward(yaw_deg, tilt_deg))
            assert bins.tolist() == quaternion_to_bins(downward(yaw_deg)).tolist()


def test_half_a_bin_of_tilt_to_either_side_stays_next_to_the_seam():
    bins = [quaternion_to_bins(downward(0, (tilt, 0)))[0] for tilt in (-4, -1, 0, 1, 4)]
    assert bins == [71, 0, 0, 0, 1]


def test_soft_labels_wrap_around_the_circle():
    labels = soft_labels(torch.tensor([0, 71, 36]))
    torch.testing.assert_close(labels.sum(-1), torch.ones(3))
    assert labels.argmax(-1).tolist() == [0, 71, 36]
    torch.testing.assert_close(labels[0, 1], labels[0, 71])
    torch.testing.assert_close(labels[0].roll(-1), labels[1])
    torch.testing.assert_close(
        labels[2, 37] / labels[2, 36], torch.tensor(np.exp(-1 / 4.5)).float()
    )


def test_soft_labels_keep_the_shape_of_their_bins():
    assert soft_labels(torch.zeros(5, 3, dtype=torch.long)).shape == (5, 3, BINS)


def test_product_of_quaternions_is_scipys():
    first, second = RANDOM[:100], RANDOM[100:200]
    product = multiply(wxyz(first), wxyz(second))
    error = ((first * second).inv() * Rotation.from_quat(product, scalar_first=True)).magnitude()
    assert error.max() < 1e-6


def test_twins_have_one_canonical_orientation_which_is_one_of_them():
    quaternion = wxyz(RANDOM)
    chosen = canonical_yaw(quaternion)
    np.testing.assert_allclose(canonical_yaw(multiply(quaternion, HALF_TURN)), chosen, atol=1e-12)
    np.testing.assert_allclose(canonical_yaw(chosen), chosen, atol=1e-12)
    back = (RANDOM.inv() * Rotation.from_quat(chosen, scalar_first=True)).as_rotvec(degrees=True)
    assert np.minimum(np.linalg.norm(back, axis=-1), np.abs(np.abs(back[:, 2]) - 180)).max() < 1e-4
    assert (chosen[:, 0] >= 0).all()


@pytest.mark.parametrize("yaw_deg", [-180, -135, -90, -89, 0, 45, 90, 91, 179])
def test_canonical_yaw_of_a_downward_gripper_is_above_minus_90_and_up_to_90(yaw_deg):
    z_bin = quaternion_to_bins(canonical_yaw(downward(yaw_deg)))[2]
    expected = (yaw_deg + 89.999) % 180 - 89.999
    assert z_bin == round((expected + 180) / 5)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_plus_and_minus_90_degrees_are_the_same_label(dtype):
    bins = [quaternion_to_bins(canonical_yaw(downward(yaw).astype(dtype))) for yaw in (-90, 90)]
    assert bins[0].tolist() == bins[1].tolist() == [0, 36, 54]


def test_tilting_a_gripper_forwards_until_it_is_level_never_switches_twins():
    for yaw_deg in (-80, -30, 0, 30, 80):
        level = Rotation.from_euler("y", -90, degrees=True)
        for part in np.linspace(0, 1, 10):
            tilt = Rotation.from_rotvec(part * level.as_rotvec())
            yaw = Rotation.from_euler("z", yaw_deg, degrees=True)
            quaternion = wxyz(yaw * tilt * Rotation.from_euler("x", 180, degrees=True))
            same = np.abs(canonical_yaw(quaternion) @ quaternion)
            assert same == pytest.approx(1.0)
