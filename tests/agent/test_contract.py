"""What every registered agent and variant must do; a new agent file is covered by its name."""

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from networks import TEXT, blank_moments, make_batch, make_inputs, registered, row, tiny

from baselines import checkpoint
from baselines.agent import Network, find_agent
from baselines.batch import Batch, Prediction
from baselines.checkpoint import Identity
from baselines.optim import Lamb
from baselines.text import SentenceTable


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


@pytest.fixture(params=registered())
def name(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def config(name: str) -> Any:
    spec, variant = find_agent(name)
    return tiny(spec.config("cpu", variant))


@pytest.fixture
def network(name: str, config: Any) -> Network:
    torch.manual_seed(0)
    return find_agent(name)[0].create(config, TEXT)


def batch_for(network: Network, **options: int) -> Batch:
    return make_batch(network.sight, goals=network.goal_sight, **options)


def assert_same(first: Prediction, second: Prediction, tolerance: float = 0.0) -> None:
    for field, value in vars(first).items():
        torch.testing.assert_close(getattr(second, field), value, rtol=0, atol=tolerance)


def test_presets_are_what_the_command_line_offers(name: str) -> None:
    assert {"cpu", "paper"} <= set(find_agent(name)[0].presets)


def test_one_batch_can_be_overfitted(network: Network, config: Any) -> None:
    batch = batch_for(network, size=2)
    optimiser = Lamb(network, weight_decay=0.0)
    for step in range(100):
        loss, _ = network.loss(batch)
        loss.backward()
        optimiser.step(3 * config.recipe.lr * (1 - step / 100))
    with torch.no_grad():
        found = network.eval().act(batch.inputs)
    labels = batch.labels
    distance = (found.position_in_cube - labels.position_in_cube).norm(dim=-1)
    assert distance.max() < 0.15
    assert torch.equal(found.gripper_open, labels.gripper_open == 1)
    assert torch.equal(found.ignore_collisions, labels.ignore_collisions == 1)


def test_the_loss_names_its_terms_as_detached_scalars(network: Network) -> None:
    loss, terms = network.loss(batch_for(network))
    assert loss.shape == ()
    assert loss.requires_grad
    assert terms
    assert all(term.shape == () and not term.requires_grad for term in terms.values())


def test_every_parameter_is_taught(network: Network) -> None:
    network.loss(batch_for(network))[0].backward()
    untaught = [name for name, parameter in network.named_parameters() if parameter.grad is None]
    assert untaught == []


@pytest.mark.parametrize("points", [0, 1])
def test_the_loss_is_finite_where_there_is_nothing_to_see(network: Network, points: int) -> None:
    batch = batch_for(network)
    blank = network.sight.look(blank_moments(4, points))
    goal = None if batch.goal is None else network.goal_sight.look(blank_moments(4, points))
    batch = replace(batch, inputs=replace(batch.inputs, scene=blank), goal=goal)
    loss, _ = network.loss(batch)
    loss.backward()
    assert loss.isfinite()
    assert all(p.grad.isfinite().all() for p in network.parameters() if p.grad is not None)


def test_a_batch_is_as_good_as_its_rows(network: Network) -> None:
    inputs = make_inputs(network.sight)
    network.eval()
    with torch.no_grad():
        together = network.act(inputs)
        for index in range(4):
            alone = network.act(row(inputs, index))
            expected = Prediction(**{k: v[index : index + 1] for k, v in vars(together).items()})
            assert_same(expected, alone, tolerance=1e-5)


def test_padding_of_the_text_changes_nothing(network: Network) -> None:
    inputs = make_inputs(network.sight)
    noise = torch.where(inputs.text_mask[..., None], inputs.text, torch.tensor(7.0))
    network.eval()
    with torch.no_grad():
        assert_same(network.act(inputs), network.act(replace(inputs, text=noise)), tolerance=1e-5)


def test_the_longest_instruction_is_read(network: Network) -> None:
    inputs = make_inputs(network.sight, size=1)
    long = replace(
        inputs,
        text=torch.randn(1, 77, TEXT.dim),
        text_mask=torch.ones(1, 77, dtype=torch.bool),
    )
    with torch.no_grad():
        assert network.eval().act(long).position_in_cube.isfinite().all()


def test_a_checkpoint_round_trip_is_exact(
    name: str, network: Network, config: Any, tmp_path: Path
) -> None:
    base, _, variant = name.partition(":")
    identity = Identity(
        agent=base,
        variant=variant or None,
        preset="cpu",
        tasks=("pick_and_lift",),
        text=TEXT,
        config=config,
    )
    identity.save(tmp_path)
    checkpoint.save_weights(tmp_path, network.state_dict())
    SentenceTable(TEXT, {"lift": torch.ones(3, TEXT.dim).half().numpy()}).save(
        tmp_path / checkpoint.TEXT, ["lift"]
    )
    loaded = checkpoint.load(tmp_path, agent=name, tasks=("pick_and_lift",))
    assert asdict(loaded.identity.config) == asdict(config)
    inputs = make_inputs(network.sight)
    with torch.no_grad():
        assert_same(network.eval().act(inputs), loaded.network.act(inputs))


def test_half_precision_training_stays_close(network: Network) -> None:
    batch = batch_for(network)
    exact, _ = network.loss(batch)
    with torch.autocast("cpu", torch.bfloat16):
        rough, _ = network.loss(batch)
    assert rough.dtype == torch.float32
    assert rough.item() == pytest.approx(exact.item(), rel=0.02)
