"""Builds the site: first page, notebooks, replays, policies and documentation, by mkdocs-material."""

from __future__ import annotations

import json
import logging
import os
import re
import shutil
import tempfile
from pathlib import Path
from typing import Any

from mkdocs.commands.build import build
from mkdocs.config import load_config

from reproduce.analysis.claims import ENOUGH_SEEDS, compute_claims
from reproduce.analysis.runs import Run, reference_runs
from reproduce.analysis.tables import markdown_table, readable_table1
from reproduce.experiments.methods import METHODS
from reproduce.report.cards import card
from reproduce.report.gallery import Clip, choose_clips, make_clips
from reproduce.report.notebook import Page, fill_in, notebook_page
from reproduce.storage.files import write_text
from reproduce.storage.paths import ROOT
from reproduce.storage.provenance import provenance

TITLE = "Lunar rescue by two arms"
DOCUMENTS = ("environment.md", "training.md", "training_log.md", "assumptions.md", "extending.md", "cluster.md")
REPLAYS = "replays"

STYLE = """
.md-typeset details.code { border: 0; box-shadow: none; background: transparent; font-size: .7rem; margin: .4rem 0; }
.md-typeset details.code > summary { background: transparent; opacity: .6; min-height: 0; padding: 0;
  font-weight: 400; }
.md-typeset details.code > summary::before { display: none; }
.md-typeset details.code > summary::after { right: auto; left: 2.2rem; top: 0; }
.md-typeset .cell img { background: #fff; max-width: 100%; }
.md-typeset .cell pre { white-space: pre-wrap; overflow-wrap: anywhere; font-size: .65rem; }
.md-typeset .cell .highlight pre { padding: .6rem; }
.md-typeset .jp-InputPrompt, .md-typeset .jp-OutputPrompt, .md-typeset .prompt { display: none; }
.md-typeset table:not([class]) { font-size: .62rem; }
.md-typeset .origin { opacity: .75; font-size: .62rem; }
.md-typeset .cell .origin { text-align: right; margin: 0; font-size: .55rem; }
.md-typeset math[display=block] { overflow-x: auto; max-width: 100%; margin: 1em 0; }
"""

CONFIGURATION: dict[str, Any] = {
    "site_name": TITLE,
    "use_directory_urls": False,
    "plugins": [],  # its search would want a server
    "markdown_extensions": [
        "tables",
        "admonition",
        "md_in_html",
        "toc",
        "pymdownx.details",
        "pymdownx.superfences",
        "pymdownx.highlight",
    ],
    "extra_css": ["style.css"],
    "extra": {"generator": False},
    "theme": {
        "name": "material",
        "font": False,
        "language": "en",
        "features": ["navigation.sections", "navigation.top", "navigation.footer", "toc.follow", "content.code.copy"],
        "icon": {"logo": "material/moon-waning-crescent"},
        "palette": [
            {"media": "(prefers-color-scheme)", "toggle": {"icon": "material/brightness-auto", "name": "light"}},
            {
                "media": "(prefers-color-scheme: light)",
                "scheme": "default",
                "primary": "blue grey",
                "toggle": {"icon": "material/weather-sunny", "name": "dark"},
            },
            {
                "media": "(prefers-color-scheme: dark)",
                "scheme": "slate",
                "primary": "blue grey",
                "toggle": {"icon": "material/weather-night", "name": "as the system"},
            },
        ],
    },
}


def build_report(notebooks: Path, results: Path, replays: bool = True) -> Path:
    """Write ``report/`` from all executed notebooks of a folder and from results/; return its first page.

    The site is built beside and put in place at the end, so a failure leaves the old one.

    Args:
        notebooks: Folder of executed notebooks.
        results: Folder of results.
        replays: Whether to make the 3D replays, a minute's work.
    """
    runs = reference_runs(results)
    results = results.resolve()
    results.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".report-", dir=results) as name:
        work = Path(name)
        sources, site = work / "sources", work / "site"
        pages = _notebook_pages(notebooks)
        clips = choose_clips(runs) if replays else []
        endings = make_clips(clips, sources / REPLAYS) if clips else {}
        _write_sources(sources, pages, endings, runs, results)
        _build(work, sources, site, pages, runs, bool(clips))
        for page in site.rglob("*.html"):
            if page.parent.name != REPLAYS:
                _finish(page, pages)
        target = results / "report"
        _replace(site, target)
    return target / "index.html"


def _notebook_pages(folder: Path) -> dict[str, Page]:
    paths = sorted(p for p in folder.glob("[0-9][0-9]_*.ipynb") if not p.stem.endswith(".failed"))
    return {path.stem: notebook_page(path) for path in paths}


def _write_sources(
    sources: Path, pages: dict[str, Page], endings: dict[Clip, str], runs: list[Run], results: Path
) -> None:
    write_text(sources / "index.md", first_page(runs, results, endings))
    write_text(sources / "style.css", STYLE)
    for name, page in pages.items():
        write_text(sources / f"{name}.md", page.text)
    if endings:
        write_text(sources / "replays.md", _gallery_page(endings))
    for run in runs:
        if run.origin:
            text = card(run).split("---\n", 2)[2]  # without the head for model hubs
            write_text(sources / f"policy_{run.method}_{run.seed}.md", text)
    for name in DOCUMENTS:
        if (ROOT / "docs" / name).is_file():
            write_text(sources / "docs" / name, _local_links((ROOT / "docs" / name).read_text(encoding="utf-8")))
    picture = ROOT / "docs" / "rescue.png"
    if picture.is_file():
        for folder in (sources, sources / "docs"):
            shutil.copyfile(picture, folder / picture.name)


def _local_links(text: str) -> str:
    """Links to files that the site does not have become plain words."""
    known = "|".join(re.escape(name) for name in DOCUMENTS)
    return re.sub(rf"(?<!!)\[([^\]]+)\]\((?!https?:|#|(?:{known})(?:#|\)))[^)]*\)", r"\1", text)


def _build(work: Path, sources: Path, site: Path, pages: dict[str, Page], runs: list[Run], replays: bool) -> None:
    tour = [{f"{name[:2]} {name[3:].replace('_', ' ')}": f"{name}.md"} for name in pages]
    policies = [
        {f"{METHODS[r.method].title}, seed {r.seed}": f"policy_{r.method}_{r.seed}.md"} for r in runs if r.origin
    ]
    documents = [f"docs/{name}" for name in DOCUMENTS if (sources / "docs" / name).is_file()]
    parts: list[tuple[str, Any]] = [
        ("Summary", "index.md"),
        ("The tour", tour),
        ("Replays", "replays.md" if replays else None),
        ("Trained policies", policies),
        ("Documentation", documents),
    ]
    nav = [{title: part} for title, part in parts if part]
    configuration = {**CONFIGURATION, "docs_dir": str(sources), "site_dir": str(site), "nav": nav}
    configuration["copyright"] = _origin_line()
    file = work / "mkdocs.yml"
    file.write_text(json.dumps(configuration, indent=1), encoding="utf-8")  # JSON is YAML too
    logging.getLogger("mkdocs").setLevel(logging.ERROR)
    os.environ.setdefault("NO_MKDOCS_2_WARNING", "1")
    build(load_config(str(file)))
    for left in ("sitemap.xml", "sitemap.xml.gz", "404.html"):  # for servers
        (site / left).unlink(missing_ok=True)


def _finish(page: Path, pages: dict[str, Page]) -> None:
    text = page.read_text(encoding="utf-8")
    for part in pages.values():
        text = fill_in(text, part.pieces)
    page.write_text(text, encoding="utf-8")


def _replace(site: Path, target: Path) -> None:
    old = target.with_name(f".{target.name}.old")
    shutil.rmtree(old, ignore_errors=True)
    if target.exists():
        target.rename(old)
    site.rename(target)
    shutil.rmtree(old, ignore_errors=True)


def first_page(runs: list[Run], results: Path, endings: dict[Clip, str]) -> str:
    """What it is, the results beside the paper's, the claims, how far to trust it, how to run it again."""
    table = readable_table1(results)
    claims = compute_claims(results)
    verdicts = [(c.id, c.statement, c.paper, f"**{c.verdict}**", c.evidence) for c in claims]
    clip = next((c for c in endings if "success" in c.file and c.file.startswith("hrl_dcs-")), None)
    watch = f" [Look at one from all sides]({REPLAYS}/{clip.file}), or at [all replays](replays.md)." if clip else ""
    picture = (
        f"![A rescue by the trained policy, read row by row](rescue.png)\n\n"
        "A lift on rough ground by the trained HRL-DCS, read row by row: rings are target areas, diamonds sub-goals, "
        f"crosses the rocks' mark points.{watch}\n"
        if (ROOT / "docs" / "rescue.png").is_file()
        else ""
    )
    return "\n".join(
        [
            f"# {TITLE}: a reproduction\n",
            "A lunar robot with two 5-joint arms must get both arms under a fallen, suited astronaut, among rocks, and "
            "turn them over or lift them for transport. Ren, Han and Wang (Aerospace 2022, 9, 315) taught it by "
            "**HRL-DCS**, two recurrent layers: SGN sets sub-goals for the two arm ends, LLN moves the joints towards "
            "them, rewarded with an artificial potential field (AAPF). They published no code. This is the method, its "
            "rivals and the problem itself, rebuilt in a physical simulation with real contact, and what became of "
            "each of their claims.\n",
            picture,
            "## Results beside the paper's\n",
            markdown_table([str(c) for c in table.columns], table.to_numpy().tolist()),
            _made_by(runs),
            "## The paper's claims\n",
            markdown_table(("", "claim", "paper", "verdict", "evidence"), verdicts),
            '<p class="origin" markdown="1">`results/claims.json`, made by `reproduce claims`; the rules are in '
            "`reproduce/analysis/claims.py`.</p>\n",
            "## How far to trust it\n",
            _trust(runs),
            "## Run it again\n",
            "```\nmake reproduce     # in short form, under 15 minutes on 2 cores\n"
            "reproduce evaluate results/reference/hrl_dcs/seed0 --tests 1000\n"
            "reproduce batch --preset laptop --methods all --seeds 0-4     # everything, also on a cluster\n```\n",
        ]
    )


def _made_by(runs: list[Run]) -> str:
    rows = []
    for run in runs:
        if run.evaluation is not None:
            trained = f"`{run.origin['command']}`" if run.origin else "does not learn"
            tested = f"`{run.evaluation['origin']['command']}`"
            folder = f"`results/reference/{run.method}/seed{run.seed}/`"
            rows.append((METHODS[run.method].title, trained, tested, folder))
    if not rows:
        return ""
    table = markdown_table(("method", "trained by", "tested by", "files"), rows)
    return '??? note "Which command made which number"\n\n    ' + table.replace("\n", "\n    ").rstrip() + "\n"


def _trust(runs: list[Run]) -> str:
    trained = [run for run in runs if run.origin and run.evaluation]
    if not trained:
        return "No trained policy is there yet: nothing above says anything of learning.\n"
    seeds: dict[str, int] = {}
    for run in trained:
        seeds[run.method] = seeds.get(run.method, 0) + 1
    tests = min(int(run.evaluation["tests"]) for run in trained if run.evaluation)
    versions = sorted({str(run.origin["environment_version"]) for run in trained if run.origin})
    most = max(run.env_steps for run in trained)
    lines = [
        f"- **Tests**: at least {tests} scenes a policy, the same for every method, drawn from seeds that no training "
        "saw; intervals are Wilson's, 95 %.",
        f"- **Seeds**: {min(seeds.values())} to {max(seeds.values())} training seeds a method. "
        + (
            "That tells how trainings differ."
            if min(seeds.values()) >= ENOUGH_SEEDS
            else f"Fewer than {ENOUGH_SEEDS} tell little of how trainings differ: verdicts are *reduced scale*."
        ),
        f"- **Steps**: at most {most:,} environment steps a training, against the paper's 700 million.",
        f"- **Physics**: environment version {', '.join(versions)}; contact and friction alone move the astronaut, and "
        "nothing counts that did not happen. It is still a simulation, with a rigid suit and known poses.",
        "- **Held-out scenes**, with postures, masses, rock fields and reliefs that no training scene has, are on the "
        "pages of the trained policies.",
    ]
    return "\n".join([*lines, ""])


def _gallery_page(endings: dict[Clip, str]) -> str:
    lines = [
        "# Replays\n",
        "Each opens a page of its own: drag to turn, scroll to come nearer, and use the bar below to play. Balls that "
        "shine through are the target areas, blue for arm A and orange for arm B; green ones are sub-goals; lines lead "
        "from arm ends to targets and from joints to the nearest rocks, red when near.\n",
    ]
    groups: dict[str, list[tuple[str, str]]] = {}
    for clip, words in endings.items():
        groups.setdefault(clip.group, []).append((f"[{clip.label}]({REPLAYS}/{clip.file})", words))
    for group, rows in groups.items():
        lines += [f"## {group}\n", markdown_table(("replay", "how it ended"), rows)]
    lines.append('<p class="origin" markdown="1">Made by `reproduce report`; one alone by `reproduce replay`.</p>\n')
    return "\n".join(lines)


def _origin_line() -> str:
    origin = provenance()
    return (
        f"Made by {origin['command']}, commit {origin['commit'][:12]}, {origin['date']}, environment "
        f"{origin['environment_version']}"
    )
