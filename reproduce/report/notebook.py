"""One HTML page from the executed notebooks: figures inside, mathematics as MathML, no network needed."""

from __future__ import annotations

import html
import logging
import re
from pathlib import Path
from typing import Any

import nbformat
import pandas as pd
from latex2mathml.converter import convert
from nbconvert import HTMLExporter

from reproduce.claims import compute_claims
from reproduce.files import write_text
from reproduce.provenance import provenance
from reproduce.tables import readable_table1

_DISPLAY = re.compile(r"\$\$(.+?)\$\$", re.DOTALL)
_INLINE = re.compile(r"(?<![\\$\w])\$(?!\s)([^$\n]+?)(?<!\s)\$(?![\w$])")
_CODE = re.compile(r"(```.*?```|`[^`\n]*`)", re.DOTALL)

FOLDED = """{%- extends 'basic/index.html.j2' -%}
{%- block input -%}<details><summary>code</summary>{{ super() }}</details>{%- endblock input -%}
"""

STYLE = """
:root { color-scheme: light dark; --text: #1d2129; --back: #fff; --soft: #f2f4f7; --line: #d5dae2; --link: #1556a8; }
@media (prefers-color-scheme: dark) {
  :root { --text: #e4e7ec; --back: #15181d; --soft: #20252d; --line: #39414d; --link: #7db3ff; }
}
body { font: 16px/1.6 system-ui, sans-serif; color: var(--text); background: var(--back); margin: 0; }
main { max-width: 60rem; margin: 0 auto; padding: 1rem; }
nav { position: sticky; top: 0; z-index: 1; padding: .5rem 1rem; }
nav { background: var(--soft); border-bottom: 1px solid var(--line); }
nav a { margin-right: 1rem; color: var(--link); white-space: nowrap; }
a { color: var(--link); }
h1 { line-height: 1.25; border-top: 1px solid var(--line); padding-top: 2rem; }
img, svg { max-width: 100%; height: auto; background: #fff; }
table { border-collapse: collapse; border: 0; margin: 1rem 0; display: block; overflow-x: auto; font-size: .9rem; }
th, td { border: 1px solid var(--line); padding: .25rem .6rem; text-align: left; vertical-align: top; }
pre { background: var(--soft); padding: .75rem; overflow-x: auto; font-size: .85rem; white-space: pre-wrap; }
details { margin: .5rem 0; } summary { cursor: pointer; opacity: .7; font-size: .85rem; }
.jp-InputPrompt, .jp-OutputPrompt, .prompt, .anchor-link { display: none; }
math[display=block] { margin: 1rem 0; overflow-x: auto; max-width: 100%; }
.origin { opacity: .75; font-size: .85rem; }
"""

INTRODUCTION = """
<p>A lunar robot with two arms must get both arms under a fallen, suited astronaut, among rocks, and turn them over or
lift them for transport. This page is a reproduction of Ren, Han and Wang (Aerospace 2022, 9, 315) in a physical
simulation with real contact: what the method is, what it reaches here, and what became of each of the paper's claims.
Every number below was computed when this page was made.</p>
"""


def build_report(notebooks: Path, results: Path) -> Path:
    """Write ``report/index.html`` from all executed notebooks of a folder; return its path."""
    paths = sorted(p for p in notebooks.glob("[0-9][0-9]_*.ipynb") if not p.stem.endswith(".failed"))
    parts = [(path.stem, _render(path)) for path in paths]
    links = "".join(f'<a href="#{name}">{name[:2]} {_title(name)}</a>' for name, _ in parts)
    bodies = "".join(f'<section id="{name}">{body}</section>' for name, body in parts)
    page = f"""<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>Lunar rescue: a reproduction</title><style>{STYLE}</style></head>
<body><nav><a href="#top">Summary</a>{links}</nav><main id="top">
<h1 style="border:0">Lunar rescue by two arms: a reproduction</h1>{INTRODUCTION}{_summary(results)}{bodies}
</main></body></html>
"""
    target = results / "report" / "index.html"
    write_text(target, page)
    return target


def _title(name: str) -> str:
    return name[3:].replace("_", " ")


def _summary(results: Path) -> str:
    table = readable_table1(results).to_html(index=False, border=0)
    claims = pd.DataFrame(
        [
            {"id": c.id, "claim": c.statement, "paper": c.paper, "verdict": c.verdict, "evidence": c.evidence}
            for c in compute_claims(results)
        ]
    ).to_html(index=False, border=0)
    origin = provenance()
    words = f"Made by <code>{html.escape(origin['command'])}</code>, commit {origin['commit'][:12]}, {origin['date']}, "
    words += f"environment {origin['environment_version']}, {html.escape(origin['machine']['processor'])}."
    return (
        f"<h2>Results beside the paper's</h2>{table}<h2>The paper's claims</h2>{claims}"
        f"<p>One seed says nothing of the variance between trainings: verdicts that rest on few seeds or tests say "
        f'<em>reduced scale</em>.</p><p class="origin">{words}</p>'
    )


def _render(path: Path) -> str:
    document = nbformat.read(path, as_version=4)
    logging.getLogger("traitlets").setLevel(logging.ERROR)  # it asks for descriptions, which are added below
    for cell in document.cells:
        if cell.cell_type == "markdown":
            cell.source = with_mathml(cell.source)
    exporter = HTMLExporter(exclude_input_prompt=True, exclude_output_prompt=True)
    exporter.raw_template = FOLDED
    body, _ = exporter.from_notebook_node(document)
    return _describe_pictures(str(body))


def _describe_pictures(body: str) -> str:
    """Give each picture the heading above it as its description."""
    heading = ""
    pieces = []
    for piece in re.split(r"(<h[12][^>]*>.*?</h[12]>|<img [^>]*>)", body, flags=re.DOTALL):
        if piece.startswith("<h"):
            heading = html.escape(re.sub(r"<[^>]+>|\u00b6", "", piece).strip(), quote=True)
        elif piece.startswith("<img"):
            piece = re.sub(r' alt="[^"]*"', "", piece).replace("<img ", f'<img alt="{heading}" ', 1)
        pieces.append(piece)
    return "".join(pieces)


def with_mathml(text: str) -> str:
    """Replace $...$ and $$...$$ outside code by MathML, which browsers render by themselves."""
    pieces = _CODE.split(text)
    for index in range(0, len(pieces), 2):
        piece = _DISPLAY.sub(lambda m: _mathml(m, "block"), pieces[index])
        pieces[index] = _INLINE.sub(lambda m: _mathml(m, "inline"), piece)
    return "".join(pieces)


def _mathml(match: re.Match[str], display: Any) -> str:
    made: str = convert(match.group(1).strip(), display=display)
    return made.replace("\n", " ")
