"""Files that README and docs name in backticks are there."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest
import yaml
from typer.main import get_command

from reproduce.__main__ import app
from reproduce.storage.paths import ROOT

PAGES = ["README.md", "CONTRIBUTING.md", *sorted(str(p.relative_to(ROOT)) for p in (ROOT / "docs").glob("*.md"))]
ENDINGS = "py|md|toml|json|lock|csv|yml|yaml|urdf|obj|ipynb|html"
#: A path with a folder, or a file's name alone, which may lie anywhere.
NAME = re.compile(rf"`(?:[\w.-]+/)+[\w.-]*`|`\w+\.(?:{ENDINGS})`")
#: What commands make, here or in a folder of a batch or a run, and what stands for a name: METHOD, seedK. Results of an
#: environment version are not there before its trainings are.
MADE = re.compile(
    r"(results/)?(notebooks|report|batch|scratch|logs|tables|timings|superseded|reference|solvability|agreement|stress|transfer|variants|perception)(/|$)"
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


ARCHITECTURE = ROOT / "docs" / "architecture.md"


def is_a_name(dotted: str) -> bool:
    """Return whether a dotted name leads to a module, or to what is in one."""
    module, rest = dotted, list[str]()
    while module:
        try:
            found = importlib.import_module(module)
            break
        except ModuleNotFoundError:
            module, _, last = module.rpartition(".")
            rest.insert(0, last)
    else:
        return False
    for part in rest:
        if not hasattr(found, part):
            return False
        found = getattr(found, part)
    return True


def unknown_names(text: str) -> list[str]:
    """Return dotted names and commands of a text in backticks that do not exist."""
    commands = set(get_command(app).commands)  # type: ignore[attr-defined]
    words = re.findall(r"`([^`]+)`", text)
    dotted = [word for word in words if re.fullmatch(r"(lunar_rescue|reproduce)(\.\w+)+", word)]
    called = [word for word in words if word.startswith("reproduce ")]
    return [w for w in dotted if not is_a_name(w)] + [w for w in called if w.split()[1] not in commands]


def test_names_of_the_architecture_exist() -> None:
    text = ARCHITECTURE.read_text(encoding="utf-8")
    assert len(re.findall(r"`(?:lunar_rescue|reproduce)\.", text)) > 20
    assert unknown_names(text) == []
    assert unknown_names("`lunar_rescue.env.Nothing`, `reproduce.nowhere.x`, `reproduce nothing`") == [
        "lunar_rescue.env.Nothing", "reproduce.nowhere.x", "reproduce nothing"
    ]  # fmt: skip


def test_the_architecture_is_a_page_and_names_every_folder() -> None:
    text = ARCHITECTURE.read_text(encoding="utf-8")
    assert len(text.split()) < 700
    for package in ("envs/lunar_rescue", "reproduce"):
        folders = [path.parent for path in (ROOT / package).glob("*/__init__.py") if path.parent.name != "data"]
        assert not [folder for folder in folders if f"`{folder.relative_to(ROOT)}`" not in text]


def test_issue_templates_can_be_read() -> None:
    files = sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml"))
    assert [path.stem for path in files] == ["bug", "reading", "result"]
    for path in files:
        form = yaml.safe_load(path.read_text(encoding="utf-8"))
        assert {"name", "description", "body"} <= set(form), path.name
        assert all(part["id"] and part["attributes"]["label"] for part in form["body"]), path.name


def test_the_workflow_keeps_environment_and_report() -> None:
    jobs = yaml.safe_load((ROOT / ".github" / "workflows" / "test.yml").read_text(encoding="utf-8"))["jobs"]
    for job in jobs.values():
        assert any("actions/cache" in step.get("uses", "") for step in job["steps"])
    last = jobs["notebooks"]["steps"][-2:]
    assert last[0]["run"] == "make ci-short" and "results/report" in last[1]["with"]["path"]
