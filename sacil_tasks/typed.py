"""Values from JSON text, every part checked against the type it should have."""

from functools import cache
from typing import Any, Literal, TypeVar

from pydantic import TypeAdapter, ValidationError

T = TypeVar("T")


def parsed(kind: type[T], text: str, *, extra: Literal["forbid", "ignore"] = "forbid") -> T:
    """What `text` holds, as a `kind`: a dataclass, or anything else that pydantic knows.

    Strict: no text counts as a number, no number as a truth value. `extra` says whether fields
    that a dataclass does not have are an error.

    Raises:
        ValueError: no JSON, or not of this kind; in one line, for the first thing that is wrong.
    """
    try:
        adapter = _adapter(kind)  # type: ignore[arg-type]  # types are hashable
        return adapter.validate_json(text, strict=True, extra=extra)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(step) for step in first["loc"])
        raise ValueError(f"{place}: {first['msg']}" if place else first["msg"]) from error


@cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    return TypeAdapter(kind)
