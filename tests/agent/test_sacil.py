"""SACIL's order of operations, its queries, its goal branch and its ablations."""

from dataclasses import replace
from itertools import combinations

import pytest
import torch
from networks import TEXT, changed, gradients, make_batch, make_inputs, tiny

from baselines.optim import Lamb
from baselines.scene.sight import Views, ViewSight
from sacil_agent.agents.sacil import CPU, PAPER, VARIANTS, Sacil

CONFIG = tiny(CPU)
SIGHT = ViewSight(CONFIG.pixels)


@pytest.fixture
def network() -> Sacil:
    torch.manual_seed(0)
    return Sacil(CONFIG, TEXT)


def other_words_and_hands(size: int = 4) -> dict[str, torch.Tensor]:
    other = make_inputs(SIGHT, size=size, seed=9)
    return {"text": other.text, "text_mask": other.text_mask.flip(0), "proprio": other.proprio}


def test_image_text_features_have_seen_neither_words_nor_proprioception(network: Sacil) -> None:
    inputs = make_inputs(SIGHT)
    with torch.no_grad():
        seen, other = network(inputs), network(changed(inputs, **other_words_and_hands()))
    assert torch.equal(seen.image, other.image)
    assert not torch.equal(seen.situation, other.situation)
    assert not torch.equal(seen.logits.heatmaps, other.logits.heatmaps)


@pytest.mark.parametrize("field", ["text", "proprio"])
def test_the_action_depends_on(network: Sacil, field: str) -> None:
    inputs = make_inputs(SIGHT)
    with torch.no_grad():
        seen = network(inputs)
        other = network(changed(inputs, **{field: getattr(inputs, field) + 1}))
    assert not torch.equal(seen.logits.heatmaps, other.logits.heatmaps)


def test_the_papers_order_lets_the_words_into_image_text_features() -> None:
    torch.manual_seed(0)
    network = Sacil(VARIANTS["conditioned_contrast"](CONFIG), TEXT)
    inputs = make_inputs(SIGHT)
    with torch.no_grad():
        seen, other = network(inputs), network(changed(inputs, **other_words_and_hands()))
    assert not torch.equal(seen.image, other.image)


def test_five_queries_stay_apart_after_a_step(network: Sacil) -> None:
    assert network.queries is not None
    network.loss(make_batch(SIGHT, goals=SIGHT))[0].backward()
    Lamb(network, weight_decay=0.0).step(0.01)
    queries = network.queries.initial.detach()[0]
    assert len(queries) == 5
    for first, second in combinations(queries, 2):
        assert (first - second).norm() > 1e-3


def test_goals_change_the_goal_contrast_and_nothing_else(network: Sacil) -> None:
    batch = make_batch(SIGHT, goals=SIGHT)
    assert batch.goal is not None
    _, terms = network.loss(batch)
    _, other = network.loss(replace(batch, goal=Views(batch.goal.views.flip(0))))
    differing = {name for name in terms if not torch.equal(terms[name], other[name])}
    assert "cgc/loss" in differing
    assert all(name.startswith("cgc/") for name in differing)


def test_goal_gradients_reach_the_shared_encoder(network: Sacil) -> None:
    goal = make_batch(SIGHT, goals=SIGHT).goal
    assert goal is not None
    network.goal_features(goal).square().sum().backward()
    reached = {name.partition(".")[0] for name in gradients(network)}
    assert reached == {"encoder", "goal_position", "lift", "view_blocks"}


@pytest.mark.parametrize(
    ("variant", "contrasts"),
    [
        (None, {"itc", "cgc"}),
        ("no_queries", {"itc", "cgc"}),
        ("no_contrast", set()),
        ("image_text", {"itc"}),
        ("conditioned_contrast", {"itc", "cgc"}),
        ("patch_stem", {"itc", "cgc"}),
    ],
)
def test_variants_have_the_contrasts_they_name(variant: str | None, contrasts: set[str]) -> None:
    network = Sacil(VARIANTS[variant](CONFIG) if variant else CONFIG, TEXT)
    assert (network.goal_sight is not None) is ("cgc" in contrasts)
    _, terms = network.loss(make_batch(SIGHT, goals=network.goal_sight))
    assert {name.partition("/")[0] for name in terms} == {"bc"} | contrasts


def test_without_queries_the_mean_visual_token_is_contrasted() -> None:
    network = Sacil(VARIANTS["no_queries"](CONFIG), TEXT)
    inputs = make_inputs(SIGHT)
    with torch.no_grad():
        tokens, _ = network.visual_tokens(inputs.scene, network.position)
        assert torch.equal(network(inputs).image, tokens.mean(dim=1))


def test_the_paper_preset_has_the_papers_sizes() -> None:
    assert (PAPER.pixels, PAPER.grid, PAPER.width) == (220, 20, 512)
    assert (PAPER.view_layers, PAPER.queries, PAPER.joint_layers) == (2, 5, 4)
    recipe = PAPER.recipe
    assert (recipe.samples // recipe.batch, recipe.batch, recipe.lr) == (133_000, 18, 1.8e-3)


def test_the_cpu_preset_keeps_the_papers_layers() -> None:
    assert (CPU.view_layers, CPU.queries, CPU.joint_layers) == (2, 5, 4)
