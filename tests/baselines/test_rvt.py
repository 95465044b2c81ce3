"""RVT's published size, and what may look at what."""

from dataclasses import replace

import pytest
import torch
from networks import TEXT, make_inputs, tiny

from baselines.agents.rvt import CPU, PAPER, Rvt, RvtConfig
from baselines.layers.multiview import last_token, roughened, trimmed_text, within_views
from baselines.scene.sight import Views, ViewSight
from baselines.text import TextSpec
from sacil_tasks.errors import UsageError

CONFIG = tiny(CPU)
SIGHT = ViewSight(CONFIG.pixels)


@pytest.fixture
def network() -> Rvt:
    torch.manual_seed(0)
    return Rvt(CONFIG, TEXT)


def test_the_paper_preset_has_the_published_number_of_parameters() -> None:
    clip = TextSpec(name="clip", dim=512, max_tokens=77, fingerprint="")
    with torch.device("meta"):
        published = Rvt(replace(PAPER, proprio_width=4), clip)
        ours = Rvt(PAPER, clip)
    assert sum(p.numel() for p in published.parameters()) == 36_348_093
    # Two proprioceptive numbers instead of four (D-proprio).
    assert sum(p.numel() for p in ours.parameters()) == 36_348_093 - 2 * 64


def test_view_layers_keep_views_apart(network: Rvt) -> None:
    tokens = torch.randn(1, 5 * CONFIG.grid**2, CONFIG.width)
    touched = tokens.clone()
    touched[:, : CONFIG.grid**2] += 1
    with torch.no_grad():
        before = within_views(network.view_blocks, tokens).unflatten(1, (5, -1))
        after = within_views(network.view_blocks, touched).unflatten(1, (5, -1))
    assert not torch.allclose(before[:, 0], after[:, 0])
    assert torch.equal(before[:, 1:], after[:, 1:])


@pytest.mark.parametrize("field", ["scene", "text", "proprio"])
def test_every_view_hears_of_a_change_in(network: Rvt, field: str) -> None:
    inputs = make_inputs(SIGHT, size=1)
    value = getattr(inputs, field)
    other = Views(value.views.flip(1)) if field == "scene" else value + 1
    with torch.no_grad():
        before = network(inputs).heatmaps
        after = network(replace(inputs, **{field: other})).heatmaps
    assert ((before - after).abs().amax(dim=(-1, -2)) > 0).all()


def test_more_proprioceptive_numbers_than_given_are_zeros(network: Rvt) -> None:
    inputs = make_inputs(SIGHT)
    narrow, wide = network.eval(), Rvt(replace(CONFIG, proprio_width=4), TEXT).eval()
    weights, first = wide.state_dict(), "proprio.linear.weight"
    narrow.load_state_dict(weights | {first: weights[first][:, :2]})
    with torch.no_grad():
        assert torch.equal(wide(inputs).heatmaps, narrow(inputs).heatmaps)


def test_image_noise_is_bounded_and_spares_the_original() -> None:
    scene = make_inputs(SIGHT).scene
    assert roughened(scene, 0.0) is scene
    noise = roughened(scene, 0.1).views - scene.views.clamp(-1, 1)
    assert 0 < noise.abs().max() <= 0.1 + 1e-6


def test_text_is_trimmed_to_the_longest_sentence() -> None:
    inputs = make_inputs(SIGHT)
    text, mask = trimmed_text(inputs)
    assert text.shape[1] == mask.shape[1] == int(inputs.text_mask.sum(1).max())
    assert torch.equal(last_token(inputs)[2], inputs.text[2, int(inputs.text_mask[2].sum()) - 1])


@pytest.mark.parametrize(
    ("change", "words"),
    [({"pixels": 100}, "multiple of --patch"), ({"patch": 8, "pixels": 96}, "--pyramid")],
)
def test_sizes_that_do_not_fit_are_refused(change: dict[str, int], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        replace(RvtConfig(), **change)
