"""Task cards say what the code says."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sacil_tasks.cards import CardsConfig, card_text, index_text, main, usage
from sacil_tasks.catalog import task_names, task_spec
from sacil_tasks.contents import draw_contents
from sacil_tasks.instructions import all_templates
from sacil_tasks.scenes import scene_seed
from sacil_tasks.splits import SPLITS, why_not

FOLDER = Path(__file__).parents[2] / "docs" / "tasks"
STALE = "out of date: run `make cards` (or `python -m sacil_tasks.cards --text-only`)"
JITTER = 1 / (0.96 * 0.98)
"""Largest factor between a drawn size and its rung."""

each_task = pytest.mark.parametrize("task", task_names())


def rows(text: str) -> dict[str, str]:
    """Split -> last cell of its row."""
    return dict(re.findall(r"^\| `(\w+)` \|.*\| (.*) \|$", text, re.MULTILINE))


@each_task
def test_the_card_in_the_repository_is_up_to_date(task):
    assert (FOLDER / f"{task}.md").read_text() == card_text(task), STALE


def test_the_list_of_cards_in_the_repository_is_up_to_date():
    assert (FOLDER / "README.md").read_text() == index_text(), STALE


def test_every_task_has_a_card_and_a_picture_and_nothing_else_has():
    cards = {f"{task}.{kind}" for task in task_names() for kind in ("md", "png")}
    assert {path.name for path in FOLDER.iterdir()} == cards | {"README.md"}, STALE


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.md")), ids=lambda path: path.stem)
def test_links_lead_somewhere(path):
    text = path.read_text()
    links = re.findall(r"\]\(([^)]+)\)", text) + re.findall(r'src="([^"]+)"', text)
    assert links
    assert not [link for link in links if not (FOLDER / link).exists()]


@each_task
def test_a_card_has_every_sentence_and_every_split_with_the_reason_for_its_absence(task):
    spec, text = task_spec(task), card_text(task)
    assert all(f"\n- {template}\n" in text for template in all_templates(spec))
    refused = {name: f"n/a: {reason}" for name in SPLITS if (reason := why_not(spec, name))}
    shown = rows(text)
    assert list(shown) == list(SPLITS)
    assert {name: cell for name, cell in shown.items() if cell.startswith("n/a")} == refused


@each_task
def test_the_sizes_on_a_card_are_those_that_scenes_have(task):
    spec, cells = task_spec(task), rows(card_text(task))
    for split in spec.splits:
        triples = re.findall(r"([\d.]+) / ([\d.]+) / ([\d.]+)", cells[split])
        nominal_mm = np.array(triples, dtype=float)
        seeds = [scene_seed("val", 0, task, index, 0) for index in range(30)]
        drawn_mm = np.sort([1000 * draw_contents(spec, split, seed).sizes_m for seed in seeds])
        ratio = np.maximum(drawn_mm[:, None] / nominal_mm, nominal_mm / drawn_mm[:, None]).max(-1)
        assert (ratio.min(axis=1) < JITTER + 0.002).all(), split
        assert set(ratio.argmin(axis=1)) == set(range(len(triples))), split


@each_task
def test_a_card_is_complete_without_the_card_of_another_task(task):
    text = card_text(task)
    titles = re.findall(r"^## (.+)$", text, re.MULTILINE)
    assert titles[:3] == ["Task description", "Randomizations", "Success conditions"]
    assert "one colour for all" in text
    assert "those of" not in text
    assert "Env`" not in text


def test_texts_are_written_without_the_simulator(tmp_path):
    main(CardsConfig(out=tmp_path, text_only=True))
    written = {path.name for path in (tmp_path / "tasks").iterdir()}
    assert written == {f"{task}.md" for task in (*task_names(), "README")}
    code = "import sys, sacil_tasks.cards; sys.exit(bool({'torch', 'sapien'} & {*sys.modules}))"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


@pytest.mark.sim
def test_the_example_on_a_card_runs(capsys):
    exec(usage("pick_and_lift"), {})
    assert "small block" in capsys.readouterr().out
