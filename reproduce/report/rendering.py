"""Render the templates in ``templates/``: pages of the report, model cards, computed blocks of README and docs."""

import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pandas as pd
from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template

TEMPLATES = Path(__file__).with_name("templates")


def _cell(value: object) -> str:
    return str(value).replace("|", "\\|").replace("\n", " ")


def _table(frame: pd.DataFrame) -> str:
    cells: list[Iterable[object]] = [frame.columns, *frame.to_numpy().tolist()]
    head, *rows = (f"| {' | '.join(map(_cell, row))} |" for row in cells)
    return "\n".join([head, "|" + "---|" * frame.shape[1], *rows, ""])


_ENVIRONMENT = Environment(
    loader=FileSystemLoader(TEMPLATES),
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
)
FILTERS: dict[str, Callable[..., str]] = {
    "cell": _cell,
    "count": "{:,.0f}".format,
    "degrees": lambda angle: f"{math.degrees(angle):.0f} deg",
    "percent": lambda share, digits=1: f"{100 * share:.{digits}f} %",
    "points": lambda share: f"{100 * share:.1f}",
    "span": lambda bounds, unit="": f"{bounds[0]:g} to {bounds[1]:g} {unit}".strip(),
    "spaced": lambda name: str(name).replace("_", " "),
    "table": _table,
}
_ENVIRONMENT.filters |= FILTERS


def template(name: str) -> Template:
    """Return a template by its file's name without ``.j2``."""
    return _ENVIRONMENT.get_template(f"{name}.j2")


def render(name: str, **data: Any) -> str:
    """Return the text of a template filled with data; what it wants beyond them is Jinja's ``UndefinedError``."""
    return template(name).render(data)
