"""Words: every meaning has sentences, no two meanings share one, mistakes name what is known."""

import numpy as np
import pytest

from sacil_tasks import instructions
from sacil_tasks.catalog import suite_tasks, task_names, task_spec
from sacil_tasks.errors import UsageError
from sacil_tasks.scenes import COLOURS
from sacil_tasks.sizes import LABELS

TASKS = task_names()


@pytest.mark.parametrize("task", TASKS)
def test_every_ordered_choice_of_labels_is_a_variation(task: str) -> None:
    spec = task_spec(task)
    choices = instructions.variations(spec)
    assert len(choices) == {1: 3, 2: 6}[len(spec.slots)] * 3 ** len(spec.receptacles)
    assert len({tuple(slots.values()) for slots in choices}) == len(choices)
    for slots in choices:
        assert len(set(spec.size_words(slots))) == len(spec.slots)
        assert all(slots[name] in words for name, words in spec.blanks.items())


@pytest.mark.parametrize("task", TASKS)
def test_sentences_tell_meanings_apart(task: str) -> None:
    spec = task_spec(task)
    sentences = [
        instructions.render(spec, slots, template)
        for slots in instructions.variations(spec)
        for template in range(len(instructions.all_templates(spec)))
    ]
    assert len(set(sentences)) == len(sentences)
    assert not any("{" in sentence for sentence in sentences)
    assert set(instructions.official_sentences(spec)) < set(sentences)


@pytest.mark.parametrize("task", TASKS)
def test_sentences_name_no_colour_and_each_label_once(task: str) -> None:
    spec = task_spec(task)
    for sentence in instructions.official_sentences(spec):
        words = sentence.replace(",", "").split()
        assert not set(words) & set(COLOURS)
        assert sum(words.count(label) for label in LABELS) == len(spec.slots)


@pytest.mark.parametrize("task", TASKS)
def test_words_are_drawn_uniformly_from_training_templates(task: str) -> None:
    spec, rng = task_spec(task), np.random.default_rng(0)
    drawn = [instructions.draw_words(spec, rng) for _ in range(3000)]
    for slots in instructions.variations(spec):
        share = np.mean([slots == words for words, _ in drawn])
        assert share == pytest.approx(1 / len(instructions.variations(spec)), abs=0.04)
    assert {template for _, template in drawn} == set(range(len(spec.templates)))


@pytest.mark.parametrize(
    ("slots", "message"),
    [
        ({"size": "smal"}, "Did you mean small"),
        ({"sise": "small"}, "Did you mean size"),
        ({}, "choose one of"),
    ],
)
def test_wrong_slots_are_explained(slots: dict, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        instructions.check_slots(task_spec("pick_and_lift"), slots)


def test_a_wrong_drawer_is_explained() -> None:
    spec = task_spec("put_item_in_drawer")
    with pytest.raises(UsageError, match="Did you mean bottom"):
        instructions.check_slots(spec, {"size": "small", "drawer": "botom"})
    with pytest.raises(UsageError, match="choose one of"):
        instructions.check_slots(spec, {"size": "small"})


def test_one_word_for_two_slots_is_refused() -> None:
    with pytest.raises(UsageError, match="each size with another word"):
        instructions.check_slots(task_spec("push_buttons"), {"first": "small", "second": "small"})


@pytest.mark.parametrize("template", [-1, 99, 0.0, True, "0"])
def test_wrong_templates_are_explained(template: object) -> None:
    with pytest.raises(UsageError, match="templates 0 to"):
        instructions.check_template(task_spec("pick_and_lift"), template)  # type: ignore[arg-type]


def test_unknown_tasks_and_suites_name_the_nearest() -> None:
    with pytest.raises(UsageError, match="Did you mean pick_and_lift"):
        task_spec("pick_and_lfit")
    with pytest.raises(UsageError, match="Did you mean single"):
        suite_tasks("singel")


def test_suites_hold_whole_tasks() -> None:
    assert suite_tasks("slice") == ("pick_and_lift", "pick_up_cup", "push_buttons")
    assert set(suite_tasks("single")) | set(suite_tasks("dual")) == set(suite_tasks("all"))
