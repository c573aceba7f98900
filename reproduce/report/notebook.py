"""An executed notebook as a page: its text as Markdown, its cells as HTML with the code folded away."""

from __future__ import annotations

import html
import logging
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import nbformat
from latex2mathml.converter import convert
from nbconvert import HTMLExporter

_DISPLAY = re.compile(r"\$\$(.+?)\$\$", re.DOTALL)
_INLINE = re.compile(r"(?<![\\$\w])\$(?!\s)([^$\n]+?)(?<!\s)\$(?![\w$])")
_CODE = re.compile(r"(```.*?```|`[^`\n]*`)", re.DOTALL)

FOLDED = """{%- extends 'basic/index.html.j2' -%}
{%- block input -%}<details class="code"><summary>code</summary>{{ super() }}</details>{%- endblock input -%}
"""


@dataclass(frozen=True)
class Page:
    """Markdown with marks, and what stands for each mark in the finished page.

    Attributes:
        title: First heading.
        text: Markdown.
        pieces: HTML by mark.
    """

    title: str
    text: str
    pieces: dict[str, str]


def fill_in(page: str, pieces: dict[str, str]) -> str:
    """Put HTML in place of the marks of a finished page."""
    for mark, piece in pieces.items():
        page = page.replace(f"<p>{mark}</p>", piece).replace(mark, piece)
    return page


def mark_mathematics(text: str, pieces: dict[str, str], prefix: str) -> str:
    """Replace $...$ and $$...$$ outside code by marks for MathML, which browsers render by themselves."""

    def marked(match: re.Match[str], display: Any) -> str:
        mark = f"@@{prefix}math{len(pieces)}@@"
        made: str = convert(match.group(1).strip(), display=display)
        pieces[mark] = made.replace("\n", " ")
        return f"\n\n{mark}\n\n" if display == "block" else mark

    parts = _CODE.split(text)
    for index in range(0, len(parts), 2):
        part = _DISPLAY.sub(lambda m: marked(m, "block"), parts[index])
        parts[index] = _INLINE.sub(lambda m: marked(m, "inline"), part)
    return "".join(parts)


def notebook_page(path: Path) -> Page:
    """Make a page of an executed notebook."""
    document = nbformat.read(path, as_version=4)
    pieces: dict[str, str] = {}
    prefix, heading = path.stem[:2], path.stem
    texts = []
    # Without the cell that papermill adds, numbers are those of the notebook that a reader opens.
    cells = [cell for cell in document.cells if "injected-parameters" not in cell.metadata.get("tags", [])]
    for index, cell in enumerate(cells):
        if cell.cell_type == "markdown":
            text = mark_mathematics(cell.source, pieces, prefix)
            headings = re.findall(r"^#{1,3} +(.+)$", text, re.MULTILINE)
            heading = headings[-1] if headings else heading
            texts.append(text)
        elif cell.cell_type == "code" and cell.source.strip():
            mark = f"@@{prefix}cell{index}@@"
            where = f"notebooks/{path.name}, cell {index + 1}" if cell.outputs else ""
            pieces[mark] = _cell_html(cell, heading, where)
            texts.append(mark)
    title = next(iter(re.findall(r"^# +(.+)$", "\n".join(texts), re.MULTILINE)), path.stem)
    origin = document.metadata.get("papermill", {})
    made = (
        f"Everything on this page comes from `notebooks/{path.name}`, run by "
        f"`reproduce notebooks --only {path.stem[:2]}` with {_parameters(origin)}, finished {_when(origin)}; "
        "what it reads from results/ says there which command made it."
    )
    return Page(title, "\n\n".join([*texts, f'<p class="origin" markdown="1">{made}</p>']), pieces)


def _parameters(origin: Any) -> str:
    given = dict(origin.get("parameters") or {})
    return ", ".join(f"`{name}={value!r}`" for name, value in given.items()) or "its own parameters"


def _when(origin: Any) -> str:
    return str(origin.get("end_time") or "at an unknown time")[:19]


def _cell_html(cell: Any, heading: str, origin: str) -> str:
    logging.getLogger("traitlets").setLevel(logging.ERROR)  # it asks for descriptions, which are added below
    document = nbformat.v4.new_notebook(cells=[cell])
    exporter = HTMLExporter(exclude_input_prompt=True, exclude_output_prompt=True)
    exporter.raw_template = FOLDED
    body, _ = exporter.from_notebook_node(document)
    made = f'<p class="origin">{origin}</p>' if origin else ""
    return f'<div class="cell">{_described(_plain_tables(str(body)), heading)}{made}</div>'


def _plain_tables(body: str) -> str:
    """Tables without their own style, so that they look like the site's."""
    body = re.sub(r"<style scoped>.*?</style>", "", body, flags=re.DOTALL)
    return re.sub(r'<table border="\d+" class="dataframe">', "<table>", body)


def _described(body: str, heading: str) -> str:
    """Give each picture the heading above it as its description."""
    alt = html.escape(re.sub(r"[@$`*_]+", "", heading).strip(), quote=True)
    body = re.sub(r'(<img [^>]*?) alt="[^"]*"', r"\1", body)
    return body.replace("<img ", f'<img alt="{alt}" loading="lazy" ')
