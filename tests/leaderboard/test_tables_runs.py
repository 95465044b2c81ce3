"""Which runs a table takes, which it leaves out and says so, and what it refuses."""

import json
from dataclasses import replace
from pathlib import Path
from shutil import copytree

import pytest
from made_up import make_records
from played import FAILED, SOLVED, by_chance, make_training, play, read, rows, tabulate

from leaderboard.layout import SUITES
from leaderboard.manifest import MANIFEST_FILE
from leaderboard.plan import words_per_scene
from leaderboard.records import EPISODES_FILE, EpisodeLog
from leaderboard.tables import TablesConfig, main
from sacil_tasks.errors import UsageError

BASELINES = ("hiveformer", "polarnet", "act3d", "rvt")


@pytest.fixture
def runs(tmp_path) -> Path:
    """`sacil` and `rvt` on the single suite, 120,000 samples each."""
    for agent in ("sacil", "rvt"):
        play(tmp_path / "runs" / agent, agent, training=make_training(agent))
    return tmp_path / "runs"


def test_a_cell_without_a_run_is_empty(tmp_path):
    tasks = ("pick_and_lift", "place_cup")
    play(tmp_path / "runs" / "a", "sacil", tasks=tasks, training=make_training())
    out = tabulate(tmp_path / "runs")
    line = rows(out)["sacil"]
    assert line["pick_and_lift"] != "" != line["place_cup"]
    assert line["pick_up_cup"] == line["pick_up_cup_episodes"] == ""
    assert line["average"] == line["average_low"] == "", "a mean over some tasks is another thing"
    for agent in BASELINES:
        empty = rows(out)[agent]
        assert empty["note"] == "no run"
        filled = set(empty) - {"block", "model", "agent", "note"}
        assert not any(empty[name] for name in filled)
    assert read(out / "comparisons.csv") == []
    assert all(line["average"] == "" for line in read(out / "table2_dual.csv"))


def test_rows_of_some_tasks_are_compared_over_those(runs, tmp_path):
    tasks = ("pick_and_lift", "place_cup")
    play(runs / "act3d", "act3d", tasks=tasks, training=make_training("act3d"))
    found = [it for it in read(tabulate(runs) / "comparisons.csv") if it["agent"] == "act3d"]
    assert [(it["column"], it["tasks"]) for it in found] == [
        ("shared_tasks", "pick_and_lift place_cup"),
        ("pick_and_lift", "pick_and_lift"),
        ("place_cup", "place_cup"),
    ]


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"samples": 60_000}, "60,000 samples, not 120,000"),
        ({"preset": "paper"}, "preset paper, not cpu"),
        ({"text": "clip:x"}, "text clip:x, not minilm"),
        ({"keyframes_sha256": dict.fromkeys(SUITES["single"], "other")}, "other keyframes"),
        ({"keyframes_sha256": {"pick_and_lift": "x"}}, "trained on pick_and_lift"),
    ],
)
def test_a_row_trained_on_other_terms_is_left_out_and_says_why(runs, changes, reason):
    play(runs / "act3d", "act3d", training=make_training("act3d", **changes))
    line = rows(tabulate(runs))["act3d"]
    assert line["pick_and_lift"] == line["samples"] == ""
    assert line["note"] == f"left out: {reason} ({runs / 'act3d'})"
    assert "act3d" not in {it["agent"] for it in read(tabulate(runs) / "comparisons.csv")}


def test_two_budgets_of_the_agent_compared_with_must_be_chosen_from(runs):
    small = make_training(samples=24_000)
    play(runs / "sacil_small", "sacil", training=small, solves=by_chance("small", 0.1))
    with pytest.raises(UsageError, match=r"table1_single would mix budgets.*--samples"):
        tabulate(runs)
    assert not runs.with_name("tables").exists(), "nothing is half-written"
    line = rows(tabulate(runs, samples=24_000))
    assert line["sacil"]["samples"] == "24000"
    assert line["rvt"]["note"].startswith("left out: 120,000 samples, not 24,000")
    assert rows(tabulate(runs, samples=120_000))["rvt"]["note"] == ""


def test_budgets_are_not_mixed_where_the_agent_compared_with_is_missing(tmp_path):
    folder = tmp_path / "runs"
    for agent, samples in [("rvt", 60_000), ("act3d", 120_000)]:
        play(folder / agent, agent, training=make_training(agent, samples=samples))
    with pytest.raises(UsageError, match=r"table1_single would mix budgets \(act3d in .*; rvt in "):
        tabulate(folder)


def test_variants_that_the_paper_lacks_keep_to_the_same_terms(runs):
    for agent, samples in [("sacil:patch_stem", 120_000), ("sacil:conditioned_contrast", 60_000)]:
        play(runs / agent[6:], agent, training=make_training(agent, samples=samples))
    found = rows(tabulate(runs))
    assert found["sacil:patch_stem"]["block"] == "other"
    assert found["sacil:patch_stem"]["average"] != "" == found["sacil:patch_stem"]["note"]
    assert found["sacil:conditioned_contrast"]["average"] == ""
    assert "60,000 samples, not 120,000" in found["sacil:conditioned_contrast"]["note"]


def test_networks_trained_on_just_the_tables_tasks_come_first(runs):
    tasks = (*SUITES["single"][:2], "push_buttons")
    sliced = make_training(tasks=tasks, samples=60_000)
    play(runs / "slice", "sacil", tasks=tasks, training=sliced)
    out = tabulate(runs)
    assert rows(out)["sacil"]["samples"] == "120000"
    assert "left out: 60,000 samples, not 120,000" in rows(out)["sacil"]["note"]
    assert rows(out, "table2_dual")["sacil"]["push_buttons"] != ""


def test_training_seeds_are_pooled_and_each_is_traced(runs):
    for seed in (1, 2):
        training = make_training(seed=seed, core_minutes=60.0 + 6 * seed)
        play(runs / f"sacil{seed}", "sacil", training=training)
    out = tabulate(runs)
    line = rows(out)["sacil"]
    assert (line["seeds"], line["core_minutes"]) == ("0 1 2", "66.0")
    assert line["pick_and_lift_episodes"] == "54"
    cells = [
        it
        for it in read(out / "cells.csv")
        if (it["table"], it["agent"], it["task"]) == ("table1_single", "sacil", "pick_and_lift")
    ]
    assert [it["seed"] for it in cells] == ["0", "1", "2", "0+1+2"]
    assert sum(int(it["successes"]) for it in cells[:3]) == int(cells[3]["successes"])
    assert len({it["checkpoint"] for it in cells[:3]}) == 3
    assert cells[3]["checkpoint"].split("+") == [it["checkpoint"] for it in cells[:3]]
    compared = read(out / "comparisons.csv")[0]
    assert (compared["seeds"], compared["seeds_against"], compared["scenes"]) == (
        *("1", "3"),
        str(sum(18 // words_per_scene(task, "canon") for task in SUITES["single"])),
    )


def test_two_networks_of_one_seed_are_refused(runs):
    twin = make_training(core_minutes=61.0)
    play(runs / "twin", "sacil", training=twin)
    with pytest.raises(UsageError, match=r"sacil.*twin.*same training seed.*--runs"):
        tabulate(runs)


def test_a_row_is_never_made_of_two_networks_by_task(tmp_path):
    halves = (SUITES["single"][:2], SUITES["single"][2:])
    for number, tasks in enumerate(halves):
        training = make_training(core_minutes=60.0 + number)
        play(tmp_path / "runs" / str(number), "sacil", tasks=tasks, training=training)
    with pytest.raises(UsageError, match=r"two networks of sacil with the same training seed"):
        tabulate(tmp_path / "runs")


def test_tasks_with_fewer_training_seeds_than_others_are_named(runs):
    play(runs / "more", "sacil", tasks=("place_cup",), training=make_training(seed=1))
    note = rows(tabulate(runs))["sacil"]["note"]
    assert "pick_and_lift: 1 of several training seeds" in note
    assert "place_cup: " not in note


def test_a_budget_that_no_run_has_is_refused_and_nothing_is_written(runs, tmp_path):
    with pytest.raises(UsageError, match=r"no run was trained on 12,345 .*found: 120,000"):
        main(TablesConfig(runs=(runs,), samples=12_345, out=tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_a_copied_run_counts_once_and_one_that_disagrees_is_refused(runs):
    before = rows(tabulate(runs))
    copytree(runs / "rvt", runs / "copy")
    assert rows(tabulate(runs)) == before
    log = runs / "copy" / EPISODES_FILE
    first, rest = log.read_text().split("\n", 1)
    record = json.loads(first)
    verdict = FAILED if record["success"] else SOLVED
    log.write_text(json.dumps(record | verdict) + "\n" + rest)
    with pytest.raises(UsageError, match=r"copy and .*rvt hold episode .* different results"):
        tabulate(runs)


def test_val_is_never_shown_as_test(runs):
    play(runs / "val", "act3d", partition="val", training=make_training("act3d"))
    out = tabulate(runs)
    assert rows(out)["act3d"]["note"] == "no run"
    assert "act3d,0,pick_and_lift,canon,val" in (out / "summary.csv").read_text()
    tabulate(runs, partition="val")
    shown = rows(out, "table1_single-val")
    assert shown["act3d"]["average"] != "" == shown["sacil"]["average"]
    assert "Not test scenes" in (out / "table1_single-val.md").read_text()
    assert {line["partition"] for line in read(out / "cells-val.csv")} == {"val"}


def test_other_scene_sets_and_splits_have_tables_of_their_own(runs):
    play(runs / "other", "act3d", scene_set=3, training=make_training("act3d"))
    tasks = ("pick_and_lift",)
    play(runs / "shift", "act3d", split="shift_down", tasks=tasks, training=make_training("act3d"))
    out = tabulate(runs)
    assert rows(out)["act3d"]["note"] == "no run"
    tabulate(runs, seed=3)
    tabulate(runs, split="shift_down")
    assert rows(out, "table1_single-scenes3")["act3d"]["average"] != ""
    assert rows(out, "table1_single-shift_down")["act3d"]["pick_and_lift"] != ""
    with pytest.raises(UsageError, match=r"none of the 4 runs found has episodes of .*scene set 9"):
        tabulate(runs, seed=9)


def test_protocols_are_not_mixed(runs, capsys):
    play(runs / "old", "act3d", training=make_training("act3d"), protocol="0123456789ab")
    line = rows(tabulate(runs))["act3d"]
    assert line["average"] == ""
    assert "pick_and_lift under protocol 0123456789ab, not " in line["note"]
    assert "warning" not in capsys.readouterr().out


def test_runs_of_one_older_protocol_are_shown_and_named_so(tmp_path, capsys):
    training = make_training()
    play(tmp_path / "runs" / "old", "sacil", training=training, protocol="0123456789ab")
    out = tabulate(tmp_path / "runs")
    assert rows(out)["sacil"]["average"] != ""
    assert "Not this code's protocol: pick_and_lift" in (out / "table1_single.md").read_text()
    assert "not this code's" in capsys.readouterr().out
    play(tmp_path / "runs" / "b", "rvt", training=make_training("rvt"), protocol="ba9876543210")
    with pytest.raises(UsageError, match=r"different protocols \(0123456789ab: .*, ba9876543210:"):
        tabulate(tmp_path / "runs")


def test_agents_that_met_other_scenes_are_not_compared(runs):
    play(runs / "act3d", "act3d", training=make_training("act3d"), fingerprint="elsewhere")
    with pytest.raises(UsageError, match="met different scenes"):
        tabulate(runs)


def test_an_agent_of_unknown_budget_is_shown_apart_or_not_at_all(runs):
    play(runs / "mine", "my_lab.policy:load")
    play(runs / "act3d", "act3d")
    out = tabulate(runs)
    mine, known = rows(out)["my_lab.policy:load"], rows(out)["act3d"]
    assert (mine["block"], mine["note"]) == (
        "other",
        "not comparable: its training budget is unknown",
    )
    assert mine["average"] != ""
    assert (known["average"], known["samples"]) == ("", "")
    assert "left out: its training budget is unknown" in known["note"]
    assert not {"my_lab.policy:load", "act3d"} & {
        it["agent"] for it in read(out / "comparisons.csv")
    }


def test_a_reader_is_told_of_missing_and_broken_episodes_and_of_repeated_tests(runs):
    training = make_training("act3d")
    broken = FAILED | {"outcome": "ERROR", "end": "error"}
    folder = play(runs / "act3d", "act3d", training=training, episodes=9, **broken)
    path = folder / MANIFEST_FILE
    path.write_text(json.dumps(json.loads(path.read_text()) | {"test_runs": 2}))
    note = rows(tabulate(runs))["act3d"]["note"]
    assert "pick_and_lift: 9 of 18 episodes that others have" in note
    assert "episodes broke off and count as failures" in note
    assert "these weights have met the test 2 times" in note


def test_an_unknown_row_to_compare_with_names_the_nearest(runs):
    with pytest.raises(UsageError, match="Did you mean sacil"):
        tabulate(runs, against="sacl")


# What can be wrong with a run ---------------------------------------------------------------------


def spoil_line(folder: Path) -> None:
    log = folder / EPISODES_FILE
    lines = log.read_text().splitlines()
    lines[4] = lines[4][:50]
    log.write_text("\n".join(lines) + "\n")


def spoil_bytes(folder: Path) -> None:
    (folder / EPISODES_FILE).write_bytes(b"\xff\xfe\x00broken\n")


def drop_manifest(folder: Path) -> None:
    (folder / MANIFEST_FILE).unlink()


def drop_episodes(folder: Path) -> None:
    (folder / EPISODES_FILE).unlink()


def spoil_manifest(folder: Path) -> None:
    (folder / MANIFEST_FILE).write_text("{")


def spoil_training(folder: Path) -> None:
    path = folder / MANIFEST_FILE
    path.write_text(json.dumps(json.loads(path.read_text()) | {"training": {"samples": "many"}}))


def mix_agents(folder: Path) -> None:
    record = make_records("pick_and_lift")[0]
    with EpisodeLog(folder) as log:
        log.append(replace(record, scene=99, partition="test"))


def mix_protocols(folder: Path) -> None:
    log = folder / EPISODES_FILE
    log.write_text(log.read_text().replace('"protocol":"', '"protocol":"x', 1))


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (spoil_line, "episodes.jsonl line 5 is not an episode record"),
        (spoil_bytes, "cannot read .*episodes.jsonl"),
        (drop_manifest, "has no manifest.json beside it"),
        (drop_episodes, "is half a run"),
        (spoil_manifest, "manifest.json is not the manifest"),
        (spoil_training, r"manifest.json is not the manifest .*training\."),
        (mix_agents, "line 91 is not of the run in manifest.json: its agent differs"),
        (mix_protocols, "line 1 is not of the run in manifest.json: its protocol differs"),
    ],
    ids=lambda it: getattr(it, "__name__", ""),
)
def test_a_damaged_run_names_its_file_and_nothing_is_written(runs, damage, sentence):
    damage(runs / "rvt")
    with pytest.raises(UsageError, match=f"rvt.*{sentence}|{sentence}"):
        tabulate(runs)
    assert not runs.with_name("tables").exists()


def test_a_run_in_progress_counts_as_far_as_it_is(runs):
    log = runs / "rvt" / EPISODES_FILE
    log.write_text(log.read_text()[:-20])
    line = rows(tabulate(runs))["rvt"]
    assert line["take_off_pepper_episodes"] == "17"
    log.write_text("")
    assert rows(tabulate(runs))["rvt"]["note"] == "no run"


def test_places_without_runs_are_one_sentence(tmp_path, monkeypatch):
    with pytest.raises(UsageError, match="there is no folder"):
        tabulate(tmp_path / "nowhere")
    with pytest.raises(UsageError, match="no run in"):
        tabulate(tmp_path)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UsageError, match="neither results nor runs/eval is here"):
        main(TablesConfig())


def test_a_folder_that_cannot_be_written_is_one_sentence(runs, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match="choose another folder with --out"):
        tabulate(runs, out=tmp_path / "file" / "tables")


def test_without_a_place_both_usual_folders_are_read(runs, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    play(tmp_path / "results" / "test" / "act3d", "act3d", training=make_training("act3d"))
    play(tmp_path / "runs" / "eval" / "polarnet", "polarnet", training=make_training("polarnet"))
    main(TablesConfig())
    found = rows(tmp_path / "results")
    assert found["act3d"]["average"] != "" != found["polarnet"]["average"]
    assert found["sacil"]["note"] == "no run"
