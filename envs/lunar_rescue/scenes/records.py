"""Frozen dataclasses that pydantic checks: strict types, ranges, no extra fields, and errors of one line."""

import functools
import reprlib
from typing import Any, TypeVar

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass as pydantic_dataclass

T = TypeVar("T")


def within(bounds: tuple[float, float]) -> Any:
    """Return the annotation of a number between two bounds, both included."""
    return Field(ge=bounds[0], le=bounds[1])


def checked(cls: type[T]) -> type[T]:
    """Let pydantic check the fields of a dataclass whenever one is made; what is wrong is a ``ValueError``.

    Args:
        cls: A standard dataclass; its ``__post_init__`` checks what types and ranges cannot say.
    """
    parameters = cls.__dataclass_params__  # type: ignore[attr-defined]
    if hasattr(cls, "__pydantic_validator__"):  # of a base; of such a class pydantic would make a dataclass twice
        names = {name: getattr(cls, name) for name in ("__module__", "__qualname__", "__doc__")}
        cls = type(cls.__name__, (cls,), names)
    strict = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)
    record: Any = pydantic_dataclass(cls, frozen=parameters.frozen, eq=parameters.eq, config=strict)
    validated = record.__init__

    @functools.wraps(validated)
    def init(self: Any, *args: Any, **kwargs: Any) -> None:
        try:
            validated(self, *args, **kwargs)
        except ValidationError as error:
            raise ValueError(_explain(error, f"{cls.__name__}.")) from None

    record.__init__ = init
    checked_class: type[T] = record
    return checked_class


def from_json(cls: type[T], text: str | bytes, where: str) -> T:
    """Read a record from JSON text.

    Args:
        cls: A class decorated with ``checked``.
        text: The text.
        where: Written before the field in errors, such as ``"Scene."`` or a file's name.

    Raises:
        ValueError: In one line: where, field, what was expected and what came.
    """
    try:
        record: T = _adapter(cls).validate_json(text)  # type: ignore[arg-type]  # classes are hashable
        return record
    except ValidationError as error:
        raise ValueError(_explain(error, where)) from None


@functools.cache
def _adapter(cls: Any) -> TypeAdapter[Any]:
    return TypeAdapter(cls)


def _explain(error: ValidationError, where: str) -> str:
    """Say in one line what the first of pydantic's errors is about."""
    first = error.errors(include_url=False)[0]
    kind, message = first["type"], first["msg"]
    if kind == "value_error":
        return str(first["ctx"]["error"])
    path = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in first["loc"]).lstrip(".")
    name = f"{where}{path}" if path else where.rstrip(".: ")
    if kind == "json_invalid":
        return f"{name}: not JSON: {first['ctx']['error']}"
    if kind in ("missing", "missing_argument"):
        return f"{name}: missing"
    if kind.startswith("unexpected"):
        return f"{name}: unknown field"
    return f"{name}: expected {message.removeprefix('Input should be ')}, got {reprlib.repr(first['input'])}"
