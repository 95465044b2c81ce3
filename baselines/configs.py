"""Config dataclasses back from the JSON of `dataclasses.asdict`, with every field checked."""

import dataclasses
import types
import typing
from collections.abc import Mapping
from typing import Any, Literal, TypeVar

from sacil_tasks.errors import UsageError

C = TypeVar("C")


def restore(kind: type[C], values: Any, source: str, kinds: Mapping[str, type] | None = None) -> C:
    """Rebuild a (nested) config dataclass from its JSON.

    Args:
        kind: the dataclass.
        values: what `dataclasses.asdict` gave, after a round trip through JSON.
        source: where it came from, for messages.
        kinds: types of fields that are declared as `Any`.

    Raises:
        UsageError: a field is unknown, missing or of another type.
    """
    names = [field.name for field in dataclasses.fields(kind)]  # type: ignore[arg-type]
    strange = sorted(set(names) ^ set(values if isinstance(values, dict) else ()))
    if strange:
        raise UsageError(
            f"{source}: fields {', '.join(strange)} are not those of {kind.__name__}. "
            "It was written by another version of the code."
        )
    hints = typing.get_type_hints(kind) | dict(kinds or {})
    return kind(**{n: _restore_value(hints[n], values[n], f"{source}: {n}") for n in names})


def _restore_value(hint: Any, value: Any, source: str) -> Any:
    if dataclasses.is_dataclass(hint):
        return restore(typing.cast(type, hint), value, source)
    if isinstance(value, list):  # JSON has no tuples, configs no lists
        value = tuple(value)
    if not _fits(hint, value):
        raise UsageError(f"{source} cannot be {value!r}.")
    return value


def _fits(hint: Any, value: Any) -> bool:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is Literal:
        return value in arguments
    if origin in (typing.Union, types.UnionType):
        return any(_fits(argument, value) for argument in arguments)
    if origin is tuple:
        if not isinstance(value, tuple):
            return False
        kinds = arguments[:1] * len(value) if arguments[-1] is ... else arguments
        return len(kinds) == len(value) and all(map(_fits, kinds, value))
    if hint is float:
        return isinstance(value, int | float)
    return isinstance(value, hint) if isinstance(hint, type) else True
