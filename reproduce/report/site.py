"""Build the site with Material for MkDocs: first page, notebooks, replays, policies and documentation."""

import html
import logging
import os
import re
import shutil
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
from mkdocs.commands.build import build
from mkdocs.config import load_config

from reproduce.analysis.claims import compute_claims
from reproduce.analysis.comparison import choose_scene
from reproduce.analysis.comparison_figures import against_paper
from reproduce.analysis.runs import Run, reference_runs
from reproduce.analysis.sentences import answer, figures_of, tell_success
from reproduce.analysis.two_layers import best_two_layers
from reproduce.analysis.verdicts import LEAST_TRAININGS
from reproduce.experiments.methods import METHODS
from reproduce.report.cards import card
from reproduce.report.film import replay
from reproduce.report.notebook import Page, fill_in, mark_mathematics, notebook_page
from reproduce.report.rendering import render
from reproduce.report.viewer import Clip, choose_clips, make_clips
from reproduce.storage.files import write_text
from reproduce.storage.paths import ROOT, notebook_files
from reproduce.storage.provenance import provenance

CONFIGURATION = Path(__file__).with_name("mkdocs.yml")
SERVED = tuple(Path(__file__).with_name(name) for name in ("style.css", "iframe-worker.js"))  # as they stand
DOCUMENTS = (
    *("environment", "library", "learners", "api", "training", "training_log", "assumptions", "statistics"),
    *("architecture", "extending", "cluster", "simulators", "reality_gap", "perception", "report"),
)
PICTURES = tuple(ROOT / "docs" / name for name in ("rescue.png", "rescue.gif"))  # that pages name
CHART, MOVING = "results.png", "rescue.gif"
SMALL = (320, 240)  # px, of the moving picture
REPLAYS = "replays"
KNOWS_ALL = "The planner, which sees the whole simulation as no robot could"  # who acts in docs/rescue.gif
#: Classes of the style for what verdicts are called; any other word is left open.
COLOURS = {
    "agrees": "agrees",
    "differs": "differs",
}
FOR_SERVERS = ("sitemap.xml", "sitemap.xml.gz", "404.html")


def build_report(notebooks: Path, results: Path, replays: bool = True) -> Path:
    """Write ``report/`` from all executed notebooks of a folder and from results/; return its first page.

    The site is built beside and put in place at the end, so a failure leaves the old one. ``replays`` makes the 3D
    replays, a minute's work.
    """
    runs = reference_runs(results)
    results = results.resolve()
    results.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".report-", dir=results) as name:
        sources, site = Path(name) / "sources", Path(name) / "site"
        outputs = (path for path in notebook_files(notebooks) if not path.stem.endswith(".failed"))
        pages = {path.stem: notebook_page(path) for path in outputs}
        clips = choose_clips(runs) if replays else []
        endings = make_clips(clips, sources / REPLAYS) if clips else {}
        if replays and (best := best_two_layers(runs)) is not None and best.rows() is not None:
            replay(*choose_scene(success=True, first_seed=0, results=results), sources / MOVING, size=SMALL)
        formulas: dict[str, str] = {}  # of the documents, by mark
        texts = _texts(pages, endings, runs, results, formulas)
        for file, text in texts.items():
            write_text(sources / file, text)
        for path in SERVED:
            shutil.copyfile(path, sources / path.name)
        for picture in filter(Path.is_file, PICTURES):
            for folder in (sources, sources / "docs"):
                shutil.copyfile(picture, folder / picture.name)
        figure = against_paper(results)
        figure.savefig(sources / CHART, dpi=110)
        plt.close(figure)
        _build(sources, site, _navigation(texts, runs, {f"{name}.md": page.title for name, page in pages.items()}))
        for page in set(site.rglob("*.html")) - set((site / REPLAYS).glob("*")):
            text = page.read_text(encoding="utf-8")
            for pieces in (formulas, *(notebook.pieces for notebook in pages.values())):
                text = fill_in(text, pieces)
            page.write_text(text, encoding="utf-8")
        report = results / "report"
        if report.exists():
            report.rename(Path(name) / "old")  # and goes with this folder
        site.rename(report)
    return report / "index.html"


def _texts(
    pages: dict[str, Page], endings: dict[Clip, str], runs: list[Run], results: Path, formulas: dict[str, str]
) -> dict[str, str]:
    """Return the Markdown of each page of the site by its file, in the site's order; add the documents' formulas."""
    texts = {"index.md": first_page(runs, results, endings, "06_claims.md" if "06_claims" in pages else None)}
    texts |= {f"{name}.md": _document_links(page.text) for name, page in pages.items()}
    if endings:
        texts["replays.md"] = render("replays.md", endings=endings, replays=REPLAYS)
    for run in runs:
        if run.origin:  # the card without its head for model hubs
            texts[_policy_file(run)] = card(run).split("---\n", 2)[2]
    for path in (ROOT / "docs" / f"{name}.md" for name in DOCUMENTS):
        if path.is_file():
            text = mark_mathematics(path.read_text(encoding="utf-8"), formulas, "docs")
            texts[f"docs/{path.name}"] = _local_links(text)
    return texts


def _document_links(text: str) -> str:
    """Turn the names of documents in backticks into links, where the site has them."""
    return re.sub(rf"`docs/({'|'.join(DOCUMENTS)})\.md`", r"[\1](docs/\1.md)", text)


def _policy_file(run: Run) -> str:
    return f"policy_{run.method}_{run.seed}.md"


def _local_links(text: str) -> str:
    """Turn links to files that the site does not have into plain words."""
    pages = "|".join(map(re.escape, (f"{name}.md" for name in DOCUMENTS)))
    return re.sub(rf"(?<!!)\[([^\]]+)\]\((?!https?:|#|(?:{pages})(?:#|\)))[^)]*\)", r"\1", text)


def _navigation(texts: dict[str, str], runs: list[Run], titles: dict[str, str]) -> list[dict[str, Any]]:
    """Return the site's parts and their pages, as MkDocs wants its ``nav``."""
    notebooks = [name for name in texts if name[:2].isdecimal()]
    policies = {_policy_file(run): f"{METHODS[run.method].title}, seed {run.seed}" for run in runs}
    parts: dict[str, Any] = {
        "Summary": "index.md",
        "The tour": [{titles[name].partition(":")[0]: name} for name in notebooks],
        "Replays": "replays.md" if "replays.md" in texts else None,
        "Trained policies": [{title: name} for name, title in policies.items() if name in texts],
        "Documentation": [name for name in texts if name.startswith("docs/")],
    }
    return [{title: part} for title, part in parts.items() if part]


def _build(sources: Path, site: Path, navigation: list[dict[str, Any]]) -> None:
    now = provenance()
    origin = f"commit {now['commit'][:12]}, {now['date']}, environment {now['environment_version']}"
    logging.getLogger("mkdocs").setLevel(logging.ERROR)
    os.environ.setdefault("NO_MKDOCS_2_WARNING", "1")
    folders = {"docs_dir": str(sources), "site_dir": str(site)}
    build(load_config(str(CONFIGURATION), nav=navigation, copyright=f"Made by {now['command']}, {origin}", **folders))
    for name in FOR_SERVERS:
        (site / name).unlink(missing_ok=True)


def first_page(runs: list[Run], results: Path, endings: dict[Clip, str], rules: str | None = None) -> str:
    """Return whether the paper holds, each claim in a line, a rescue, how to run it and how far to trust it.

    ``rules`` is the page that has the rules of the verdicts, if the site has one.
    """
    trained, claims = [run for run in runs if run.origin and run.evaluation], compute_claims(results)
    best = best_two_layers(runs) if endings else None
    shown = f"{METHODS[best.method].title}, as trained here" if best and best.evaluation else KNOWS_ALL
    return render(
        "index.md",
        **{"runs": runs, "trained": trained, "methods": METHODS, "least_trainings": LEAST_TRAININGS},
        seeds=list(Counter(run.method for run in trained).values()),
        **{"claims": claims, "answer": answer(claims, results), "figures_of": figures_of, "colours": COLOURS},
        **{"rules": rules, "chart": CHART, "chart_alt": html.escape(" ".join(tell_success(results).split()))},
        **{"picture": MOVING if PICTURES[1].is_file() or best else None, "shown": shown, "replays": REPLAYS},
        clip=next((c for c in endings if best and c.file == f"{best.method}-{best.seed}-success.html"), None),
    )
