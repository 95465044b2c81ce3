"""HiveFormer's published size, what it remembers, and how it reads a position off its heatmap."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from networks import TEXT, gradients, make_batch, make_inputs, tiny
from synthetic import observation
from torch.nn import functional

from baselines.agents.hiveformer import (
    AGENT,
    CPU,
    PAPER,
    HiveFormer,
    HiveFormerConfig,
    cloning_loss,
    heat_labels,
)
from baselines.batch import Inputs
from baselines.layers.heat import falling_off
from baselines.layers.pictures import (
    gripper_map,
    log_heat_over,
    mean_point,
    network_images,
    pooled_points,
)
from baselines.layers.unet import Merge, UnetDecoder, doubled, doubling, replicated
from baselines.scene.sight import Moment
from baselines.text import TextSpec
from sacil_tasks.errors import UsageError

PUBLISHED = {
    "encoder": (4 * 9 * 8 + 8) + (8 * 16 + 16) + 4 * (16 * 9 * 16 + 16 + 2 * 16),
    "visual tokens": (19 * 64 + 64) + (64 + 3 + 10) * 64 + 4 * 128,
    "words": (512 * 64 + 64) + 42 * 64 + 128,
    "kinds": 2 * 64 + 128,
    "two attentions": 2 * (4 * (64 * 64 + 64) + 128),
    "feed-forward": 2 * (64 * 64 + 64) + 128,
    "position": (80 * 9 * 16 + 16 + 32) + 3 * (32 * 9 * 16 + 16 + 32) + (16 + 1),
    "rotation": (240 * 9 * 64 + 64 + 128) + (64 * 9 * 64 + 64) + (64 * 64 + 64) + (64 * 5 + 5),
}
"""Parameters of the published network with three cameras, 42 words and 10 steps, without the
tables of tasks (58 k) and the duplicates that take no part (36 k)."""

OURS = {
    "a fourth camera": 80 * 9 * 64 + 64,
    "77 words": (77 - 42) * 64,
    "25 steps": (25 - 10) * 64,
    "offset and collision (D-hiveformer-offset)": 4 * 64 + 4,
    "grip (D-grip)": 5 * 64 + 5,
}
"""What our inputs and outputs add."""


@pytest.fixture
def network() -> HiveFormer:
    torch.manual_seed(0)
    return HiveFormer(tiny(CPU), TEXT).eval()


@pytest.fixture(scope="module")
def episode() -> list:
    rng = np.random.default_rng(3)
    return [observation(rng, step) for step in range(10)]


def seen_by(network: HiveFormer, *moments: Moment) -> Inputs:
    return make_inputs(network.sight, size=len(moments), moments=moments)


def answer(network: HiveFormer, inputs: Inputs) -> torch.Tensor:
    with torch.no_grad():
        found = network.act(inputs)
    return torch.cat([found.position_in_cube, found.quaternion_wxyz], dim=-1)


def test_the_paper_preset_has_the_published_number_of_parameters() -> None:
    tables = (512 * 106 + 106) + 10 * 106 * 3
    duplicates = (512 * 64 + 64) + 42 * 64 + 128
    assert round((sum(PUBLISHED.values()) + tables + duplicates) / 1000) == 393
    clip = TextSpec(name="clip", dim=512, max_tokens=77, fingerprint="")
    with torch.device("meta"):
        ours = HiveFormer(PAPER, clip)
    expected = sum(PUBLISHED.values()) + sum(OURS.values())
    assert sum(p.numel() for p in ours.parameters()) == expected


def test_the_past_changes_the_answer(network: HiveFormer, episode: list) -> None:
    now = Moment(episode[2], before=episode[:2])
    other = Moment(episode[2], before=[episode[5], episode[1]])
    shorter = Moment(episode[2], before=episode[1:2])
    answers = [answer(network, seen_by(network, moment)) for moment in (now, other, shorter)]
    assert not torch.allclose(answers[0], answers[1], atol=1e-6)
    assert not torch.allclose(answers[0], answers[2], atol=1e-6)


def test_without_history_the_past_changes_nothing(episode: list) -> None:
    torch.manual_seed(0)
    network = HiveFormer(AGENT.variants["no_history"](tiny(CPU)), TEXT).eval()
    with_past = seen_by(network, Moment(episode[2], before=episode[:2]))
    assert torch.equal(
        answer(network, with_past), answer(network, seen_by(network, Moment(episode[2])))
    )


def test_what_left_the_window_is_forgotten(network: HiveFormer, episode: list) -> None:
    assert network.config.window == 8
    first = seen_by(network, Moment(episode[9], before=episode[:9]))
    second = seen_by(network, Moment(episode[9], before=[episode[1], episode[0], *episode[2:9]]))
    assert torch.equal(answer(network, first), answer(network, second))


def test_steps_that_only_pad_change_nothing(network: HiveFormer, episode: list) -> None:
    alone = seen_by(network, Moment(episode[1], before=episode[:1]))
    scene = seen_by(
        network, Moment(episode[1], before=episode[:1]), Moment(episode[4], before=episode[:4])
    ).scene
    padded = type(scene)(**{name: value[:1].clone() for name, value in vars(scene).items()})
    assert padded.happened.tolist() == [[False, False, False, True, True]]
    padded.rgb[:, :3] = 99
    padded.xyz_in_cube[:, :3] = 0.5
    torch.testing.assert_close(
        answer(network, replace(alone, scene=padded)), answer(network, alone), rtol=0, atol=1e-6
    )


def test_past_gradients_teach_the_encoder_and_change_nothing_else(episode: list) -> None:
    networks = []
    for taught in (True, False):
        torch.manual_seed(0)
        networks.append(HiveFormer(replace(tiny(CPU), past_gradients=taught), TEXT))
    inputs = seen_by(networks[0], Moment(episode[2], before=episode[:2]))
    choices = [network(inputs).action.position_in_cube for network in networks]
    assert torch.equal(*choices)
    for choice in choices:
        choice.sum().backward()
    first, second = (gradients(network) for network in networks)
    differing = {name for name in first if not torch.allclose(first[name], second[name])}
    assert differing
    assert all(name.startswith("encoder.") for name in differing)


def test_a_certain_pixel_gives_its_point_and_unseen_pixels_never_win() -> None:
    generator = torch.Generator().manual_seed(0)
    xyz = 2 * torch.rand(2, 4, 3, 8, 8, generator=generator) - 1
    seen = torch.rand(2, 4, 8, 8, generator=generator) < 0.5
    seen[:, 2, 3, 5], seen[:, 1, 0, 0] = True, False
    logits = torch.zeros(2, 4, 8, 8)
    logits[:, 2, 3, 5], logits[:, 1, 0, 0] = 10, 1e4
    heat = log_heat_over(logits, seen, 0.1).exp()
    assert (heat[~seen] == 0).all()
    torch.testing.assert_close(mean_point(heat, xyz), xyz[:, 2, :, 3, 5])


def test_where_nothing_is_seen_the_heatmap_is_finite() -> None:
    nothing = torch.zeros(1, 4, 8, 8, dtype=torch.bool)
    heat = log_heat_over(torch.randn(1, 4, 8, 8), nothing, 0.1).exp()
    assert heat.sum() == pytest.approx(1)
    assert (mean_point(heat, torch.zeros(1, 4, 3, 8, 8)) == 0).all()


def test_the_label_is_hottest_where_the_keyframe_is_and_cold_where_nothing_is_seen(
    network: HiveFormer,
) -> None:
    batch = make_batch(network.sight)
    scene, aim = batch.inputs.scene, batch.labels.position_in_cube
    seen = scene.seen[:, -1].flatten(1)
    label = heat_labels(scene, batch.labels)
    gaps = (scene.xyz_in_cube[:, -1] - aim[:, None, :, None, None]).norm(dim=2).flatten(1)
    hottest = gaps.masked_fill(~seen, torch.inf).argmin(-1)
    assert torch.equal(label.argmax(-1), hottest)
    assert (label[~seen] == 0).all()
    torch.testing.assert_close(label.sum(-1), torch.ones(len(aim)))


def test_a_label_falls_to_a_third_with_each_centimetre() -> None:
    label = falling_off(torch.tensor([[0.0, 0.01, 0.03]]))[0]
    torch.testing.assert_close(label / label[0], torch.tensor([0.0, -1.0, -3.0]).exp())


def test_heat_on_the_label_costs_nothing_and_heat_elsewhere_does(network: HiveFormer) -> None:
    batch = make_batch(network.sight)
    choice = network(batch.inputs)
    right = heat_labels(batch.inputs.scene, batch.labels).clamp_min(1e-30).log()
    told = replace(choice, log_heat=right.view_as(choice.log_heat))
    losses = [cloning_loss(c, batch, network.config)[1]["bc/heat"] for c in (told, choice)]
    assert float(losses[0]) == pytest.approx(0, abs=1e-5)
    assert losses[1] > 0.1


def test_the_published_loss_has_no_heat_in_it(network: HiveFormer) -> None:
    batch = make_batch(network.sight)
    choice = network(batch.inputs)
    other = replace(choice, log_heat=choice.log_heat.roll(7, -1))
    totals = [cloning_loss(c, batch, PAPER)[0] for c in (choice, other)]
    assert torch.equal(*totals)


def test_only_training_crops(episode: list) -> None:
    moment = Moment(episode[2], before=episode[:2])
    sights = {reach: HiveFormer(replace(tiny(CPU), crop_px=reach), TEXT).sight for reach in (0, 9)}
    plain = sights[0].look([replace(moment, seed=5)])
    assert torch.equal(sights[9].look([moment]).rgb, plain.rgb)
    assert not torch.equal(sights[9].look([replace(moment, seed=5)]).rgb, plain.rgb)


def test_the_gripper_map_peaks_where_the_gripper_is() -> None:
    places = torch.tensor([[[20.5, 70.5], [-300.0, 5.0], [-torch.inf, -torch.inf], [127.9, 0.1]]])
    maps = gripper_map(places, 128)[0]
    assert divmod(int(maps[0].argmax()), 128) == (70, 20)
    assert maps[0].max() == 1
    assert (maps[1:3] == 0).all()
    assert divmod(int(maps[3].argmax()), 128) == (0, 127)


def test_images_are_colours_and_the_map_from_minus_one_to_one() -> None:
    rgb = torch.tensor([0, 51, 255], dtype=torch.uint8).view(1, 1, 3, 1, 1).expand(2, 4, 3, 8, 8)
    images = network_images(rgb, torch.full((2, 4, 2), 3.5))
    assert images.shape == (8, 4, 8, 8)
    torch.testing.assert_close(images[5, :3, 0, 0], torch.tensor([-1, -0.6, 1]))
    assert images[5, 3, 3, 3] == 1
    assert images[5, 3].min() == pytest.approx(-1, abs=1e-2)


def test_cells_hold_the_mean_of_the_points_they_show() -> None:
    generator = torch.Generator().manual_seed(0)
    seen = torch.rand(2, 4, 8, 8, generator=generator) < 0.3
    seen[0, 0, :4, :4] = False
    xyz = torch.rand(2, 4, 3, 8, 8, generator=generator) * seen[:, :, None]
    pooled = pooled_points(xyz, seen, 2)
    assert (pooled[0, 0, :, 0, 0] == 0).all()
    shown = xyz[1, 2, :, 4:, :4][:, seen[1, 2, 4:, :4]]
    torch.testing.assert_close(pooled[1, 2, :, 1, 0], shown.mean(-1))


@pytest.mark.parametrize("kernel", [1, 3])
def test_maps_that_are_merged_meet_the_same_weights_as_side_by_side(kernel: int) -> None:
    merge = Merge(3, 2, kernel)
    coarse, skip = torch.randn(2, 3, 6, 6), torch.randn(2, 2, 6, 6)
    expected = merge.layer(torch.cat([coarse, skip], dim=1))
    torch.testing.assert_close(merge(coarse, skip), expected)


def test_the_decoder_may_enlarge_after_its_last_convolution() -> None:
    decoder = UnetDecoder(6, (4, 4), fine_kernel=3)
    x = torch.randn(2, 4, 8, 8)
    rows = doubling(8, torch.device("cpu"))
    torch.testing.assert_close(rows @ decoder.heat(x) @ rows.T, decoder.heat(doubled(x)))


def test_edges_are_continued() -> None:
    layer, x = replicated(2, 3), torch.randn(1, 2, 5, 5)
    edged = functional.pad(x, (1, 1, 1, 1), mode="replicate")
    torch.testing.assert_close(layer(x), functional.conv2d(edged, layer.weight, layer.bias))


@pytest.mark.parametrize(
    ("change", "words"), [({"heads": 3}, "multiple of --heads"), ({"window": 0}, "window must be")]
)
def test_sizes_that_do_not_fit_are_refused(change: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        replace(HiveFormerConfig(), **change)
