"""Act3D: published sizes, what moving a scene may change, and what the losses call equal."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from networks import TEXT, blank_moments, make_batch, make_inputs, tiny
from safetensors.torch import save_file
from scipy.spatial.transform import Rotation
from torch import Tensor

from baselines.agents.act3d import (
    CPU,
    PAPER,
    Act3d,
    Act3dConfig,
    Cells,
    Detection,
    Level,
    detection_loss,
)
from baselines.batch import Inputs
from baselines.layers.resnet import ResNet50
from baselines.layers.rotary import turns
from baselines.scene.sight import CameraSight, Pictures
from baselines.text import TextSpec
from sacil_tasks.errors import UsageError
from sacil_tasks.interface import SCENE_BOUNDS

CONFIG = tiny(CPU)
SIGHT = CameraSight(remembers=False)
CLIP = TextSpec(name="clip", dim=512, max_tokens=77, fingerprint="")


@pytest.fixture
def network() -> Act3d:
    torch.manual_seed(0)
    return Act3d(CONFIG, TEXT).eval()


def mute(inputs: Inputs) -> Inputs:
    """No words: they are the only thing that has a place of its own."""
    return replace(inputs, text_mask=torch.zeros_like(inputs.text_mask))


def shifted(inputs: Inputs[Pictures], shift: Tensor) -> Inputs[Pictures]:
    """The whole scene, hand included, somewhere else."""
    scene = inputs.scene
    xyz = scene.xyz_in_cube + shift[:, None, None]
    gripper = inputs.gripper_in_cube + torch.nn.functional.pad(shift, (0, 4))
    return replace(inputs, scene=replace(scene, xyz_in_cube=xyz), gripper_in_cube=gripper)


def detect(network: Act3d, inputs: Inputs[Pictures], shift: Tensor) -> Detection:
    """Answer with ghosts near the guess, moved by `shift` at the first level."""
    generator = torch.Generator().manual_seed(1)

    def place(level: int, guess: Tensor) -> Tensor:
        cloud = (2 * torch.rand(len(guess), 50, 3, generator=generator) - 1) / 4**level
        return cloud + (guess[:, None] if level else shift)

    with torch.no_grad():
        return network(inputs, place)


def test_moving_everything_changes_no_score(network: Act3d) -> None:
    # All cells are read: which are the nearest to the cube's centre is no matter of scores.
    network.config = replace(CONFIG, coarse_cells=4096)
    inputs, shift = mute(make_inputs(SIGHT)), torch.tensor([0.11, -0.07, 0.2])
    here = detect(network, inputs, torch.zeros(3))
    there = detect(network, shifted(inputs, shift), shift)
    for before, after in zip(here.levels, there.levels, strict=True):
        torch.testing.assert_close(after.ghosts_in_cube, before.ghosts_in_cube + shift)
        assert (after.scores - before.scores).abs().max() < 1e-5
        assert before.scores.std(dim=-1).min() > 1e-2, "a ghost's place matters"
    torch.testing.assert_close(there.action.pose, here.action.pose, rtol=0, atol=1e-5)


def test_moving_the_hand_alone_changes_scores(network: Act3d) -> None:
    inputs = mute(make_inputs(SIGHT))
    moved = replace(inputs, gripper_in_cube=inputs.gripper_in_cube + 0.3)
    zero = torch.zeros(3)
    before, after = detect(network, inputs, zero), detect(network, moved, zero)
    assert (before.levels[0].scores - after.levels[0].scores).abs().max() > 1e-4


def test_no_pair_of_channels_turns_too_slowly_to_tell_places_apart() -> None:
    across = SCENE_BOUNDS.side_m * torch.linspace(0, 1, 50)[None, :, None].expand(-1, -1, 3)
    code = turns(across, CPU.embedding, CPU.rotary_rad_per_m, CPU.rotary_span)
    assert (code - code[:, :1]).abs().amax(dim=1).min() > 0.5


def test_words_change_scores_and_action(network: Act3d) -> None:
    inputs, zero = make_inputs(SIGHT), torch.zeros(3)
    before = detect(network, inputs, zero)
    after = detect(network, replace(inputs, text=-inputs.text), zero)
    assert (before.levels[0].scores - after.levels[0].scores).abs().max() > 1e-3
    assert (before.action.pose - after.action.pose).abs().max() > 1e-3


def test_answers_are_the_same_every_time(network: Act3d) -> None:
    inputs = make_inputs(SIGHT)
    with torch.no_grad():
        first, state = network.act(inputs), torch.get_rng_state()
        again = network.act(inputs)
    assert torch.equal(torch.get_rng_state(), state)
    for name, value in vars(first).items():
        assert torch.equal(value, getattr(again, name))


def test_unseen_cells_have_no_say(network: Act3d) -> None:
    inputs = replace(make_inputs(SIGHT, size=1), scene=SIGHT.look(blank_moments(1, points=0)))
    loud = replace(inputs, scene=replace(inputs.scene, rgb=255 - inputs.scene.rgb))
    zero = torch.zeros(3)
    before, after = detect(network, inputs, zero), detect(network, loud, zero)
    torch.testing.assert_close(before.levels[-1].scores, after.levels[-1].scores)


def test_the_nearest_cells_are_taken_and_unseen_ones_last() -> None:
    xyz = torch.linspace(-1, 1, 21)[None, :, None] * torch.tensor([1.0, 0.0, 0.0])
    seen = torch.ones(1, 21, dtype=torch.bool)
    seen[0, 15] = False
    near = Cells(xyz, xyz, seen).nearest(torch.tensor([[0.48, 0.0, 0.0]]), 3)
    assert sorted(near.xyz_in_cube[0, :, 0].tolist()) == pytest.approx([0.3, 0.4, 0.6])
    assert near.seen.all()
    assert Cells(xyz, xyz, ~seen).nearest(torch.zeros(1, 3), 3).seen.sum() == 1


def test_training_draws_new_ghosts_from_the_global_generator(network: Act3d) -> None:
    batch = make_batch(SIGHT)
    losses = []
    for seed in (1, 1, 2):
        torch.manual_seed(seed)
        losses.append(network.loss(batch)[0].item())
    assert losses[0] == losses[1] != losses[2]


@pytest.mark.parametrize(("embedding", "published"), [(60, 564_965), (120, 1_720_325)])
def test_the_paper_preset_has_the_published_number_of_parameters(
    embedding: int, published: int
) -> None:
    with torch.device("meta"):
        network = Act3d(replace(PAPER, embedding=embedding, heads=2), CLIP)
    beside_trunk = sum(
        p.numel() for name, p in network.named_parameters() if not name.startswith("trunk")
    )
    unread_outputs = 3 * (9 * embedding**2 + embedding)  # D-act3d-outputs
    added_outputs = 6 * (embedding + 1)  # D-act3d-collision, D-grip
    assert beside_trunk == published - unread_outputs + added_outputs


def test_a_frozen_trunk_holds_clips_weights_and_keeps_them(tmp_path: Path) -> None:
    torch.manual_seed(0)
    original = ResNet50(frozen=True)
    weights = {f"visual.{name}": tensor for name, tensor in original.state_dict().items()}
    path = tmp_path / "clip.safetensors"
    save_file(weights | {"logit_scale": torch.ones(1)}, path)
    network = Act3d(replace(PAPER, clip_weights=str(path)), TEXT)
    network.load_pretrained()
    assert not any(module.training for module in network.train().trunk.modules())
    assert not any(p.requires_grad for p in network.trunk.parameters())
    image = torch.rand(1, 3, 64, 64)
    found, expected = network.trunk(image), original.eval()(image)
    assert [m.shape[-1] for m in found] == [32, 16, 8, 4, 2]
    for a, b in zip(found, expected, strict=True):
        assert torch.equal(a, b)


def test_weights_of_another_network_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.safetensors"
    save_file({"visual.conv1.weight": torch.ones(32, 3, 3, 3)}, path)
    for wrong in (path, tmp_path / "missing.safetensors"):
        with pytest.raises(UsageError, match="RN50"):
            Act3d(replace(PAPER, clip_weights=str(wrong)), TEXT).load_pretrained()


def test_signs_and_twins_teach_the_same(network: Act3d) -> None:
    batch = make_batch(SIGHT)
    label = batch.labels.quaternion_wxyz
    half_turn = Rotation.from_euler("z", 180, degrees=True)
    turned = Rotation.from_quat(label.numpy(), scalar_first=True) * half_turn
    twin = torch.tensor(turned.as_quat(scalar_first=True), dtype=torch.float32)
    losses = []
    for same in (label, -label, twin, -twin):
        torch.manual_seed(0)
        labels = replace(batch.labels, quaternion_wxyz=same)
        losses.append(network.loss(replace(batch, labels=labels))[1]["bc/rotation"].item())
    assert losses[0] > 0
    assert losses == pytest.approx(losses[:1] * 4, rel=1e-5)


def test_the_position_loss_is_least_for_scores_that_fall_with_distance() -> None:
    places, spread = torch.rand(2, 50, 3), 0.03
    target = torch.rand(2, 3)
    distance = (places - target[:, None]).norm(dim=-1)
    best = detection_loss([Level(places, -distance / spread)], target, spread)
    for scores in (torch.zeros(2, 50), -distance / (2 * spread), torch.randn(2, 50)):
        assert detection_loss([Level(places, scores)], target, spread) > best


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"embedding": 64}, "multiple of 6 channels"),
        ({"embedding": 60, "heads": 4}, "heads"),
        ({"ghosts_acting": (100, 100)}, "levels"),
    ],
)
def test_sizes_that_do_not_fit_are_refused(change: dict[str, object], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        replace(Act3dConfig(), **change)
