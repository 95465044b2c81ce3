import pytest

from leaderboard.plan import plan_episodes, scene_jobs, whole_scenes
from sacil_tasks.catalog import task_names, task_spec
from sacil_tasks.errors import UsageError
from sacil_tasks.instructions import variations


@pytest.mark.parametrize("task", task_names())
@pytest.mark.parametrize("episodes", [1, 25, 102])
def test_every_scene_is_met_under_all_of_its_words(task, episodes):
    keys = plan_episodes([task], ["canon"], "test", 0, episodes)
    words = len(variations(task_spec(task)))
    assert episodes <= len(keys) == whole_scenes(task, episodes) < episodes + words
    for job in scene_jobs(keys):
        assert [key.variation for key in job.keys] == list(range(words))
        assert len({key.scene for key in job.keys}) == 1


def test_more_episodes_begin_with_the_same_ones():
    few = plan_episodes(["push_buttons"], ["canon"], "test", 0, 12)
    many = plan_episodes(["push_buttons"], ["canon"], "test", 0, 102)
    assert many[:12] == few


def test_naming_a_task_or_split_twice_changes_nothing():
    once = plan_episodes(["push_buttons"], ["canon"], "test", 0, 6)
    assert plan_episodes(["push_buttons"] * 2, ["canon"] * 2, "test", 0, 6) == once


@pytest.mark.parametrize(
    ("task", "split", "episodes", "sentence"),
    [
        ("pick_up_cup", "shift_up", 3, "pick_up_cup has the splits"),
        ("pick_up_cup", "shift_dwn", 3, "Did you mean shift_down"),
        ("pick_up_cap", "canon", 3, "Did you mean pick_up_cup"),
        ("pick_up_cup", "canon", 0, "at least 1"),
    ],
)
def test_what_cannot_be_planned_is_one_sentence(task, split, episodes, sentence):
    with pytest.raises(UsageError, match=sentence):
        plan_episodes([task], [split], "test", 0, episodes)
