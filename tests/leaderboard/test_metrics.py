"""Metrics: policies with known habits get the numbers that these habits deserve."""

from dataclasses import replace
from itertools import cycle

import numpy as np
import pytest
from made_up import make_records

from leaderboard import metrics
from leaderboard.plan import words_per_scene
from leaderboard.records import EpisodeRecord
from leaderboard.stats import Tally
from leaderboard.summary import cells, row
from sacil_tasks.catalog import task_names, task_spec
from sacil_tasks.contents import draw_contents
from sacil_tasks.scenes import scene_seed
from sacil_tasks.sizes import LABELS

DUAL = [task for task in task_names() if len(task_spec(task).slots) > 1]
SINGLE = [task for task in task_names() if task not in DUAL]


def played(task: str, choose, split: str = "canon", episodes: int = 36) -> list[EpisodeRecord]:
    """Records of a policy that handles `choose(record)`; sizes are those of real scenes."""
    records = []
    for record in make_records(task, episodes, split, success=False):
        seed = scene_seed("val", 0, task, record.scene, 0)
        sizes_m = tuple(draw_contents(task_spec(task), split, seed).sizes_m.tolist())
        asked = task_spec(task).size_words(record.slots)
        record = replace(record, asked=asked, sizes_m=sizes_m, handled=())
        handled = tuple(choose(record))
        records.append(replace(record, handled=handled, success=handled == asked))
    return records


def obedient(record):
    return record.asked


def deaf(record):
    return LABELS[: len(record.asked)]


def reversing(record):
    return record.asked[::-1]


def by_trained_size(record):
    return [metrics.absolute_label(replace(record, asked=(word,))) for word in record.asked]


@pytest.mark.parametrize("task", task_names())
def test_the_obedient_are_right_in_every_slot(task):
    records = played(task, obedient)
    for slot in range(len(task_spec(task).slots)):
        assert metrics.selections(records, slot).rate == 1
    assert metrics.size_confusions(records).rate == 0
    assert metrics.skill(records).rate == 1
    assert metrics.sensitive_scenes(records).rate == metrics.understood_scenes(records).rate == 1
    assert metrics.Bias.of(records).share == 0


@pytest.mark.parametrize("task", task_names())
def test_the_deaf_are_right_in_a_third_and_insensitive(task):
    records = played(task, deaf)
    assert metrics.selections(records, 0).rate == pytest.approx(1 / 3)
    assert metrics.sensitive_scenes(records).rate == 0
    assert metrics.understood_scenes(records).rate == 0
    bias = metrics.Bias.of(records)
    assert (bias.bigger, bias.smaller) == (0, len(records) * 2 // 3)
    assert bias.share == pytest.approx(-2 / 3)
    assert bias.extreme == len(records) // 3


@pytest.mark.parametrize("task", DUAL)
def test_reversed_order_is_no_size_confusion_and_ends_the_first_slot(task):
    records = played(task, reversing)
    assert metrics.size_confusions(records) == Tally(0, len(records))
    assert metrics.selections(records, 0).rate == 0
    assert metrics.selections(records, 1).episodes == 0
    assert metrics.skill(records).episodes == 0


@pytest.mark.parametrize("task", DUAL)
def test_the_second_slot_is_judged_where_the_first_was_right(task):
    first_right = played(task, lambda record: (record.asked[0], "unnamed")[:1])
    assert metrics.selections(first_right, 1).episodes == 0
    records = played(task, lambda record: (record.asked[0], *(set(LABELS) - set(record.asked))))
    assert metrics.selections(records, 1) == Tally(0, len(records))


@pytest.mark.parametrize("task", task_names())
def test_the_absolute_bias_tells_trained_sizes_from_ranks(task):
    for split in {"shift_down", "shift_up"} & set(task_spec(task).splits):
        absolute = played(task, by_trained_size, split)
        assert metrics.selections(absolute, 0).rate == pytest.approx(1 / 3)
        assert metrics.AbsoluteBias.of(absolute).index == 1
        assert metrics.AbsoluteBias.of(played(task, obedient, split)).index == -1
        # Where both oracles agree, a choice tells nothing.
        assert metrics.AbsoluteBias.of(absolute).decisive == len(absolute) * 2 // 3
    canon = played(task, by_trained_size)
    assert metrics.selections(canon, 0).rate == 1
    assert metrics.AbsoluteBias.of(canon).index is None


@pytest.mark.parametrize("task", SINGLE)
def test_random_choices_look_sensitive_but_understand_nothing(task):
    rng = np.random.default_rng(0)
    records = played(task, lambda _: rng.permutation(LABELS)[:1].tolist(), episodes=900)
    words = words_per_scene(task, "canon")
    assert metrics.sensitive_scenes(records).rate == pytest.approx(1 - 3 ** (1 - words), abs=0.06)
    assert metrics.understood_scenes(records).rate == pytest.approx(3**-words, abs=0.04)
    assert metrics.Bias.of(records).share == pytest.approx(0, abs=0.1)


def test_success_is_interaction_times_selection_times_skill():
    habits = cycle([obedient, deaf, lambda _: (), obedient, reversing])
    records = played("pick_and_lift", lambda record: next(habits)(record), episodes=60)
    records = [replace(r, success=r.success and r.scene % 3 > 0) for r in records]
    interacts = len(metrics.decisive(records)) / len(records)
    product = interacts * metrics.selections(records, 0).rate * metrics.skill(records).rate
    assert product == pytest.approx(sum(r.success for r in records) / len(records))


def test_aims_are_counted_where_there_is_one_and_only_in_newer_records():
    aimed = [replace(r, aimed=r.asked[0], handled=()) for r in make_records()]
    away = [replace(r, aimed="clutter") for r in make_records()]
    assert metrics.aims([*aimed, *away]) == Tally(6, 12)
    assert metrics.aims(make_records()) == Tally(0, 0)
    assert metrics.aims([replace(r, aimed="") for r in make_records()]) == Tally(0, 0)


def test_an_absent_object_makes_no_absolute_choice():
    (record, *_) = played("pick_and_lift", obedient, "pair")
    assert metrics.absolute_label(record) is None


@pytest.mark.parametrize("task", task_names())
def test_a_row_of_the_summary_adds_up(task):
    (cell,) = cells(played(task, deaf))
    line = row(cell)
    named = line["first_right"] + line["first_other_named"] + line["size_confusions"]
    assert named == line["decisive"] == line["episodes"]
    assert sum(value for name, value in line.items() if name.startswith("ended_")) == named
    assert line["size_bias"] == "-0.67"
    assert (line["sensitive_scenes"], line["understood_scenes"]) == (0, 0)
