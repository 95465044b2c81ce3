"""Splits: one registry, the same scenes, and words or sizes that differ as they say."""

from collections import Counter

import numpy as np
import pytest

from sacil_tasks import scenes
from sacil_tasks.catalog import task_names, task_spec
from sacil_tasks.contents import clutter_xy_m, draw_contents
from sacil_tasks.errors import UsageError
from sacil_tasks.instructions import all_templates, official_sentences, variations
from sacil_tasks.sizes import FAMILIES, LABELS
from sacil_tasks.splits import FINE_RATIOS, GROUPS, SPLITS, expand, plan_splits, why_not
from sacil_tasks.wording import draw_meaning, say

PAIRS = [(task, split) for task in task_names() for split in task_spec(task).splits]
ASKED_FOR = (
    *("canon", "shift_down", "shift_up", "mixed", "clutter", "pair"),
    *("para_size", "para_verb", "para_both"),
    *("unique_colour", "blank_text", "shuffled_text", "single_object"),
)
MAX_WORDS = 26
"""A sentence of MiniLM has at most 32 tokens."""


def _seeds(task: str, count: int) -> list[int]:
    return [scenes.scene_seed("val", 0, task, index, 0) for index in range(count)]


def _heard(task: str, split: str, seed: int) -> list[str]:
    """What is said under each variation of a scene."""
    spec = task_spec(task)
    _, template = draw_meaning(spec, split, seed)
    colour_of = draw_contents(spec, split, seed).colour_of
    return [
        say(spec, split, slots, template, seed=seed, colour_of=colour_of)
        for slots in variations(spec, split)
    ]


def test_the_registry_holds_every_split_of_the_benchmark() -> None:
    assert set(SPLITS) == {*ASKED_FOR, *GROUPS["fine"]}
    assert [SPLITS[name].ratio for name in GROUPS["fine"]] == list(FINE_RATIOS)
    assert expand(["fine", "canon", "fine"]) == (*GROUPS["fine"], "canon")


@pytest.mark.parametrize("task", task_names())
def test_a_split_is_had_or_refused_with_a_reason(task: str) -> None:
    spec = task_spec(task)
    for split in SPLITS:
        assert (why_not(spec, split) is None) == (split in spec.splits)
    assert {"canon", "shift_down", "mixed", "para_size", "blank_text"} <= set(spec.splits)
    grasped_and_big = len(FAMILIES[spec.family].rungs_m) < 5
    assert ("shift_up" in spec.splits) == (not grasped_and_big)


def test_a_pair_asked_for_by_name_is_refused_and_under_a_suite_told() -> None:
    specs = [task_spec(task) for task in ("pick_up_cup", "push_buttons")]
    with pytest.raises(UsageError, match="pick_up_cup has no split shift_up: its largest size"):
        plan_splits(specs, ["canon", "shift_up"], strict=True)
    pairs, missing = plan_splits(specs, ["canon", "shift_up"], strict=False)
    assert set(pairs) == {
        *[("pick_up_cup", "canon"), ("push_buttons", "canon"), ("push_buttons", "shift_up")]
    }
    assert set(missing) == {("pick_up_cup", "shift_up")}
    with pytest.raises(UsageError, match="has no split shift_up"):
        plan_splits(specs[:1], ["shift_up"], strict=False)
    with pytest.raises(UsageError, match="Did you mean shift_up"):
        plan_splits(specs, ["shift_upp"], strict=False)


@pytest.mark.parametrize(("task", "split"), PAIRS)
def test_contents_follow_seed_and_split_alone_and_keep_the_order_of_sizes(
    task: str, split: str
) -> None:
    spec = task_spec(task)
    for seed in _seeds(task, 10):
        first, again = (draw_contents(spec, split, seed) for _ in range(2))
        canon = draw_contents(spec, "canon", seed)
        assert np.array_equal(first.sizes_m, again.sizes_m)
        assert np.array_equal(np.argsort(first.sizes_m), np.argsort(canon.sizes_m))
        there = first.present
        assert np.array_equal(
            np.argsort(first.sizes_m[there]), np.argsort(first.labels[there]), equal_nan=False
        )
        assert sorted(first.labels) == [0, 1, 2]


@pytest.mark.parametrize("task", task_names())
def test_the_scene_itself_knows_no_split(task: str) -> None:
    """Sizes under `canon` are those of the geometry: nothing was drawn from its stream."""
    for seed in _seeds(task, 10):
        geometry, canon = scenes.draw_geometry(seed), draw_contents(task_spec(task), "canon", seed)
        rungs_m = np.array(FAMILIES[task_spec(task).family].rungs_m)
        assert np.array_equal(canon.sizes_m, rungs_m[1 + geometry.labels] * geometry.jitter)
        assert np.array_equal(canon.rgb, geometry.rgb)
        assert canon.clutter is None
        assert canon.present.all()


@pytest.mark.parametrize("task", task_names())
def test_mixed_shows_every_triple_alike(task: str) -> None:
    spec = task_spec(task)
    ladder = np.array(FAMILIES[spec.family].rungs_m)
    smallest = [draw_contents(spec, "mixed", seed).sizes_m.min() for seed in _seeds(task, 200)]
    rungs = Counter(np.abs(np.log(np.array(smallest)[:, None] / ladder)).argmin(1).tolist())
    triples = len(ladder) - 2
    assert set(rungs) == set(range(triples))
    assert min(rungs.values()) > 0.7 * 200 / triples


@pytest.mark.parametrize("task", task_names())
def test_a_pair_is_any_two_sizes_named_by_comparison(task: str) -> None:
    spec = task_spec(task)
    left_out = Counter()
    for seed in _seeds(task, 150):
        contents = draw_contents(spec, "pair", seed)
        left_out[int(np.argsort(np.argsort(contents.sizes_m))[~contents.present][0])] += 1
        assert sorted(contents.labels[contents.present]) == [0, 2]
    assert min(left_out.values()) > 30
    for sentence in _heard(task, "pair", 3):
        assert {"smaller", "larger"} & set(sentence.replace(",", "").split())


@pytest.mark.parametrize("task", task_names())
def test_named_colours_are_those_shown(task: str) -> None:
    spec = task_spec(task)
    for seed in _seeds(task, 20):
        contents = draw_contents(spec, "unique_colour", seed)
        shown = [scenes.COLOURS[contents.colour_of[LABELS[label]]] for label in contents.labels]
        assert np.array_equal(shown, contents.rgb)
        assert len(set(contents.colour_of.values())) == 3


@pytest.mark.parametrize("task", [t for t in task_names() if "clutter" in task_spec(t).splits])
def test_clutter_stands_clear_of_every_candidate(task: str) -> None:
    spec = task_spec(task)
    for seed in _seeds(task, 100):
        layout = scenes.draw_layout(spec, seed)
        gaps_m = np.linalg.norm(clutter_xy_m(spec, layout, seed) - layout.xy_m, axis=1)
        assert gaps_m.min() > 0.1
        assert draw_contents(spec, "clutter", seed).clutter.family != spec.family


@pytest.mark.parametrize(("task", "split"), PAIRS)
def test_words_tell_meanings_apart_unless_the_split_hides_them(task: str, split: str) -> None:
    for seed in _seeds(task, 15):
        heard = _heard(task, split, seed)
        count = 1 if split == "blank_text" else len(variations(task_spec(task), split))
        assert len(set(heard)) == count
        assert all(len(sentence.split()) <= MAX_WORDS for sentence in heard)
        assert not any("{" in sentence for sentence in heard)


@pytest.mark.parametrize("task", task_names())
def test_paraphrases_were_never_heard_and_the_rest_was(task: str) -> None:
    spec = task_spec(task)
    official = set(official_sentences(spec))
    for split in set(spec.splits) - {"blank_text"}:
        heard = {words for seed in _seeds(task, 15) for words in _heard(task, split, seed)}
        new = split.startswith("para") or split in ("pair", "unique_colour")
        assert heard.isdisjoint(official) if new else heard <= official


@pytest.mark.parametrize("task", task_names())
def test_shuffled_words_know_nothing_of_the_target(task: str) -> None:
    """Over the words of a scene each sentence is heard once, and over scenes by chance alone."""
    hits = 0
    for seed in _seeds(task, 200):
        shuffled, plain = _heard(task, "shuffled_text", seed), _heard(task, "canon", seed)
        assert sorted(shuffled) == sorted(plain)
        hits += shuffled == plain
    chance = 200 / len(variations(task_spec(task)))
    assert abs(hits - chance) < 4 * np.sqrt(chance)


@pytest.mark.parametrize("task", task_names())
def test_a_noun_follows_every_size(task: str) -> None:
    """Or a phrase such as 'block that is neither ...' would find nothing to hold on to."""
    spec = task_spec(task)
    odd = {name: f"ODD {name} {{noun}}" for name in LABELS}
    from sacil_tasks.instructions import render

    for template in range(len(all_templates(spec))):
        sentence = render(spec, variations(spec)[0], template, odd)
        assert sentence.count("ODD") == len(spec.slots)
