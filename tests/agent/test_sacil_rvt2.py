"""SACIL-RVT-2 acts like RVT-2; the contrasts read its coarse stage."""

from dataclasses import replace

import pytest
import torch
from networks import TEXT, changed, gradients, make_batch, make_inputs, tiny

from baselines.agents import rvt2
from baselines.agents.rvt2 import DRAWS, Rvt2
from baselines.scene.sight import ViewSight, ZoomSight
from baselines.scene.views import THREE_VIEWS
from sacil_agent.agents.sacil_rvt2 import CPU, PAPER, SacilRvt2

CONFIG = tiny(CPU)
SIGHT = ZoomSight(CONFIG.pixels, draws=DRAWS)
GOALS = ViewSight(CONFIG.pixels, THREE_VIEWS)


@pytest.fixture
def network() -> SacilRvt2:
    torch.manual_seed(0)
    return SacilRvt2(CONFIG, TEXT)


def test_the_presets_are_those_of_rvt2() -> None:
    for ours, theirs in ((CPU, rvt2.CPU), (PAPER, rvt2.PAPER)):
        assert vars(theirs).items() <= vars(ours).items()


def test_it_acts_like_rvt2_with_the_same_weights(network: SacilRvt2) -> None:
    plain = Rvt2(tiny(rvt2.CPU), TEXT)
    shared = {name: w for name, w in network.state_dict().items() if name in plain.state_dict()}
    plain.load_state_dict(shared)
    inputs = make_inputs(SIGHT)
    with torch.no_grad():
        ours, theirs = network.eval().act(inputs), plain.eval().act(inputs)
    assert all(torch.equal(value, getattr(theirs, name)) for name, value in vars(ours).items())


def test_the_contrasts_are_added_to_the_loss_of_rvt2(network: SacilRvt2) -> None:
    batch = make_batch(SIGHT, goals=GOALS)
    cloning, _ = Rvt2.loss(network, batch)
    network.config = replace(CONFIG, image_text_weight=0.5, current_goal_weight=0.25)
    total, terms = network.loss(batch)
    torch.testing.assert_close(total, cloning + terms["itc/loss"] / 2 + terms["cgc/loss"] / 4)
    assert {name.partition("/")[0] for name in terms} == {"bc", "itc", "cgc"}


@pytest.mark.parametrize("contrast", ["image_text", "current_goal"])
def test_contrasts_teach_the_coarse_stage_alone(network: SacilRvt2, contrast: str) -> None:
    batch = make_batch(SIGHT, goals=GOALS)
    network.config = replace(CONFIG, image_text_weight=1.0, current_goal_weight=1.0)
    with torch.no_grad():
        base = network.loss(batch)[0]
    weights = {"image_text_weight": 0.0, "current_goal_weight": 0.0}
    network.config = replace(CONFIG, **weights | {f"{contrast}_weight": 1.0})
    with_one = network.loss(batch)[0]
    assert with_one < base
    (with_one - Rvt2.loss(network, batch)[0]).backward()
    taught = {name for name, g in gradients(network).items() if g.abs().max() > 1e-4}
    assert taught
    assert not [name for name in taught if name.startswith(("fine.", "head."))]
    assert any(name.startswith("coarse.view_blocks") for name in taught)


def test_image_text_features_have_not_seen_the_words(network: SacilRvt2) -> None:
    batch = make_batch(SIGHT, goals=GOALS)
    other = replace(batch, inputs=changed(batch.inputs, text=batch.inputs.text + 1))
    with torch.no_grad():
        seen, heard = network.coarse_look(batch).read, network.coarse_look(other).read
    assert torch.equal(seen.alone, heard.alone)
    assert not torch.equal(seen.joined, heard.joined)


def test_goals_change_the_goal_contrast_and_nothing_else(network: SacilRvt2) -> None:
    batch = make_batch(SIGHT, goals=GOALS)
    assert batch.goal is not None
    flipped = replace(batch.goal, views=batch.goal.views.flip(0))
    _, terms = network.loss(batch)
    _, other = network.loss(replace(batch, goal=flipped))
    differing = {name for name in terms if not torch.equal(terms[name], other[name])}
    assert "cgc/loss" in differing
    assert all(name.startswith("cgc/") for name in differing)
