"""Frozen dataclasses that pydantic checks: strict types, ranges, no extra fields, and errors of one line."""

import functools
import reprlib
from typing import Any, TypeVar, cast

from pydantic import ConfigDict, Field, ValidationError
from pydantic.dataclasses import dataclass as pydantic_dataclass

T = TypeVar("T")


def within(bounds: tuple[float, float]) -> Any:
    """Return the annotation of a number between two bounds, both included."""
    return Field(ge=bounds[0], le=bounds[1])


def checked(cls: type[T]) -> type[T]:
    """Let pydantic check the fields of a dataclass whenever one is made; what is wrong is a ``ValueError``.

    The ``__post_init__`` of the standard dataclass checks what types and ranges cannot say.
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
    return cast(type[T], record)


def from_json(cls: type[T], text: str | bytes, where: str) -> T:
    """Read a record of a ``checked`` class from JSON text.

    Raises:
        ValueError: In one line: where (such as ``"Scene."`` or a file's name), field, what was expected and what came.
    """
    try:
        return cast(T, cls.__pydantic_validator__.validate_json(text))  # type: ignore[attr-defined]
    except ValidationError as error:
        raise ValueError(_explain(error, where)) from None


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
