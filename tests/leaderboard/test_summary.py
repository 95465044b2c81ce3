import csv
from dataclasses import replace

import pytest
from made_up import make_entry, make_records

from leaderboard.plan import plan_episodes
from leaderboard.summary import cells, console_table, row, write_summary
from sacil_tasks.sizes import LABELS


def only_row(records):
    (cell,) = cells(records)
    return row(cell)


def test_errors_are_failures_and_stay_in_the_denominator():
    good = make_records(episodes=3)
    keys = plan_episodes([("pick_and_lift", "canon")], "val", 0, 6)[3:]
    lost = [make_entry().lost(key, "the worker died of SIGSEGV") for key in keys]
    summary = only_row([*good, *lost])
    assert (summary["successes"], summary["episodes"], summary["errors"]) == (3, 6, 3)
    assert (summary["rate_percent"], summary["decisive"]) == ("50.0", 3)


def test_the_matrix_counts_first_choices_and_confusion_means_an_unnamed_size():
    records = make_records("push_buttons", episodes=6)
    swapped = [replace(r, success=False, handled=r.asked[::-1]) for r in records]
    unnamed = [
        replace(r, success=False, handled=tuple(set(LABELS) - set(r.asked))) for r in records
    ]
    assert only_row(swapped)["size_confusions"] == 0
    assert only_row(unnamed)["size_confusion_percent"] == "100.0"
    for summary in (only_row(swapped), only_row(unnamed)):
        assert sum(summary[f"asked_{a}_took_{h}"] for a in LABELS for h in LABELS) == 6
        assert all(summary[f"asked_{label}_took_{label}"] == 0 for label in LABELS)


def test_outcomes_and_errors_partition_the_episodes():
    records = make_records()
    codes = ["SUCCESS", "SIZE_CONFUSION", "MOTOR_FAIL", "NO_INTERACTION", "ORDER_ERROR"]
    mixed = [replace(r, outcome=code) for r, code in zip(records, codes, strict=False)]
    summary = only_row(mixed)
    outcomes = sum(v for name, v in summary.items() if name.startswith("outcome_"))
    assert outcomes + summary["errors"] == summary["episodes"] == 5


def test_the_csv_is_the_same_whatever_the_order_of_records(tmp_path):
    records = [*make_records("push_buttons"), *make_records("pick_and_lift")]
    write_summary(tmp_path / "a.csv", records)
    write_summary(tmp_path / "b.csv", records[::-1])
    text = (tmp_path / "a.csv").read_bytes()
    assert text == (tmp_path / "b.csv").read_bytes()
    assert b"\r" not in text
    rows = list(csv.DictReader((tmp_path / "a.csv").open()))
    assert [line["task"] for line in rows] == ["pick_and_lift", "push_buttons"]


def test_cells_of_other_scenes_have_another_hash():
    records = make_records(fingerprint="x")
    moved = [replace(records[0], fingerprint="y"), *records[1:]]
    assert only_row(records)["scenes"] != only_row(moved)["scenes"]


@pytest.mark.parametrize("changes", [{}, {"handled": (), "success": False}])
def test_the_console_table_is_aligned(changes):
    for table in console_table(make_records(**changes)).split("\n\n"):
        header, *lines = table.splitlines()
        assert header.index("task") == lines[0].index("pick_and_lift")
