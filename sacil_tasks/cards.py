"""A card for each task: `python -m sacil_tasks.cards` writes them, and draws their pictures.

Every word of a card is read from where it is declared: the task's file, the size ladders, the
splits. A new task gets its card by running this again; a test says when that is due.
"""

import json
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from jaxtyping import Float64

from sacil_tasks.catalog import MAX_EPISODE_STEPS, env_id, task_docstrings, task_names, task_spec
from sacil_tasks.errors import run_command
from sacil_tasks.files import atomic_path
from sacil_tasks.instructions import variations
from sacil_tasks.interface import MAX_KEYFRAMES
from sacil_tasks.sizes import CANDIDATES, FAMILIES, LABELS, sizes_m, spread_m
from sacil_tasks.spec import TaskSpec
from sacil_tasks.splits import SPLITS, Split, why_not

_HEADING = re.compile(r"^\*\*(.+):\*\*$", re.MULTILINE)
_INHERITED = re.compile(r"^- those of `(\w+)Env`$", re.MULTILINE)
_SHOWN = {"all": "", "two": "two of ", "named": "one of "}
"""How many of the candidates a split leaves on the table."""

_DEVIATIONS = "../../DEVIATIONS.md"


@dataclass(frozen=True, kw_only=True)
class CardsConfig:
    """Which scenes to draw, and where the documents are."""

    scene: int = 3
    """Index of the validation scene that is drawn of every task."""

    out: Path = Path("docs")
    """Cards and their pictures go to its folder `tasks`, the README's pictures to `images`."""

    text_only: bool = False
    """Leave the pictures as they are: takes a second and starts no simulator."""


def card_text(task: str) -> str:
    """The card of a task, in Markdown.

    Raises:
        UsageError: there is no such task.
    """
    spec, sections = task_spec(task), _sections(task)
    blocks = [
        f"<!-- Written by `python -m sacil_tasks.cards` from sacil_tasks/tasks/{task}.py. -->",
        f"# {task}\n\n{_summary(task)}",
        f"![{_summary(task)} A scene, and what the four cameras see]({task}.png)",
        "Large: after the expert's first keyframe. Small: what a policy sees at the start.",
        *[f"## {title.capitalize()}\n\n{_linked(text)}" for title, text in sections.items()],
        f"## Facts\n\n{_bullets(_facts(spec))}",
        f"## Use\n\n```python\n{usage(task)}```",
        f"## Sentences\n\n{_sentences(spec)}",
        f"## Splits and sizes\n\n{_split_table(spec)}",
    ]
    return "\n\n".join(blocks) + "\n"


def usage(task: str) -> str:
    """Python that plays a step of a task."""
    slots = json.dumps(variations(task_spec(task))[0])
    return f"""\
import gymnasium as gym

env = gym.make("sacil_tasks:{env_id(task)}", obs_mode="rgbd")
slots = {slots}
observation, info = env.reset(seed=7, options={{"slots": slots}})
print(env.unwrapped.get_language_instruction())
observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
env.close()
"""


def index_text() -> str:
    """The page that lists all cards, in Markdown."""
    specs = [task_spec(task) for task in task_names()]
    return f"""\
<!-- Written by `python -m sacil_tasks.cards`. -->
# Tasks

In each, size is the only cue that separates what is named from its look-alikes. K is the number of
the expert's keyframes; sizes are those of the whole ladder, of which `canon` shows three.

{_table(("", "task", "words", "variations", "K", "sizes in mm", "splits"), map(_row, specs))}

## Which task has which split

{_matrix(specs)}

Each card gives the reasons for n/a.
"""


def _row(spec: TaskSpec) -> tuple[str, ...]:
    picture = f'<img src="{spec.name}.png" width="280" alt="{_summary(spec.name)}">'
    return (
        f"[{picture}]({spec.name}.md)",
        f"[{spec.name}]({spec.name}.md)<br>`{env_id(spec.name)}`",
        spec.templates[0],
        str(len(variations(spec))),
        str(spec.keyframes),
        _ladder(spec),
        f"{len(spec.splits)} of {len(SPLITS)}",
    )


def _matrix(specs: Iterable[TaskSpec]) -> str:
    heads = [f"[{spec.name}]({spec.name}.md)" for spec in specs]
    rows = [
        (f"`{name}`", split.use, *("yes" if name in spec.splits else "n/a" for spec in specs))
        for name, split in SPLITS.items()
    ]
    return _table(("split", "", *heads), rows)


def _summary(task: str) -> str:
    return task_docstrings(task)[0].splitlines()[0]


def _sections(task: str) -> dict[str, str]:
    """Title -> text of a task's docstring, with what it takes over from another task."""
    _, *parts = _HEADING.split(task_docstrings(task)[1])
    texts = dict(zip(parts[::2], parts[1::2], strict=True))

    def inherited(title: str) -> Callable[[re.Match[str]], str]:
        return lambda match: _sections(_snake(match[1]))[title]

    return {title: _INHERITED.sub(inherited(title), text.strip()) for title, text in texts.items()}


def _linked(text: str) -> str:
    """Text of a docstring with links to other cards and to the table of departures."""
    text = re.sub(r"`(\w+)Env`", lambda m: f"[{_snake(m[1])}]({_snake(m[1])}.md)", text)
    return re.sub(r"\bD-[a-z-]+", rf"[\g<0>]({_DEVIATIONS})", text)


def _facts(spec: TaskSpec) -> tuple[str, ...]:
    suites = ", ".join(f"`{suite}`" for suite in spec.suites)
    sizes = " and ".join(f"`{slot}`" for slot in spec.slots)
    different = "different ones of " if len(spec.slots) > 1 else ""
    places = [f"; `{name}`: {', '.join(words)}" for name, words in spec.receptacles.items()]
    return (
        f"gymnasium id: `{env_id(spec.name)}`; suites: {suites}",
        f"{len(variations(spec))} variations of the words; {sizes}: {different}{', '.join(LABELS)}"
        + "".join(places),
        f"{spec.keyframes} keyframes of the expert; a policy may spend {MAX_KEYFRAMES}",
        f"cut off after {MAX_EPISODE_STEPS} control steps",
    )


def _sentences(spec: TaskSpec) -> str:
    trained = f"In training:\n\n{_bullets(spec.templates)}"
    if not spec.held_out_templates:
        return trained
    splits = " and ".join(f"`{name}`" for name, it in SPLITS.items() if it.held_out_templates)
    return f"{trained}\n\nHeld out, for {splits}:\n\n{_bullets(spec.held_out_templates)}"


def _split_table(spec: TaskSpec) -> str:
    rows = [(f"`{name}`", split.use, _sizes(spec, name)) for name, split in SPLITS.items()]
    return (
        f"The size is the {_ladder(spec)} mm. A scene departs from these rungs by a few percent."
        "\n\n" + _table(("split", "for", " / ".join(LABELS) + " in mm"), rows)
    )


def _ladder(spec: TaskSpec) -> str:
    family = FAMILIES[spec.family]
    return f"{family.measure} of a {spec.family}: {', '.join(map(_millimetres, family.rungs_m))}"


def _sizes(spec: TaskSpec, name: str) -> str:
    reason = why_not(spec, name)
    if reason is not None:
        return f"n/a: {reason}"
    split = SPLITS[name]
    triples = [" / ".join(map(_millimetres, triple)) for triple in _nominal_m(spec.family, split)]
    return _SHOWN[split.objects] + " or ".join(triples)


def _nominal_m(family: str, split: Split) -> list[Float64[np.ndarray, "3"]]:
    """What the candidates of a split measure but for the jitter, small to large."""
    labels, unjittered = np.arange(CANDIDATES), np.ones(CANDIDATES)
    if split.ratio is not None:
        return [spread_m(family, split.ratio, labels, unjittered)]
    firsts = FAMILIES[family].first_rungs(split.first_rungs)
    return [sizes_m(family, first, labels, unjittered) for first in firsts]


def _millimetres(size_m: float) -> str:
    return f"{1000 * size_m:.3g}"


def _snake(camel: str) -> str:
    """`PlaceCup` -> `place_cup`."""
    return re.sub(r"(?<!^)(?=[A-Z])", "_", camel).lower()


def _bullets(items: Iterable[str]) -> str:
    return "\n".join(f"- {item}" for item in items)


def _table(heads: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    heads = list(heads)
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def write_texts(folder: Path) -> None:
    """Write all cards and the page that lists them.

    Raises:
        UsageError: the folder cannot be written.
    """
    texts = {task: card_text(task) for task in task_names()} | {"README": index_text()}
    for name, text in texts.items():
        with atomic_path(folder / f"{name}.md") as draft:
            draft.write_text(text)


def main(config: CardsConfig) -> None:
    """Write the cards, then draw the pictures."""
    write_texts(config.out / "tasks")
    if not config.text_only:
        from sacil_tasks.picture import draw_all  # starts the simulator

        draw_all(config.out, config.scene)


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(CardsConfig, description=__doc__)))
