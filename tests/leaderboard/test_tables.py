"""Tables from made-up runs, which are written as real ones are, and from the committed results."""

import json
from collections import defaultdict
from dataclasses import asdict
from pathlib import Path

import pytest
from played import by_chance, make_training, play, read, rows, tabulate

from baselines import checkpoint as checkpoints
from leaderboard import training as trainings
from leaderboard.agents import find_agent
from leaderboard.layout import EQUAL_COMPUTE, SUITES, TABLES
from leaderboard.manifest import MANIFEST_FILE
from leaderboard.records import EPISODES_FILE
from leaderboard.stats import Tally, wilson
from leaderboard.worker import Choice, look_at
from sacil_tasks.catalog import suite_tasks

RESULTS = Path(__file__).parents[2] / "results"

SINGLE_ROWS = ("hiveformer", "polarnet", "act3d", "rvt", "sacil")
AGENTS = (*SINGLE_ROWS, EQUAL_COMPUTE, "rvt2", "sacil_rvt2")
ABLATIONS = ("sacil:no_contrast", "sacil:image_text", "sacil:no_queries")
PROBES = ("oracle", "hold", "random", "blind")


@pytest.fixture(scope="module")
def everything(tmp_path_factory) -> tuple[Path, Path]:
    """Every agent and probe on every task, and the tables."""
    runs = tmp_path_factory.mktemp("all") / "runs"
    for suite, tasks in SUITES.items():
        for place, agent in enumerate((*AGENTS, *ABLATIONS)):
            samples = 170_000 if agent == EQUAL_COMPUTE else 120_000
            training = make_training(agent, tasks, samples=samples, core_minutes=40.0 + place)
            solves = by_chance(agent, 0.3 + 0.05 * place)
            folder = runs / f"{agent}-{suite}".replace(":", "-")
            play(folder, agent, tasks=tasks, solves=solves, training=training)
        for probe in PROBES:
            solves = by_chance(probe, {"oracle": 1.0, "blind": 0.3}.get(probe, 0.0))
            play(runs / f"{probe}-{suite}", probe, tasks=tasks, solves=solves, privileged=True)
    return runs, tabulate(runs)


def counts(runs: Path) -> dict[tuple[str, str], list[int]]:
    """Successes and episodes by agent and task, from the raw lines."""
    found = defaultdict(lambda: [0, 0])
    for log in runs.rglob(EPISODES_FILE):
        for line in log.read_text().splitlines():
            record = json.loads(line)
            found[record["agent"], record["task"]][0] += record["success"]
            found[record["agent"], record["task"]][1] += 1
    return found


def test_tasks_are_those_of_the_suites():
    for suite, tasks in SUITES.items():
        assert set(tasks) == set(suite_tasks(suite))


def test_rows_and_columns_are_the_papers(everything):
    _, out = everything
    ones = [line["agent"] for line in read(out / "table1_single.csv") if line["block"] == "paper"]
    twos = [line["agent"] for line in read(out / "table2_dual.csv") if line["block"] == "paper"]
    assert tuple(ones) == tuple(twos) == SINGLE_ROWS
    assert [line["model"] for line in read(out / "table1_single.csv")][:5] == [
        *("HiveFormer", "PolarNet", "Act3D", "RVT", "SACIL")
    ]
    header = (out / "table1_single.csv").read_text().splitlines()[0].split(",")
    shown = ["average", "core_minutes", *SUITES["single"]]
    assert [name for name in header if name in shown] == shown
    header = (out / "table3_queries.csv").read_text().splitlines()[0].split(",")
    shown = ["query_tokens", *SUITES["dual"], "average"]
    assert [name for name in header if name in shown] == shown


def test_every_rate_is_the_count_of_its_episodes(everything):
    runs, out = everything
    truth = counts(runs)
    for name, suite in [("table1_single", "single"), ("table2_dual", "dual")]:
        for agent, line in rows(out, name).items():
            rates = []
            for task in SUITES[suite]:
                successes, episodes = truth[agent, task]
                interval = wilson(Tally(successes, episodes))
                rates.append(100 * successes / episodes)
                assert int(line[f"{task}_successes"]) == successes
                assert int(line[f"{task}_episodes"]) == episodes == 18
                assert line[task] == f"{rates[-1]:.1f}"
                assert line[f"{task}_low"] == f"{100 * interval.low:.1f}"
                assert line[f"{task}_high"] == f"{100 * interval.high:.1f}"
            assert float(line["average"]) == pytest.approx(sum(rates) / len(rates), abs=0.05)
            assert float(line["average_low"]) < float(line["average_high"])


def test_the_ablation_tables_show_the_same_networks_as_the_main_ones(everything):
    _, out = everything
    first = [line["agent"] for line in read(out / "table4_contrasts.csv")][:4]
    assert first == ["sacil:no_contrast", "rvt", "sacil:image_text", "sacil"]
    labels = [
        (line["image_text_contrast"], line["current_goal_contrast"])
        for line in read(out / "table4_contrasts.csv")
    ][:4]
    assert labels == [("no", "no"), ("no", "no"), ("yes", "no"), ("yes", "yes")]
    third = rows(out, "table3_queries")
    assert [third[name]["query_tokens"] for name in list(third)[:2]] == ["no", "yes"]
    assert third["sacil"]["average"] == rows(out, "table2_dual")["sacil"]["average"]
    assert rows(out, "table4_contrasts")["rvt"]["average"] == rows(out)["rvt"]["average"]


def test_table_five_shows_the_improvement_on_both_suites(everything):
    _, out = everything
    lines = read(out / "table5_rvt2.csv")
    assert [line["method"] for line in lines[:3]] == ["RVT-2", "SACIL-RVT-2", "improvement"]
    for suite, table in [("single", "table1_single"), ("dual", "table2_dual")]:
        old, new, gain = (float(line[f"{suite}_average"]) for line in lines[:3])
        assert gain == pytest.approx(new - old, abs=0.11)
        assert str(new) == rows(out, table)["sacil_rvt2"]["average"]


def test_probes_stand_apart_and_are_marked(everything):
    _, out = everything
    found = rows(out)
    assert {name for name, line in found.items() if line["block"] == "probe"} == set(PROBES)
    assert found["oracle"]["model"] == "oracle*"
    assert found["oracle"]["average"] == "100.0"
    assert found["oracle"]["samples"] == ""


def test_equal_compute_may_have_other_samples_and_says_so(everything):
    _, out = everything
    line = rows(out)[EQUAL_COMPUTE]
    assert (line["block"], line["samples"]) == ("beyond", "170000")
    assert "equal core-minutes, not samples" in line["note"]


def test_a_trunk_trained_from_scratch_is_said_in_every_table(everything):
    _, out = everything
    for name in ("table1_single", "table2_dual"):
        assert "not CLIP's" in rows(out, name)["act3d"]["note"]
        assert "not CLIP's" in (out / f"{name}.md").read_text()


def test_each_cell_traces_to_its_run(everything):
    runs, out = everything
    cells = read(out / "cells.csv")
    assert len({(c["table"], c["agent"], c["column"], c["task"]) for c in cells}) == len(cells)
    for cell in cells:
        folder = Path(cell["run"])
        manifest = json.loads((folder / MANIFEST_FILE).read_text())
        assert manifest["agent"] == cell["agent"]
        assert (manifest["checkpoint"] or "") == cell["checkpoint"]
        assert manifest["protocols"][cell["task"]]["hash"] == cell["protocol"]
        if manifest["training"]:
            assert str(manifest["training"]["samples"]) == cell["samples"]
            assert f"{cell['task']}:keyframes of" in cell["keyframes"]
            assert cell["seed"] == "0"
    tables = {cell["table"] for cell in cells}
    assert tables == {layout.name for layout in TABLES}
    assert {Path(cell["run"]).parent for cell in cells} == {runs}


def test_every_rate_of_a_task_in_a_table_is_in_the_cells(everything):
    _, out = everything
    cells = {(c["table"], c["agent"], c["column"]): c for c in read(out / "cells.csv")}
    for layout in TABLES[:4]:
        for agent, line in rows(out, layout.name).items():
            for task in SUITES[layout.suites[0]]:
                if line[task]:
                    cell = cells[layout.name, agent, task]
                    assert (cell["rate_percent"], cell["successes"]) == (
                        line[task],
                        line[f"{task}_successes"],
                    )


def test_markdown_has_the_numbers_of_the_csv(everything):
    _, out = everything
    line, page = rows(out)["sacil"], (out / "table1_single.md").read_text()
    (row,) = [it for it in page.splitlines() if it.startswith("| SACIL |")]
    for task in SUITES["single"]:
        low, high = line[f"{task}_low"], line[f"{task}_high"]
        text = f"{line[task]} ({low}-{high}), {line[f'{task}_successes']}/18"
        assert text in row
    widths = {it.count("|") for it in page.splitlines() if it.startswith("| SACIL |")}
    heads = {it.count("|") for it in page.splitlines() if it.startswith("| model |")}
    assert widths == heads


def test_differences_are_between_rates_and_swap_sign_with_the_row_compared_with(everything):
    runs, out = everything
    mine = {(it["table"], it["agent"], it["column"]): it for it in read(out / "comparisons.csv")}
    table = rows(out)
    one = mine["table1_single", "rvt", "average"]
    gap = float(table["rvt"]["average"]) - float(table["sacil"]["average"])
    assert float(one["difference_points"]) == pytest.approx(gap, abs=0.11)
    assert float(one["low_points"]) <= float(one["difference_points"]) <= float(one["high_points"])
    assert float(one["p"]) <= float(one["p_holm"]) <= 1
    assert float(one["detectable_points"]) > 0
    assert not any(agent in PROBES for _, agent, _ in mine)
    assert {agent for table, agent, _ in mine if table == "table5_rvt2"} == {"sacil_rvt2"}
    turned = tabulate(runs, against="rvt", out=runs.with_name("turned"))
    other = {
        (it["table"], it["agent"], it["column"]): it for it in read(turned / "comparisons.csv")
    }["table1_single", "sacil", "average"]
    assert float(other["difference_points"]) == -float(one["difference_points"])
    assert other["p"] == one["p"]


def test_tables_are_the_same_again(everything):
    runs, out = everything
    again = tabulate(runs, out=runs.with_name("again"))
    for path in out.iterdir():
        assert (again / path.name).read_bytes() == path.read_bytes()
        assert b"\r" not in path.read_bytes()


# What is committed


def test_the_committed_results_make_tables(tmp_path):
    out = tabulate(RESULTS, out=tmp_path)
    cells = [cell for cell in read(out / "cells.csv") if "+" not in cell["seed"]]
    assert {"sacil", "rvt", *PROBES} <= {cell["agent"] for cell in cells}
    for cell in cells:
        (line,) = [
            line
            for line in read(Path(cell["run"]) / "summary.csv")
            if (line["task"], line["split"]) == (cell["task"], cell["split"])
        ]
        for name in ("successes", "episodes", "rate_percent", "low_percent", "high_percent"):
            assert cell[name] == line[name]
        assert cell["checkpoint"].startswith(line["checkpoint"])


def test_released_weights_are_found_by_their_hash():
    for agent in ("sacil", "rvt"):
        folder = checkpoints.released_folder(agent) / "slice"
        sha256 = checkpoints.sha256(folder)
        assert trainings.checkpoint_sha256(folder) == sha256
        found = trainings.training_behind(None, sha256)
        provenance = json.loads((folder / checkpoints.PROVENANCE).read_text())
        assert asdict(found).items() <= provenance.items()
        assert set(found.terms.tasks) == set(suite_tasks("slice"))
        assert found == trainings.training_behind(folder, sha256)
    assert trainings.training_behind(None, "0" * 64) is None


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"agent": 3}', '{"samples": 5, "seed": "a"}'])
def test_a_strangers_provenance_is_no_training_fact(content, tmp_path):
    (tmp_path / trainings.PROVENANCE_FILE).write_text(content)
    assert trainings.read_training(tmp_path) is None
    assert trainings.read_training(tmp_path / "weights.bin") is None


@pytest.mark.parametrize("agent", ["rvt", "hold"])
def test_loading_an_agent_tells_what_is_behind_its_weights(agent):
    choice = Choice(agent=find_agent(agent), checkpoint=None, tasks=("pick_and_lift",))
    look = look_at(choice)
    assert look.training == trainings.training_behind(None, look.checkpoint)
    assert (look.training is None) == (agent == "hold")
