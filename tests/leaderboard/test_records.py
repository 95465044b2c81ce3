import json
import os

import pytest
from made_up import make_records

from leaderboard.records import EPISODES_FILE, EpisodeLog, EpisodeRecord, doubts, read_records
from sacil_tasks.errors import UsageError


def test_a_record_survives_its_line():
    record = make_records(sizes_m=(0.03, 0.04, 0.05), reason='a "quoted"\nline é')[0]
    line = record.to_json()
    assert "\n" not in line
    assert EpisodeRecord.from_json(line) == record


def test_records_written_before_aims_were_noted_are_read():
    record = make_records()[0]
    content = json.loads(record.to_json())
    assert content.pop("aimed") is None
    assert EpisodeRecord.from_json(json.dumps(content)) == record
    for spoilt in (content | {"unheard": 1}, {k: v for k, v in content.items() if k != "end"}):
        with pytest.raises(ValueError, match=r"unheard|end"):
            EpisodeRecord.from_json(json.dumps(spoilt))


@pytest.mark.parametrize("cut", [1, 7, 100])
def test_a_line_cut_by_kill_is_dropped_and_nothing_else(run_folder, cut):
    log = run_folder / EPISODES_FILE
    before = read_records(log)
    os.truncate(log, log.stat().st_size - cut)
    assert read_records(log) == before[:-1]
    with EpisodeLog(run_folder) as reopened:
        assert reopened.records == before[:-1]
        reopened.append(before[-1])
    assert read_records(log) == before


@pytest.mark.parametrize("junk", ["{}", "nonsense", '{"schema_version": 99}', "\x00\x00", "[1]"])
def test_a_foreign_line_is_refused_and_left_alone(run_folder, junk):
    log = run_folder / EPISODES_FILE
    content = junk + "\n" + log.read_text()[:-5]
    log.write_text(content)
    with pytest.raises(UsageError, match="line 1 is not an episode record"):
        EpisodeLog(run_folder)
    assert log.read_text() == content


@pytest.mark.parametrize(
    "changes",
    [
        {"scene": "3"},
        {"success": 1},
        {"handled": "small"},
        {"asked": [1]},
        {"seconds": {"total": "long"}},
        {"seconds": {"napping": 1.0}},
        {"sizes_m": None},
        {"sizes_m": [0.03, -0.04, 0.05]},
        {"keyframes": -3},
        {"scene": -1},
        {"seconds": {"total": -1.0}},
        {"seconds": {"planning": float("nan")}},
    ],
    ids=str,
)
def test_a_value_of_another_type_is_refused(run_folder, changes):
    log = run_folder / EPISODES_FILE
    first, *rest = log.read_text().splitlines()
    log.write_text("\n".join([json.dumps(json.loads(first) | changes), *rest]) + "\n")
    with pytest.raises(
        UsageError, match=rf"line 1 is not an episode record.*{next(iter(changes))}"
    ):
        read_records(log)


WON = {"outcome": "SUCCESS", "success": True, "success_lenient": True, "end": "success"}


@pytest.mark.parametrize(
    "changes",
    [
        {"outcome": "SUCCESS", "success": False},
        {"outcome": "MOTOR_FAIL", "success": True},
        {"success": True, "success_lenient": False, "outcome": "SUCCESS"},
        {"end": "nap"},
        {"success_lenient": True, "end": "limit"},
        {"outcome": "ERROR", "end": "limit"},
        {"outcome": "TRIUMPH"},
        {"outcome": "NO_INTERACTION", "asked": ["small"], "handled": ["small"]},
        {"outcome": "ORDER_ERROR", "asked": ["small", "large"], "handled": ["small"]},
        WON | {"asked": ["small"], "handled": ["large"]},
    ],
    ids=str,
)
def test_a_verdict_that_contradicts_itself_does_not_count(run_folder, changes):
    log = run_folder / EPISODES_FILE
    failed = {"success": False, "success_lenient": False, "outcome": "MOTOR_FAIL", "end": "limit"}
    first, *rest = log.read_text().splitlines()
    fine = json.loads(first) | failed
    log.write_text("\n".join([json.dumps(fine), *rest]) + "\n")
    assert not read_records(log)[0].success
    log.write_text("\n".join([json.dumps(fine | changes), *rest]) + "\n")
    with pytest.raises(UsageError, match="contradict each other"):
        read_records(log)


def test_a_foreign_file_without_a_whole_line_is_refused_and_left_alone(tmp_path):
    (tmp_path / EPISODES_FILE).write_text("no end of line")
    with pytest.raises(UsageError, match="no episode log"):
        EpisodeLog(tmp_path)
    assert (tmp_path / EPISODES_FILE).read_text() == "no end of line"


def test_an_episode_twice_is_refused(run_folder):
    log = run_folder / EPISODES_FILE
    log.write_text(log.read_text() * 2)
    with pytest.raises(UsageError, match="twice"):
        read_records(log)


def test_a_second_writer_is_refused(run_folder):
    with EpisodeLog(run_folder), pytest.raises(UsageError, match="another run is writing"):
        EpisodeLog(run_folder)
    EpisodeLog(run_folder)


def test_a_folder_that_cannot_be_made_is_one_sentence(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match="choose another folder with --out"):
        EpisodeLog(tmp_path / "file" / "run")


def test_a_full_disk_is_one_sentence_and_keeps_what_was_written(run_folder):
    with EpisodeLog(run_folder) as log:
        log._stream = open("/dev/full", "wb", buffering=0)  # noqa: SIM115, SLF001
        with pytest.raises(UsageError, match="No space left"):
            log.append(make_records()[0])
    assert len(read_records(run_folder / EPISODES_FILE)) == 6


def test_images_that_change_with_the_words_are_doubted():
    same = make_records(pixels="a", renderer="x")
    assert doubts(same) == []
    other = make_records(pixels="b", renderer="x")
    assert "did not look the same" in doubts([*same[:1], *other[1:]])[0]
    elsewhere = make_records(pixels="b", renderer="y")
    assert "different renderers" in doubts([*same[:1], *elsewhere[1:]])[0]
