"""Config dataclasses: what their numbers may be, and how they come back from the JSON of
`dataclasses.asdict`, every field checked.
"""

import dataclasses
import json
import math
import types
import typing
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, TypeAlias, TypeVar

from sacil_tasks.errors import UsageError
from sacil_tasks.typed import parsed

C = TypeVar("C")

UNIONS = (typing.Union, types.UnionType)
"""Origins of hints such as `int | None`."""


@dataclasses.dataclass(frozen=True)
class Range:
    """Which numbers a field may hold; all are finite."""

    low: float
    high: float = math.inf
    above: bool = False
    """The lowest itself is left out."""

    below: bool = False
    """The highest itself is left out."""

    odd: bool = False

    def __contains__(self, number: float) -> bool:
        """Whether a field may hold it."""
        if not math.isfinite(number) or (self.odd and number % 2 != 1):
            return False
        low = number > self.low if self.above else number >= self.low
        return low and (number < self.high if self.below else number <= self.high)

    def __str__(self) -> str:
        """What a user may write."""
        words = ["an odd number" if self.odd else "a finite number"]
        words.append(f"{'above' if self.above else 'from'} {self.low:g}")
        if math.isfinite(self.high):
            words.append(f"{'below' if self.below else 'to'} {self.high:g}")
        return " ".join(words)


Natural: TypeAlias = Annotated[int, Range(0)]
Odd: TypeAlias = Annotated[int, Range(1, odd=True)]
Positive: TypeAlias = Annotated[float, Range(0, above=True)]
Share: TypeAlias = Annotated[float, Range(0, 1)]
Fraction: TypeAlias = Annotated[float, Range(0, 1, below=True)]


def check_numbers(config: Any) -> None:
    """Call in a config's `__post_init__`: numbers that make no network end here in one sentence.

    A field that does not say otherwise holds, if an integer, a count from 1, and if a float, a
    number that is not negative; tuples are not empty.

    Raises:
        UsageError: names the field, what it may be and what came.
    """
    hints = typing.get_type_hints(type(config), include_extras=True)
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        for number, allowed in _numbers(hints[field.name], value):
            if number not in allowed:
                raise UsageError(f"{field.name} must be {allowed}, not {value}.")
        if value == () and not field.metadata.get("may_be_empty"):
            raise UsageError(f"{field.name} must not be empty.")


def _numbers(hint: Any, value: Any) -> Iterator[tuple[float, Range]]:
    """The numbers in a field's value, each with its range."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is Annotated:
        yield value, next(it for it in hint.__metadata__ if isinstance(it, Range))
    elif origin in UNIONS and value is not None:
        tuples = isinstance(value, tuple)
        alike = [it for it in arguments if (typing.get_origin(it) is tuple) == tuples]
        yield from _numbers(alike[0], value)
    elif origin is tuple:
        kinds = arguments[:1] * len(value) if arguments[-1] is ... else arguments
        for kind, part in zip(kinds, value, strict=True):
            yield from _numbers(kind, part)
    elif hint in (int, float):
        yield value, Range(1 if hint is int else 0)


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
    try:
        return parsed(hint, json.dumps(value))
    except ValueError as error:
        raise UsageError(f"{source} cannot be {value!r}.") from error
