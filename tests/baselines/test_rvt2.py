"""RVT-2's published size, its zoom, its convex heatmaps, and what may teach what."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from networks import TEXT, gradients, make_batch, make_inputs, tiny

from baselines.agents.rvt2 import (
    BINS,
    CPU,
    DRAWS,
    PAPER,
    Rvt2,
    WaypointHead,
    convex_mix,
    sample,
    shown_angles,
)
from baselines.scene.sight import ZoomSight
from baselines.text import TextSpec

CONFIG = tiny(CPU)
SIGHT = ZoomSight(CONFIG.pixels, draws=DRAWS)


@pytest.fixture
def network() -> Rvt2:
    torch.manual_seed(0)
    return Rvt2(CONFIG, TEXT)


def test_the_paper_preset_has_the_published_number_of_parameters() -> None:
    clip = TextSpec(name="clip", dim=512, max_tokens=77, fingerprint="")
    with torch.device("meta"):
        published = Rvt2(replace(PAPER, proprio_width=4), clip)
        ours = Rvt2(PAPER, clip)
    sizes = [sum(p.numel() for p in part.parameters()) for part in (published, published.coarse)]
    assert sizes == [72_288_678, 35_669_861]
    # Two proprioceptive numbers instead of four (D-proprio), in each stage.
    assert sum(p.numel() for p in ours.parameters()) == 72_288_678 - 2 * 2 * 64


def test_the_paper_preset_normalises_over_the_batch_and_acts_row_by_row() -> None:
    config = replace(CONFIG, head_norm="batch", stem="patch", patch=16)
    network = Rvt2(config, TEXT)
    network.loss(make_batch(SIGHT))[0].backward()
    inputs = make_inputs(SIGHT, size=2)
    with torch.no_grad():
        chosen = network.eval().act(inputs)
    assert isinstance(network.head.norm, torch.nn.BatchNorm1d)
    assert chosen.position_in_cube.isfinite().all()


def test_the_coarse_stage_learns_from_its_heatmaps_alone(network: Rvt2) -> None:
    batch = make_batch(SIGHT)
    look = network.coarse_look(batch)
    look.heatmaps.retain_grad()
    network.cloning_loss(look, batch)[0].backward()
    direct = look.heatmaps.grad
    network.zero_grad()
    again = network.coarse_look(batch)
    again.heatmaps.backward(direct)
    found = gradients(network)
    assert {name.partition(".")[0] for name in found} == {"coarse"}


def test_gradients_of_the_fine_stage_stop_at_the_zoom(network: Rvt2) -> None:
    batch = make_batch(SIGHT)
    look = network.coarse_look(batch)
    detached = replace(look, heatmaps=look.heatmaps.detach())
    network.cloning_loss(detached, batch)[0].backward()
    assert {name.partition(".")[0] for name in gradients(network)} == {"fine", "head"}


def test_the_loss_asks_no_random_generator(network: Rvt2) -> None:
    batch = make_batch(SIGHT)
    first, _ = network.loss(batch)
    torch.manual_seed(1)
    assert torch.equal(network.loss(batch)[0], first)


def test_the_answer_is_the_zoomed_one_about_the_coarse_one(network: Rvt2) -> None:
    inputs = make_inputs(SIGHT)
    with torch.no_grad():
        found = network.eval().act(inputs).position_in_cube
        network.config = replace(CONFIG, zoom=1e6)
        coarse = network.act(inputs).position_in_cube
    assert 0 < (found - coarse).abs().max() <= 1 / CONFIG.zoom + 1e-5


def test_pixels_are_convex_mixes_of_the_cells_about_their_own() -> None:
    cells, shares = torch.randn(2, 1, 4, 4), torch.randn(2, 9 * 3 * 3, 4, 4)
    mixed, padded = convex_mix(cells, shares), torch.nn.functional.pad(cells, (1, 1, 1, 1))
    weights = torch.nn.functional.pixel_shuffle(shares, 3).softmax(1)
    for y, x in np.ndindex(12, 12):
        near = padded[:, 0, y // 3 : y // 3 + 3, x // 3 : x // 3 + 3].flatten(1)
        expected = (near * weights[:, :, y, x]).sum(1)
        torch.testing.assert_close(mixed[:, 0, y, x], expected)


def test_a_share_of_one_copies_its_cell() -> None:
    cells, shares = torch.randn(1, 1, 4, 4), torch.zeros(1, 9, 2 * 2, 4, 4)
    shares[:, 4] = 100.0
    shares = shares.flatten(1, 2)
    expected = cells.repeat_interleave(2, -1).repeat_interleave(2, -2)
    torch.testing.assert_close(convex_mix(cells, shares), expected)


def test_features_are_read_at_cell_centres_and_between_them() -> None:
    features = torch.arange(16.0).view(1, 1, 4, 4)
    places = torch.tensor([[-0.75, -0.75], [0.25, -0.25], [0.0, 0.0], [1.0, 1.0]])
    found = sample(features.expand(4, 1, 4, 4), places)[:, 0]
    torch.testing.assert_close(found, torch.tensor([0.0, 6.0, 7.5, 15.0]))


def test_features_come_from_where_the_point_projects(network: Rvt2) -> None:
    """Tokens that hold their own place give back the point, view by view."""
    inputs = make_inputs(SIGHT, size=1)
    with torch.no_grad():
        look = network.coarse(inputs.scene, inputs)
    line = (torch.arange(8) + 0.5) / 4 - 1
    u, v = line.expand(8, 8), line[:, None].expand(8, 8)
    look = replace(look, tokens=torch.stack([u, v]).expand(3, 2, 8, 8))
    x, y, z = 0.3, -0.2, 0.5
    found = look.features_at(torch.tensor([[x, y, z]]))[0, -6:]
    torch.testing.assert_close(found, torch.tensor([x, -y, y, -z, -x, -z]))


def test_later_angles_hear_of_earlier_ones_and_not_the_reverse() -> None:
    head = WaypointHead(CONFIG).eval()
    features = torch.randn(2, head.flags[0].in_features)
    rotation, flags = head(features, torch.tensor([[3, 5], [3, 5]]))
    other_y, same_flags = head(features, torch.tensor([[3, 6], [3, 6]]))
    other_x, _ = head(features, torch.tensor([[4, 5], [4, 5]]))
    assert torch.equal(flags, same_flags)
    assert torch.equal(rotation[:, :2], other_y[:, :2])
    assert not torch.equal(rotation[:, 2], other_y[:, 2])
    assert torch.equal(rotation[:, 0], other_x[:, 0])
    assert not torch.equal(rotation[:, 1], other_x[:, 1])


def test_acting_goes_by_the_likeliest_angles() -> None:
    head = WaypointHead(CONFIG).eval()
    features = torch.randn(2, head.flags[0].in_features)
    rotation, _ = head(features, None)
    again, _ = head(features, rotation[:, :2].argmax(-1))
    assert torch.equal(rotation, again)


def test_shown_angles_are_at_most_two_bins_off() -> None:
    labels = make_batch(SIGHT, size=64).labels
    shown = shown_angles(labels, torch.rand(64, 2))
    off = (shown - labels.rotation_bins[:, :2] + BINS // 2) % BINS - BINS // 2
    assert set(off.flatten().tolist()) == {-2, -1, 0, 1}
    assert 0 <= shown.min() <= shown.max() < BINS
