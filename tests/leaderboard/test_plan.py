import pytest

from leaderboard.plan import plan_episodes, scene_jobs, whole_scenes
from sacil_tasks.catalog import task_names, task_spec
from sacil_tasks.errors import UsageError
from sacil_tasks.instructions import variations

PAIRS = [(task, split) for task in task_names() for split in ("canon", "pair")]


@pytest.mark.parametrize(("task", "split"), PAIRS)
@pytest.mark.parametrize("episodes", [1, 25, 102])
def test_every_scene_is_met_under_all_of_its_words(task, split, episodes):
    keys = plan_episodes([(task, split)], "test", 0, episodes)
    words = len(variations(task_spec(task), split))
    assert episodes <= len(keys) == whole_scenes(task, split, episodes) < episodes + words
    for job in scene_jobs(keys):
        assert [key.variation for key in job.keys] == list(range(words))
        assert len({key.scene for key in job.keys}) == 1


def test_more_episodes_begin_with_the_same_ones():
    few = plan_episodes([("push_buttons", "canon")], "test", 0, 12)
    many = plan_episodes([("push_buttons", "canon")], "test", 0, 102)
    assert many[:12] == few


def test_no_episodes_are_one_sentence():
    with pytest.raises(UsageError, match="at least 1"):
        plan_episodes([("pick_up_cup", "canon")], "test", 0, 0)
