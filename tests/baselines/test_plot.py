import json

import pytest

from baselines.plot import PlotConfig, draw, main, read_metrics, read_runs
from sacil_tasks.errors import UsageError


def write_run(folder, name, *, contrast):
    rows = [
        {"kind": "train", "step": step, "cpu_s": 60.0 * step, "bc/position": 9 - step}
        | {"loss": 1.0, "samples_per_s": 9.0}
        | ({"itc/loss": 2.0} if contrast else {})
        for step in (1, 2)
    ]
    rows.append({"kind": "val", "step": 2, "all": {"selected_by_words": [3, 4], "position_mm": 5}})
    (folder / name).mkdir()
    (folder / name / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return folder / name


def test_runs_are_drawn_over_core_minutes_where_they_have_values(tmp_path):
    runs = [write_run(tmp_path, "rvt", contrast=False), write_run(tmp_path, "sacil", contrast=True)]
    figure = draw({run.name: read_metrics(run) for run in runs})
    by_title = {axes.get_title(): axes for axes in figure.axes}
    position = by_title["behaviour cloning: position loss"].lines[0].get_xydata()
    assert position.tolist() == [[1, 8], [2, 7]]
    chosen = by_title["val: named candidate chosen, %"].lines[1].get_xydata()
    assert chosen.tolist() == [[2, 75]]
    contrast = by_title["Image-Text Contrast"].lines
    assert [len(line.get_xydata()) for line in contrast] == [0, 2], "rvt has no contrast"
    assert "Current-Goal Contrast" not in by_title


def test_runs_of_one_name_are_told_apart(tmp_path):
    for place in ("a", "b"):
        (tmp_path / place).mkdir()
    runs = [write_run(tmp_path / place, "rvt", contrast=False) for place in ("a", "b")]
    assert set(read_runs(runs)) == {str(run) for run in runs}


def test_a_run_that_has_only_been_validated_is_named(tmp_path):
    row = {"kind": "val", "step": 2, "all": {"selected_by_words": [3, 4], "position_mm": 5}}
    (tmp_path / "metrics.jsonl").write_text(json.dumps(row) + "\n")
    with pytest.raises(UsageError, match="no line of training yet"):
        main(PlotConfig(runs=(tmp_path,), out=tmp_path / "curves.png"))


def test_the_picture_is_written(tmp_path):
    run = write_run(tmp_path, "rvt", contrast=False)
    main(PlotConfig(runs=(run,), out=tmp_path / "new" / "curves.png"))
    assert (tmp_path / "new" / "curves.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("content", [None, "", "not json"])
def test_a_folder_without_a_run_is_named(tmp_path, content):
    if content is not None:
        (tmp_path / "metrics.jsonl").write_text(content)
    with pytest.raises(UsageError, match=f"no training run in {tmp_path}"):
        main(PlotConfig(runs=(tmp_path,), out=tmp_path / "curves.png"))
