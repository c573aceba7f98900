"""Checked records of ``lunar_rescue.scenes.records`` as plain data for files, and what differs between two of them."""

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import Field, TypeAdapter, ValidationError

from reproduce.storage.errors import UserError
from reproduce.storage.files import read_json

Record = TypeVar("Record")
#: A size of a network; the bound is what a file of somebody else may make us allocate.
Units = Annotated[int, Field(ge=1, le=4096)]


#: Returns a record as plain data that JSON can hold.
to_dict: Callable[[Any], dict[str, Any]] = asdict


def from_dict(kind: type[Record], raw: Any, where: str) -> Record:
    """Read a record, of a class decorated with ``checked``, from what a JSON file held; no missing field is guessed.

    What is wrong is a ``UserError`` of one line: ``where``, the path of the field, what was expected and what came.
    """
    from lunar_rescue.scenes.records import from_json  # brings the simulator, which names of presets do without

    try:
        record = from_json(kind, json.dumps(raw), where)
    except RecursionError:
        raise UserError(f"{where}expected {kind.__name__}, got data nested too deeply") from None
    except ValueError as error:  # a record's own check does not know where it is
        raise UserError(f"{where}{str(error).removeprefix(where)}") from None
    paths = {path for path, _ in flat(raw)}
    if missing := [path for path, _ in flat(to_dict(record)) if path not in paths]:
        raise UserError(f"{where}{missing[0]}: missing")
    return record


def read_record(path: Path, what: str, kind: Any) -> Any:
    """Read a JSON file that holds a ``kind``, any type of Pydantic's; a ``UserError`` names the field that is wrong."""
    raw = read_json(path, what)
    try:
        return TypeAdapter(kind).validate_python(raw)
    except ValidationError as error:
        fault = error.errors()[0]
        where = "".join(f"{place}: " for place in fault["loc"])
        raise UserError(f"{path}: {what}: {where}{fault['msg']}, got {fault['input']!r:.80}") from None


def flat(data: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield path and value of each leaf of nested objects, such as ``"training.low.gamma", 0.99``."""
    if isinstance(data, dict) and data:
        for name, value in data.items():
            yield from flat(value, f"{path}.{name}" if path else str(name))
    else:
        yield path, data


def differences(before: Any, now: Any) -> list[str]:
    """Compare plain data; return for each field that differs a text such as ``training.steps was 512, is 2048``."""
    old, new, nothing = dict(flat(before)), dict(flat(now)), "not there"
    pairs = {name: (old.get(name, nothing), new.get(name, nothing)) for name in {**old, **new}}
    return [f"{name} was {was!s:.60}, is {value!s:.60}" for name, (was, value) in pairs.items() if was != value]
