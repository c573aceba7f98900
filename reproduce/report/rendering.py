"""Render the templates in ``templates/``: pages of the report, model cards, computed blocks of README and docs."""

import math
from pathlib import Path
from typing import Any

import pandas as pd
from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template

from reproduce.analysis.tables import markdown_table

TEMPLATES = Path(__file__).with_name("templates")


def _table(frame: pd.DataFrame) -> str:
    return markdown_table([str(column) for column in frame.columns], frame.to_numpy().tolist())


def _percent(share: float, digits: int = 1) -> str:
    return f"{100 * share:.{digits}f} %"


def _span(bounds: tuple[float, float], unit: str = "") -> str:
    return f"{bounds[0]:g} to {bounds[1]:g} {unit}".strip()


_ENVIRONMENT = Environment(
    loader=FileSystemLoader(TEMPLATES),
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
)
_ENVIRONMENT.filters |= {
    "cell": lambda text: str(text).replace("|", "\\|").replace("\n", " "),
    "count": "{:,.0f}".format,
    "degrees": lambda angle: f"{math.degrees(angle):.0f} deg",
    "percent": _percent,
    "points": lambda share: f"{100 * share:.1f}",
    "span": _span,
    "spaced": lambda name: str(name).replace("_", " "),
    "table": _table,
}


def template(name: str) -> Template:
    """Return a template by its file's name without ``.j2``."""
    return _ENVIRONMENT.get_template(f"{name}.j2")


def render(name: str, **data: Any) -> str:
    """Return the text of a template filled with data.

    Raises:
        jinja2.UndefinedError: Where the template wants something that is not in the data.
    """
    return template(name).render(data)
