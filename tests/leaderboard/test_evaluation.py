"""Whole runs with the real simulator, on val."""

import json

import pytest

from leaderboard.records import EPISODES_FILE, EpisodeRecord, read_records, reproducible
from leaderboard.run import RunConfig, main
from sacil_tasks.catalog import task_names

pytestmark = pytest.mark.sim


def evaluate(folder, capsys=None, **changes) -> list[EpisodeRecord]:
    main(RunConfig(**{"partition": "val", "out": folder, "episodes": 6, "workers": 1} | changes))
    return read_records(folder / EPISODES_FILE)


@pytest.fixture(scope="module")
def oracle(tmp_path_factory):
    return evaluate(tmp_path_factory.mktemp("oracle"), agent="oracle", suite="all")


@pytest.fixture(scope="module")
def hold(tmp_path_factory):
    return evaluate(tmp_path_factory.mktemp("hold"), agent="hold", suite="all")


@pytest.mark.parametrize("task", task_names())
def test_the_oracle_succeeds(oracle, task):
    mine = [record for record in oracle if record.task == task]
    assert len(mine) >= 6
    assert [(r.key, r.outcome, r.reason) for r in mine if not r.success] == []
    assert all(record.handled[: len(record.asked)] == record.asked for record in mine)


@pytest.mark.parametrize("task", task_names())
def test_holding_still_never_succeeds(hold, task):
    mine = [record for record in hold if record.task == task]
    assert len(mine) >= 6
    assert {(r.success_lenient, r.outcome, r.end) for r in mine} == {
        (False, "NO_INTERACTION", "limit")
    }


def test_results_do_not_depend_on_workers_or_on_what_was_played_before(oracle, tmp_path):
    """With two workers, half of the scenes come first in their process."""
    again = evaluate(tmp_path, agent="oracle", suite="all", workers=2)
    assert reproducible(again) == reproducible(oracle)


def test_pixels_do_not_depend_on_workers_or_on_what_was_drawn_before(tmp_path):
    """The oracle does not look; this policy is shown the first images of each episode."""
    chosen = {"agent": "rogue_policies:load_wanderer", "tasks": ("pick_and_lift",)}
    one, two = (evaluate(tmp_path / str(n), workers=n, **chosen) for n in (1, 2))
    assert reproducible(one) == reproducible(two)
    assert len({record.pixels for record in one}) == 2, "two scenes, each the same for all words"
    assert all(record.pixels for record in one)


def test_agents_meet_the_same_scenes(oracle, hold):
    assert {r.key: r.fingerprint for r in oracle} == {r.key: r.fingerprint for r in hold}


def test_a_finished_run_has_nothing_to_do_and_a_killed_one_is_completed(tmp_path, capsys):
    first = evaluate(tmp_path, agent="blind", tasks=("pick_and_lift",))
    log = tmp_path / EPISODES_FILE
    whole = log.read_bytes()
    evaluate(tmp_path, agent="blind", tasks=("pick_and_lift",))
    assert "Nothing to do: all 6 episodes" in capsys.readouterr().out
    assert log.read_bytes() == whole
    log.write_bytes(whole[: len(whole) // 2])  # as kill -9 leaves it
    resumed = evaluate(tmp_path, agent="blind", tasks=("pick_and_lift",))
    assert reproducible(resumed) == reproducible(first)


def test_a_policy_that_raises_gives_nan_or_crashes_does_not_stop_the_run(tmp_path):
    records = evaluate(
        tmp_path, agent="rogue_policies:load_rogue", tasks=("pick_and_lift",), episodes=3
    )
    small, medium, large = sorted(records, key=lambda record: record.key)
    assert small.end == large.end == "error"
    assert small.reason.startswith("ValueError: I do not like small ones (rogue_policies.py:")
    assert (medium.end, medium.reason) == ("invalid_action", "not_finite")
    assert "SIGSEGV" in large.reason
    assert not any(record.success_lenient or record.privileged for record in records)
    assert small.pixels == medium.pixels != ""


def test_impossible_keyframes_end_their_episode_only(tmp_path):
    records = evaluate(
        tmp_path, agent="rogue_policies:load_wanderer", tasks=("pick_and_lift",), episodes=3
    )
    small, medium, large = sorted(records, key=lambda record: record.key)
    assert (small.end, small.reason) == ("invalid_action", "outside_workspace")
    assert (medium.end, large.end) == ("error", "error")
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    assert manifest["protocols"]["pick_and_lift"]["hash"] == small.protocol
