"""Slots of meaning -> sentences (D-words), and back-checks of what a user asks for. Pure."""

from itertools import permutations
from typing import TypeAlias

import numpy as np

from sacil_tasks.errors import UsageError, find_name
from sacil_tasks.sizes import LABELS
from sacil_tasks.spec import TaskSpec

Slots: TypeAlias = dict[str, str]
"""Size word of each slot, e.g. `{"first": "small", "second": "large"}`."""


def variations(spec: TaskSpec) -> tuple[Slots, ...]:
    """Every way to fill the slots with different size words, in a fixed order."""
    return tuple(
        dict(zip(spec.slots, words, strict=True)) for words in permutations(LABELS, len(spec.slots))
    )


def all_templates(spec: TaskSpec) -> tuple[str, ...]:
    """Training templates, then held-out ones: a template index points here."""
    return spec.templates + spec.held_out_templates


def render(spec: TaskSpec, slots: Slots, template: int) -> str:
    """Fill one template.

    Raises:
        UsageError: the template index or the slots do not belong to the task.
    """
    check_template(spec, template)
    check_slots(spec, slots)
    return all_templates(spec)[template].format(**slots)


def official_sentences(spec: TaskSpec) -> tuple[str, ...]:
    """Every sentence of training and standard evaluation."""
    return tuple(
        render(spec, slots, template)
        for slots in variations(spec)
        for template in range(len(spec.templates))
    )


def draw_words(spec: TaskSpec, rng: np.random.Generator) -> tuple[Slots, int]:
    """Slots and training template, independent and uniform."""
    choices = variations(spec)
    slots = choices[int(rng.integers(len(choices)))]
    return slots, int(rng.integers(len(spec.templates)))


def check_slots(spec: TaskSpec, slots: Slots) -> None:
    """Accept a complete assignment of different size words.

    Raises:
        UsageError: a slot is missing or unknown, a word is unknown or used twice.
    """
    for name, word in slots.items():
        find_name(str(name), spec.slots, f"slot of {spec.name}")
        find_name(str(word), LABELS, "size word")
    if slots not in variations(spec):
        raise UsageError(
            f"slots of {spec.name} are {', '.join(spec.slots)}, each with another size word, "
            f"but {slots} came; choose one of {list(variations(spec))}."
        )


def check_template(spec: TaskSpec, template: int) -> None:
    """Accept the index of a template.

    Raises:
        UsageError: there is no such template.
    """
    count = len(all_templates(spec))
    if isinstance(template, bool) or not isinstance(template, int) or not 0 <= template < count:
        raise UsageError(
            f"{spec.name} has templates 0 to {count - 1}, but {template!r} came; take one of them."
        )
