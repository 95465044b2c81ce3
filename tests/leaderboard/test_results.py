"""The committed results belong to this code, and README says what they say."""

import csv
import json
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path

import pytest

from baselines.checkpoint import released_folder, sha256
from leaderboard import tables
from leaderboard.manifest import read_manifest
from leaderboard.protocol import protocol_of
from leaderboard.records import EPISODES_FILE, EpisodeRecord, read_records
from leaderboard.summary import write_summary
from leaderboard.tables import TablesConfig
from sacil_tasks.catalog import suite_tasks
from sacil_tasks.sizes import LABELS

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "results"
AGENTS = ("sacil", "rvt", "blind", "random", "hold", "oracle")
STUDIES = ("val_40k", "val_120k", "val_120k_splits")
RUNS = sorted(path.parent for path in RESULTS.rglob(EPISODES_FILE))

each_run = pytest.mark.parametrize("run", RUNS, ids=lambda run: str(run.relative_to(RESULTS)))


@cache
def records_of(run: Path) -> list[EpisodeRecord]:
    return read_records(run / EPISODES_FILE)


def test_every_agent_has_a_test_run():
    assert {RESULTS / "test" / agent for agent in AGENTS} <= set(RUNS)


def test_every_release_was_evaluated():
    played = {record.checkpoint for run in RUNS for record in records_of(run)[:1]}
    for config in ROOT.glob("*/released/*/*/config.json"):
        assert sha256(config.parent) in played, config.parent


@each_run
def test_the_summary_is_what_the_episodes_come_to(run, tmp_path):
    write_summary(tmp_path / "summary.csv", records_of(run))
    assert (tmp_path / "summary.csv").read_bytes() == (run / "summary.csv").read_bytes()


@each_run
def test_scenes_and_rules_are_those_of_this_code(run):
    for record in records_of(run):
        protocol = protocol_of(record.task, record.partition, record.scene_set, record.split)
        assert record.protocol == protocol.hash, "rerun results/ after a change of the protocol"


@each_run
def test_weights_are_the_released_ones(run):
    agent = records_of(run)[0].agent
    if run.parent.name in STUDIES:  # on val; the weights can be trained again
        assert {record.partition for record in records_of(run)} == {"val"}
        assert read_manifest(run).training is not None
        return
    expected = None if agent in AGENTS[2:] else sha256(release_of(agent, run))
    assert {record.checkpoint for record in records_of(run)} == {expected}


def release_of(agent: str, run: Path) -> Path:
    """The release whose weights played."""
    name, _, variant = agent.partition(":")
    suite = "single" if run.parent.name == "single" else "slice"
    return released_folder(name) / (f"{suite}.{variant}" if variant else suite)


def test_all_agents_met_the_same_scenes():
    shown: dict[tuple, set[str]] = {}
    for run in RUNS:
        for record in records_of(run):
            shown.setdefault(record.key, set()).add(record.fingerprint)
    assert all(len(fingerprints) == 1 for fingerprints in shown.values())


def test_readme_has_the_table():
    readme = (ROOT / "README.md").read_text()
    for line in table():
        assert line in readme, "paste:\n" + "\n".join(table())


def table() -> Iterator[str]:
    """Rows of README's table: strict success, interval and count of each agent that played."""
    cells = {}
    for agent in AGENTS:
        with (RESULTS / "test" / agent / "summary.csv").open() as file:
            for row in csv.DictReader(file):
                cells[row["task"], row["split"], agent] = cell(row)
    for task, split in dict.fromkeys(key[:2] for key in cells):
        shown = " | ".join(cells.get((task, split, agent), "") for agent in AGENTS)
        yield f"| {task} | {split} | {shown} |"


def test_the_tables_are_what_the_runs_come_to(tmp_path, monkeypatch):
    monkeypatch.chdir(ROOT)
    tables.main(TablesConfig(runs=(Path("results"),), samples=40_000, out=tmp_path))
    for made in tmp_path.iterdir():
        assert made.read_bytes() == (RESULTS / made.name).read_bytes(), made.name


def test_readme_has_table_1():
    readme = (ROOT / "README.md").read_text()
    for line in table_1():
        assert line in readme, "paste:\n" + "\n".join(table_1())


def table_1() -> Iterator[str]:
    """Rows of README's table: successes of each network by task, and what its training took."""
    with (RESULTS / "table1_single.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["core_minutes"]]
    for row in rows:
        tasks = " | ".join(
            f"{row[f'{task}_successes']}/{row[f'{task}_episodes']}"
            for task in suite_tasks("single")
        )
        average = f"{row['average']} ({row['average_low']}-{row['average_high']})"
        yield f"| {row['model']} | {average} | {tasks} | {row['core_minutes']} |"


def test_readme_has_the_experts_table():
    readme = (ROOT / "README.md").read_text()
    for line in expert_table():
        assert line in readme, "paste:\n" + "\n".join(expert_table())


def expert_table() -> Iterator[str]:
    """Rows of README's table: the expert's clean episodes by split, and by the size named first."""
    played: dict[tuple[str, str], list[dict]] = {}
    rejected: Counter[str] = Counter()
    for line in (RESULTS / "audit" / "expert.jsonl").read_text().splitlines():
        trial = json.loads(line)
        _, task, split, *_ = trial["trial"]
        for row in trial["rows"]:
            played.setdefault((task, split), []).extend(row["episodes"])
            rejected[task] += row["rejected"]
    for task in sorted(task for task, split in played if split == "canon"):
        canon = played[task, "canon"]
        sizes = [[it for it in canon if it["asked"][0] == label] for label in LABELS]
        shifts = [played.get((task, split), []) for split in ("shift_down", "shift_up")]
        cells = " | ".join(clean(it) for it in (canon, *sizes, *shifts))
        yield f"| {task} | {cells} | {rejected[task]} |"


def clean(episodes: Sequence[dict]) -> str:
    won = sum(it["clean"] for it in episodes)
    return f"{won}/{len(episodes)}" if episodes else "n/a"


def cell(row: dict[str, str]) -> str:
    percent = f"{row['rate_percent']} ({row['low_percent']}-{row['high_percent']})"
    return f"{percent}, {row['successes']}/{row['episodes']}"
