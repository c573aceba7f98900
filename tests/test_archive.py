"""Citation files agree with the project, and a results folder becomes an RO-Crate that its own library reads."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable
from pathlib import Path

import yaml
from command_line import call  # type: ignore[import-not-found]  # pytest puts this folder on the path
from rocrate.rocrate import ROCrate

from reproduce.report.archive import METADATA, codemeta
from reproduce.storage.paths import ROOT

DOI = "https://doi.org/10.3390/aerospace9060315"


def test_codemeta_is_current_and_agrees_with_citation_and_project() -> None:
    """Else run ``python -m reproduce.report.pages``."""
    text = (ROOT / "codemeta.json").read_text(encoding="utf-8")
    assert text == codemeta()
    made, citation = json.loads(text), yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert made["version"] == citation["version"] == project["version"]
    assert made["license"] == "https://spdx.org/licenses/MIT" and project["license"] == {"text": "MIT"}
    assert made["referencePublication"]["@id"] == citation["preferred-citation"]["url"] == DOI
    assert [author["familyName"] for author in made["referencePublication"]["author"]] == ["Ren", "Han", "Wang"]


def test_a_results_folder_becomes_a_crate(tmp_path: Path, run_folder: Callable[..., Path]) -> None:
    folder = run_folder(tmp_path, "hrl_dcs", 0, [True, False, True])
    (tmp_path / "scratch").mkdir()
    (tmp_path / "scratch" / "left.txt").write_text("not kept")
    for _ in range(2):  # a second time it does not describe itself
        done = call("crate", "--folder", str(tmp_path))
        assert done.code == 0 and METADATA in done.out, done.err
    crate = ROCrate(tmp_path)
    names = {path.relative_to(tmp_path).as_posix() for path in folder.rglob("*") if path.is_file()}
    assert {entity.id for entity in crate.get_by_type("File")} == names and len(names) == 5
    summary = crate.dereference(f"{folder.relative_to(tmp_path).as_posix()}/evaluation.json")
    assert summary["description"] == "made by `reproduce` at commit unknown"
    assert summary["contentSize"] == str((folder / "evaluation.json").stat().st_size)
    assert crate.root_dataset["citation"].id == DOI and crate.root_dataset["license"]


def test_an_empty_folder_is_refused(tmp_path: Path) -> None:
    done = call("crate", "--folder", str(tmp_path))
    assert done.code == 2 and "expected a results folder" in done.complaint and not list(tmp_path.iterdir())
