"""Slots of meaning -> sentences (D-words), and back-checks of what a user asks for. Pure."""

import re
from itertools import permutations, product
from typing import TypeAlias

import numpy as np

from sacil_tasks.errors import UsageError, find_name
from sacil_tasks.spec import TaskSpec
from sacil_tasks.splits import SPLITS, TRAINED, Phrases

Slots: TypeAlias = dict[str, str]
"""Word of each blank, e.g. `{"first": "small", "second": "large"}`."""


def variations(spec: TaskSpec, split: str = "canon") -> tuple[Slots, ...]:
    """Every way to fill the blanks, sizes all different, in a fixed order."""
    labels = SPLITS[split].phrases[0]
    return tuple(
        dict(zip(spec.blanks, (*words, *places), strict=True))
        for words in permutations(labels, len(spec.slots))
        for places in product(*spec.receptacles.values())
    )


def all_templates(spec: TaskSpec) -> tuple[str, ...]:
    """Training templates, then held-out ones: a template index points here."""
    return spec.templates + spec.held_out_templates


def render(spec: TaskSpec, slots: Slots, template: int, phrases: Phrases = TRAINED) -> str:
    """Fill one template; `phrases` say each size of the noun that follows its blank.

    Raises:
        UsageError: the template index or the slots do not belong to the task.
    """
    check_template(spec, template)
    check_slots(spec, slots)

    def fill(blank: re.Match[str]) -> str:
        return phrases[slots[blank["slot"]]].format(noun=blank["noun"])

    names = "|".join(spec.slots)
    sentence = all_templates(spec)[template]
    return re.sub(rf"{{(?P<slot>{names})}} (?P<noun>\w+)", fill, sentence).format(**slots)


def official_sentences(spec: TaskSpec) -> tuple[str, ...]:
    """Every sentence of training and standard evaluation."""
    return tuple(
        render(spec, slots, template)
        for slots in variations(spec)
        for template in range(len(spec.templates))
    )


def draw_words(spec: TaskSpec, rng: np.random.Generator, split: str = "canon") -> tuple[Slots, int]:
    """Slots and training template, independent and uniform."""
    choices = variations(spec, split)
    slots = choices[int(rng.integers(len(choices)))]
    return slots, int(rng.integers(len(spec.templates)))


def check_slots(spec: TaskSpec, slots: Slots, split: str = "canon") -> None:
    """Accept a complete assignment of words, sizes all different.

    Raises:
        UsageError: a slot is missing or unknown, a word is unknown or used twice.
    """
    for name, word in slots.items():
        words = spec.blanks[find_name(str(name), spec.blanks, f"slot of {spec.name}")]
        find_name(str(word), words, "size word" if name in spec.slots else f"word for {name}")
    choices = variations(spec, split)
    if slots not in choices:
        raise UsageError(
            f"slots of {spec.name} are {', '.join(spec.blanks)}, each size with another word, "
            f"but {slots} came; choose one of {list(choices)}."
        )


def check_template(spec: TaskSpec, template: int) -> None:
    """Accept the index of a template.

    Raises:
        UsageError: there is no such template.
    """
    count = len(all_templates(spec))
    whole = isinstance(template, int | np.integer) and not isinstance(template, bool)
    if not whole or not 0 <= template < count:
        raise UsageError(
            f"{spec.name} has templates 0 to {count - 1}, but {template!r} came; take one of them."
        )
