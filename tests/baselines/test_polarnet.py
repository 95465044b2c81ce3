"""PolarNet's published size, what its answer may depend on, and how it points."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import synthetic
import torch
from networks import TEXT, make_batch, make_inputs, random_moments, tiny

from baselines import checkpoint
from baselines.agents.polarnet import (
    CPU,
    PAPER,
    PolarNet,
    PolarNetConfig,
    heat_labels,
    read_out,
)
from baselines.agents.polarnet import load as load_policy
from baselines.checkpoint import Identity
from baselines.layers.regression import tool_axes
from baselines.rotation import bins_to_quaternion, multiply
from baselines.scene.augment import Augmentation
from baselines.scene.points import HALF_SIDE_M
from baselines.scene.sight import Moment
from baselines.text import SentenceTable, TextSpec
from sacil_tasks.errors import UsageError
from sacil_tasks.interface import SCENE_BOUNDS

CONFIG = tiny(CPU)


@pytest.fixture
def network() -> PolarNet:
    torch.manual_seed(0)
    return PolarNet(CONFIG, TEXT).eval()


def test_the_paper_preset_has_the_published_number_of_parameters() -> None:
    clip = TextSpec(name="clip", dim=512, max_tokens=77, fingerprint="")
    with torch.device("meta"):
        network = PolarNet(PAPER, clip)
    added_outputs = 6 * (768 + 1)  # D-polarnet-heads, D-grip
    assert sum(p.numel() for p in network.parameters()) == 14_150_537 + added_outputs


def test_batch_norm_keeps_its_statistics_in_double_precision() -> None:
    config = replace(PAPER, points=64, stages=(32, 16, 8, 4), neighbours=4)
    block = PolarNet(config, TEXT).double().encoder[0]
    near = torch.zeros(2, 32, 4, dtype=torch.int32)
    features, xyz = (torch.randn(2, 64, width).double() for width in (64, 3))
    block(features, xyz, near)
    kept = [b for n, b in block.named_buffers() if n.endswith("running_mean")]
    assert kept
    assert all(b.dtype == torch.float64 and b.any() for b in kept)


@pytest.mark.parametrize("rough", [False, True])
def test_the_paper_preset_learns_with_batch_norm(rough: bool) -> None:  # noqa: FBT001
    config = replace(PAPER, points=64, stages=(32, 16, 8, 4), neighbours=4)
    network = PolarNet(config, TEXT)
    with torch.autocast("cpu", torch.bfloat16, enabled=rough):
        loss, _ = network.loss(make_batch(network.sight, size=2))
    loss.backward()
    assert all(p.grad.isfinite().all() for p in network.parameters())


@torch.no_grad()
def test_the_order_of_points_changes_nothing(network: PolarNet) -> None:
    moment = random_moments(1)[0]
    order = [3, 1, 0, 2]
    names = ("rgb", "depth_mm", "intrinsics", "camera_in_base")
    parts = {name: getattr(moment.seen, name)[order] for name in names}
    shuffled = replace(moment, seen=replace(moment.seen, **parts))
    first, second = (make_inputs(network.sight, size=1, moments=[m]) for m in (moment, shuffled))
    assert torch.equal(
        network(first).action.position_in_cube, network(second).action.position_in_cube
    )


@torch.no_grad()
def test_the_answer_moves_with_the_scene(network: PolarNet) -> None:
    network.bottleneck.position.weight.zero_()  # the only place where the frame's origin enters
    shift_m = np.array([0.04, -0.1, 0.02])
    seen = random_moments(1)[0].seen
    moments = Moment(seen), Moment(seen, Augmentation(0.0, shift_m))
    before, after = (network(make_inputs(network.sight, size=1, moments=[m])) for m in moments)
    moved_m = (after.action.position_in_cube - before.action.position_in_cube) * HALF_SIDE_M
    np.testing.assert_allclose(moved_m[0], shift_m, atol=1e-5)
    assert torch.allclose(before.action.pose, after.action.pose, atol=1e-5)


@torch.no_grad()
@pytest.mark.parametrize("field", ["text", "step", "gripper_in_cube", "proprio"])
def test_the_answer_depends_on(network: PolarNet, field: str) -> None:
    inputs = make_inputs(network.sight, size=1)
    value = getattr(inputs, field)
    other = 1 - value if field == "proprio" else value + 1
    before, after = network(inputs), network(replace(inputs, **{field: other}))
    assert not torch.equal(before.heat, after.heat)
    assert not torch.equal(before.action.pose, after.action.pose)


def test_all_heat_on_one_point_answers_that_point_and_its_offset() -> None:
    places = torch.randn(2, 30, 3)
    heat = torch.full((2, 30), -1e4)
    heat[0, 7] = heat[1, 29] = 1e4
    expected = torch.stack([places[0, 7], places[1, 29]])
    torch.testing.assert_close(read_out(heat, places), expected)


def test_the_label_is_hottest_where_the_keyframe_is(network: PolarNet) -> None:
    batch = make_batch(network.sight)
    scene, aim = batch.inputs.scene, batch.labels.position_in_cube
    gripper = batch.inputs.gripper_in_cube[:, None, :3]
    target = heat_labels(batch.inputs, batch.labels)
    places = gripper + scene.xyz * scene.reach[:, None, None]
    assert torch.equal(target.argmax(-1), (places - aim[:, None]).norm(dim=-1).argmin(-1))
    torch.testing.assert_close(target.sum(-1), torch.ones(len(aim)))


def test_votes_are_taught_where_the_heat_should_be(network: PolarNet) -> None:
    batch = make_batch(network.sight)
    guess, aim = network(batch.inputs), batch.labels.position_in_cube
    label = heat_labels(batch.inputs, batch.labels)

    def error(votes: torch.Tensor) -> float:
        network.forward = lambda inputs: replace(guess, votes=votes)
        return float(network.loss(batch)[1]["bc/votes"])

    exact = aim[:, None].expand_as(guess.votes)
    assert error(exact) == 0
    assert error(exact + 0.02 / HALF_SIDE_M) == pytest.approx(0.02**2, rel=1e-4)
    aside = torch.zeros_like(exact)
    aside[torch.arange(len(label)), label.argmax(-1)] = 0.02 / HALF_SIDE_M
    share = float(label.amax(-1).mean())
    assert error(exact + aside) == pytest.approx(share * 0.02**2, rel=1e-4)


def test_all_names_of_a_grasp_cost_the_same(network: PolarNet) -> None:
    batch = make_batch(network.sight)
    turn = batch.labels.quaternion_wxyz
    twin = multiply(turn.numpy(), np.array([0.0, 0.0, 0.0, 1.0], np.float32))
    labels = [turn, -turn, torch.from_numpy(twin)]
    batches = [replace(batch, labels=replace(batch.labels, quaternion_wxyz=q)) for q in labels]
    losses = [network.loss(batch)[1]["bc/rotation"] for batch in batches]
    assert losses[0] > 0
    assert [float(loss) for loss in losses[1:]] == pytest.approx([float(losses[0])] * 2, rel=1e-5)


def test_tool_axes_are_columns_of_the_rotation_matrix() -> None:
    turns = bins_to_quaternion(torch.randint(72, (20, 3)))
    axes = tool_axes(turns).unflatten(-1, (2, 3))
    for column, axis in enumerate(([0, 0, 1], [1, 0, 0])):
        pure = np.r_[0.0, axis]
        inverse = turns.numpy() * [1, -1, -1, -1]
        expected = multiply(multiply(turns.numpy(), pure[None]), inverse)[:, 1:]
        np.testing.assert_allclose(axes[:, column], expected, atol=1e-5)


def test_a_checkpoint_acts_and_each_episode_for_itself(network: PolarNet, tmp_path: Path) -> None:
    identity = Identity(
        agent="polarnet",
        variant=None,
        preset="cpu",
        tasks=("pick_and_lift",),
        text=TEXT,
        config=CONFIG,
    )
    identity.save(tmp_path)
    checkpoint.save_weights(tmp_path, network.state_dict())
    known = {"lift it": np.ones((3, TEXT.dim), np.float16)}
    SentenceTable(TEXT, known).save(tmp_path / checkpoint.TEXT, known)
    policy = load_policy(checkpoint=tmp_path, tasks=("pick_and_lift",), variant=None)
    memory = policy.begin("lift it")
    rng = np.random.default_rng(0)
    seen = [synthetic.observation(rng, step) for step in range(2)]
    together, _ = policy.act(seen, [memory, memory])
    alone, _ = policy.act(seen[1:], [memory])
    np.testing.assert_allclose(together[1].position_m, alone[0].position_m, atol=1e-5)
    away_m = np.abs(alone[0].position_m - SCENE_BOUNDS.center_in_base)
    assert away_m.max() < SCENE_BOUNDS.side_m


@pytest.mark.parametrize(
    ("change", "words"),
    [({"heads": 5}, "--heads"), ({"stages": (4096, 64)}, "--stages")],
)
def test_sizes_that_do_not_fit_are_refused(change: dict, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        replace(PolarNetConfig(), **change)
