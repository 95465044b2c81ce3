"""Seed and split -> the sentence that is heard. Pure.

Meaning (slots) and sentence part ways here: a split may say the same in other words, say nothing,
or say what is not meant.
"""

from collections.abc import Mapping
from typing import Any

from sacil_tasks.errors import UsageError, find_name
from sacil_tasks.instructions import (
    Slots,
    check_slots,
    check_template,
    draw_words,
    render,
    variations,
)
from sacil_tasks.scenes import stream
from sacil_tasks.spec import TaskSpec
from sacil_tasks.splits import SPLITS, check_split

RESET_OPTIONS = ("slots", "template", "split", "reconfigure", "env_idx", "reset_to_env_states")
"""What `reset` may be told; the last three are ManiSkill's own."""


def check_names(options: Mapping[str, Any], known: tuple[str, ...]) -> None:
    """Check that all options of a reset are known.

    Raises:
        UsageError: one is not.
    """
    for name in options:
        find_name(name, known, "reset option")


def check_options(task: TaskSpec, split: str, options: Mapping[str, Any]) -> None:
    """Accept a split, and the slots and template among the options of a reset.

    Raises:
        UsageError: one of them does not belong to the task.
    """
    check_split(task, split)
    if "slots" in options:
        slots = options["slots"]
        if not isinstance(slots, dict):
            example = variations(task, split)[0]
            raise UsageError(f"slots are words by name, such as {example}, but {slots!r} came.")
        check_slots(task, slots, split)
    if "template" in options:
        check_template(task, options["template"])


def draw_meaning(task: TaskSpec, split: str, seed: int) -> tuple[Slots, int]:
    """Slots and template of a scene whose words are not chosen by hand."""
    if SPLITS[split].held_out_templates:
        slots, _ = draw_words(task, stream(seed, "instruction"), split)
        held_out = int(stream(seed, "templates").integers(len(task.held_out_templates)))
        return slots, len(task.templates) + held_out
    return draw_words(task, stream(seed, "instruction"), split)


def say(
    task: TaskSpec,
    split: str,
    slots: Slots,
    template: int,
    *,
    seed: int,
    colour_of: Mapping[str, str],
) -> str:
    """What is heard in scene `seed` when `slots` are meant; `colour_of` names labels by colour."""
    rules = SPLITS[split]
    if rules.speech == "blank":
        return ""
    if rules.speech == "other":
        choices = variations(task, split)
        shift = int(stream(seed, "other").integers(len(choices)))
        slots = choices[(choices.index(slots) + shift) % len(choices)]
    if rules.colours:
        phrases = {label: f"{colour} {{noun}}" for label, colour in colour_of.items()}
    else:
        phrases = dict(rules.phrases[int(stream(seed, "phrases").integers(len(rules.phrases)))])
    return render(task, slots, template, phrases)
