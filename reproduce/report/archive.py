"""What archives and citation tools read: ``codemeta.json``, and results/ as an RO-Crate (``reproduce crate``).

Names, versions and licences come from ``pyproject.toml`` and ``CITATION.cff``; nothing is typed twice.
"""

import json
import mimetypes
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from reproduce.storage.errors import UserError
from reproduce.storage.files import read_json, write_text
from reproduce.storage.paths import ROOT

METADATA = "ro-crate-metadata.json"
#: Folders of results/ that hold nothing to keep, as they are made again by one command.
LEFT_OUT = ("scratch", "notebooks", "report", "batch")


def codemeta() -> str:
    """Return the text of ``codemeta.json`` (CodeMeta 3.0)."""
    project, citation = _project(), _citation()
    urls = project.get("urls", {})
    made: dict[str, Any] = {
        "@context": "https://w3id.org/codemeta/3.0",
        "@type": "SoftwareSourceCode",
        "name": project["name"],
        "description": project["description"],
        "version": project["version"],
        "license": f"https://spdx.org/licenses/{citation['license']}",
        "author": [{"@type": "Organization", "name": author["name"]} for author in project["authors"]],
        "keywords": citation["keywords"],
        "programmingLanguage": "Python",
        "runtimePlatform": f"Python {project['requires-python']}",
        "operatingSystem": "Linux",
        "softwareRequirements": project["dependencies"],
        "referencePublication": _paper(citation),
        **({"codeRepository": urls["Repository"]} if "Repository" in urls else {}),
    }
    return json.dumps(made, indent=2) + "\n"


def write_crate(results: Path) -> Path:
    """Describe a results folder as an RO-Crate, in place: write ``ro-crate-metadata.json`` and return its path.

    Every file has its size, its type and, where it carries its origin or ``origins.json`` has it, the command, commit
    and date that made it. A folder without files is a ``UserError``.
    """
    from rocrate.rocrate import ROCrate

    files = sorted(_files(results))
    if not files:
        raise UserError(f"{results}: expected a results folder with files in it")
    project, citation = _project(), _citation()
    crate = ROCrate()
    crate.name, crate.description = f"Results of {project['name']} {project['version']}", project["description"]
    crate.license = f"https://spdx.org/licenses/{citation['license']}"
    makers = [{"@type": "Organization", "name": author["name"]} for author in project["authors"]]
    crate.creator = [crate.add_jsonld({"@id": f"#author-{i}", **maker}) for i, maker in enumerate(makers)]
    paper = _paper(citation)
    for name in ("author", "isPartOf"):  # a crate is flat: what is inside becomes an entity beside it
        nested = paper[name] if isinstance(paper[name], list) else [paper[name]]
        paper[name] = [crate.add_jsonld({"@id": f"#{name}-of-paper-{i}", **entity}) for i, entity in enumerate(nested)]
        paper[name] = [{"@id": entity.id} for entity in paper[name]]
    crate.root_dataset["citation"] = crate.add_jsonld(paper)
    for path in files:
        kind, _ = mimetypes.guess_type(path.name)
        properties = {"contentSize": str(path.stat().st_size), "encodingFormat": kind or "application/octet-stream"}
        crate.add_file(path, path.relative_to(results).as_posix(), properties=properties | _origin(path))
    target = results / METADATA
    write_text(target, json.dumps(crate.metadata.generate(), indent=1) + "\n")
    return target


def _files(results: Path) -> Iterator[Path]:
    for path in results.rglob("*"):
        parts = path.relative_to(results).parts
        if path.is_file() and parts[0] not in LEFT_OUT and not any(p.startswith(".") for p in parts):
            if path.name != METADATA:
                yield path


def _origin(path: Path) -> dict[str, str]:
    """Return what is known of how a file was made, in schema.org's words."""
    origin: Any = None
    register = path.parent / "origins.json"
    if register.is_file() and path != register:
        origin = read_json(register, "register of origins").get(path.name)
    if origin is None and path.suffix == ".json":
        held = read_json(path, "results")
        origin = held.get("origin", held) if isinstance(held, dict) else None
    if not isinstance(origin, dict) or "command" not in origin:
        return {}
    dated = {"dateCreated": origin["date"]} if "date" in origin else {}
    return {"description": f"made by `{origin['command']}` at commit {origin.get('commit', 'unknown')}", **dated}


def _paper(citation: dict[str, Any]) -> dict[str, Any]:
    """Return the paper that is reproduced, as JSON-LD."""
    paper = citation["preferred-citation"]
    people = [(person["given-names"], person["family-names"]) for person in paper["authors"]]
    return {
        "@id": f"https://doi.org/{paper['doi']}",
        "@type": "ScholarlyArticle",
        "name": paper["title"],
        "author": [{"@type": "Person", "givenName": given, "familyName": family} for given, family in people],
        "datePublished": str(paper["year"]),
        "isPartOf": {"@type": "Periodical", "name": paper["journal"]},
    }


def _project() -> dict[str, Any]:
    text = _checkout("pyproject.toml").read_text(encoding="utf-8")
    project: dict[str, Any] = tomllib.loads(text)["project"]
    return project


def _citation() -> dict[str, Any]:
    citation: dict[str, Any] = yaml.safe_load(_checkout("CITATION.cff").read_text(encoding="utf-8"))
    return citation


def _checkout(name: str) -> Path:
    if not (ROOT / name).is_file():
        raise UserError(f"{ROOT / name}: is missing; this needs a checkout of the project")
    return ROOT / name
