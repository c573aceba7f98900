"""Files that README and docs name in backticks are there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from reproduce.storage.paths import ROOT

PAGES = ["README.md", "CONTRIBUTING.md", *sorted(str(p.relative_to(ROOT)) for p in (ROOT / "docs").glob("*.md"))]
ENDINGS = "py|md|toml|json|lock|csv|yml|yaml|urdf|obj|ipynb|html"
#: A path with a folder, or a file's name alone, which may lie anywhere.
NAME = re.compile(rf"`(?:[\w.-]+/)+[\w.-]*`|`\w+\.(?:{ENDINGS})`")
#: What commands make, here or in a folder of a batch or a run, and what stands for a name: METHOD, seedK. Results of an
#: environment version are not there before its trainings are.
MADE = re.compile(
    r"(results/)?(notebooks|report|batch|scratch|logs|tables|timings|superseded|reference|solvability|agreement|stress)(/|$)"
    r"|(results/)?(bench(_\w+)?|claims|table1|timings|config|policy|run|evaluation)\.(json|csv)$|.*(METHOD|PRESET|NAME|DIR)\b"
)


def is_there(name: str) -> bool:
    """Return whether a file or folder of this path, or with these last parts, is in the checkout."""
    folders = [ROOT / folder for folder in ("envs", "reproduce", "results", "tests", "docs", "notebooks")]
    return (ROOT / name).exists() or any(next(folder.rglob(name.rstrip("/")), None) for folder in folders)


def missing(text: str) -> list[str]:
    """Return what a text names and is not there."""
    names = {found.strip("`") for found in NAME.findall(text)}
    return sorted(name for name in names if not MADE.match(name) and not is_there(name))


@pytest.mark.parametrize("page", PAGES)
def test_files_named_in_backticks_exist(page: str) -> None:
    assert not missing((ROOT / Path(page)).read_text(encoding="utf-8"))


def test_a_moved_file_would_be_seen() -> None:
    text = "`reproduce/hrl/goals.py`, `scenes/scene.py`, `nowhere.py`, `gymnasium.make`, `results/report/x.html`"
    assert missing(text) == ["nowhere.py", "reproduce/hrl/goals.py"]
