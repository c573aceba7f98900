"""Turn an executed notebook into a page: its text as Markdown, its cells as HTML with the code folded away."""

from __future__ import annotations

import base64
import html
import io
import logging
import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import nbformat
import numpy as np
from latex2mathml.converter import convert
from nbconvert import HTMLExporter
from PIL import Image

from reproduce.report.notebooks import failed_output
from reproduce.report.rendering import TEMPLATES, render

_CODE, _BLOCK = r"```.*?```|`[^`\n]*`", r"\$\$(?P<block>.+?)\$\$"
_INLINE = r"(?<![\\$\w])\$(?!\s)(?P<inline>[^$\n]+?)(?<!\s)\$(?![\w$])"
_CODE_OR_MATHEMATICS = re.compile(f"{_CODE}|{_BLOCK}|{_INLINE}", re.DOTALL)
_DATA_IMAGE = re.compile(r'<img [^>]*src="data:image/png;base64,(?P<data>[^"]+)"')
FOLDED = "fold"  # tag of cells whose output is an appendix
WHITE, PAPER = 250, 0.35  # least brightness of white, of 255; least share of it in a chart
_HEADING = re.compile(r"^#{1,3} +(.+)$", re.MULTILINE)


@dataclass(frozen=True)
class Page:
    """Markdown with marks, and what stands for each mark in the finished page."""

    title: str  # the first heading
    text: str  # Markdown
    pieces: dict[str, str]  # HTML by mark


def fill_in(page: str, pieces: dict[str, str]) -> str:
    """Put HTML in place of the marks of a finished page."""
    for mark, piece in pieces.items():
        page = page.replace(f"<p>{mark}</p>", piece).replace(mark, piece)
    return page


def mark_mathematics(text: str, pieces: dict[str, str], prefix: str) -> str:
    """Replace $...$ and $$...$$ outside code by marks for MathML, which browsers render by themselves."""

    def put_mark(match: re.Match[str]) -> str:
        if match.lastgroup is None:  # code
            return match[0]
        mark, display = f"@@{prefix}math{len(pieces)}@@", match.lastgroup
        pieces[mark] = str(convert(match[display].strip(), display=display)).replace("\n", " ")
        return f"\n\n{mark}\n\n" if display == "block" else mark

    return _CODE_OR_MATHEMATICS.sub(put_mark, text)


def notebook_page(path: Path) -> Page:
    """Make a page of an executed notebook; it says so where a later run stopped before its end."""
    document = nbformat.read(path, as_version=4)
    pieces: dict[str, str] = {}
    prefix, title, heading, texts = path.stem[:2], "", path.stem, []
    # Without the cell that papermill adds, numbers are those of the notebook that a reader opens.
    cells = [cell for cell in document.cells if "injected-parameters" not in cell.metadata.get("tags", [])]
    for index, cell in enumerate(cells):
        if cell.cell_type == "markdown":
            for found in _HEADING.findall(cell.source):
                heading = found.replace("$", "")
                title = title or heading
            texts.append(mark_mathematics(cell.source, pieces, prefix))
        elif cell.cell_type == "code" and cell.source.strip():
            mark = f"@@{prefix}cell{index}@@"
            pieces[mark] = _cell_html(cell, heading, f"notebooks/{path.name}, cell {index + 1}")
            texts.append(mark)
    origin, failed = document.metadata.get("papermill", {}), failed_output(path.parent, path.stem)
    text = render(
        "notebook.md",
        texts=texts,
        file=path.name,
        failed=failed.name if failed.exists() else None,
        parameters=origin.get("parameters") or {},
        finished=str(origin.get("end_time") or "at an unknown time")[:19],
    )
    return Page(title or path.stem, text, pieces)


@cache
def _exporter() -> HTMLExporter:
    logging.getLogger("traitlets").setLevel(logging.ERROR)  # it asks for descriptions, which are added below
    exporter = HTMLExporter(exclude_input_prompt=True, exclude_output_prompt=True)
    exporter.raw_template = (TEMPLATES / "cell.html.j2").read_text(encoding="utf-8")
    return exporter


def _cell_html(cell: Any, heading: str, where: str) -> str:
    """Return a cell as HTML: tables look like the site's, and each picture has the heading above it as description."""
    body, _ = _exporter().from_notebook_node(nbformat.v4.new_notebook(cells=[cell]))
    body = re.sub(r"<style scoped>.*?</style>", "", body, flags=re.DOTALL)
    body = re.sub(r'<table border="\d+" class="dataframe">', "<table>", body)
    alt = html.escape(re.sub(r"[@$`*_]+", "", heading).strip(), quote=True)
    body = re.sub(r'(<img [^>]*?) alt="[^"]*"', r"\1", body).replace("<img ", f'<img alt="{alt}" loading="lazy" ')
    body = _DATA_IMAGE.sub(_as_chart, body)
    origin = f'<p class="origin">{where}</p>' if cell.outputs else ""
    whole = f'<div class="cell">{body}{origin}</div>'
    if FOLDED not in cell.metadata.get("tags", []):
        return whole
    shown = "figure" if "<img " in body else "table"
    return f'<details class="folded"><summary>{html.escape(heading)}: show the {shown}</summary>{whole}</details>'


def _as_chart(match: re.Match[str]) -> str:
    """Mark a picture that is mostly white paper as a chart, which the style turns dark with the page."""
    with Image.open(io.BytesIO(base64.b64decode(match["data"]))) as picture:
        white = np.asarray(picture.convert("L").resize((64, 64))) > WHITE
    return match[0].replace("<img ", '<img class="chart" ') if white.mean() > PAPER else match[0]
