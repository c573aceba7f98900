"""Imports run downwards only, no circle, and files, functions and docstrings keep their size."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import grimp
import networkx as nx

from reproduce.storage.paths import ROOT

#: Folders and modules of each package from the top; those of one line may import each other, but in no circle.
ORDER = {
    "reproduce": (
        ("__main__",),
        ("studies",),
        ("console",),
        ("report",),
        ("bench",),
        ("analysis",),
        ("experiments",),
        ("perception",),
        ("baselines",),
        ("hrl_dcs",),
        ("learning",),
        ("storage",),
    ),
    "lunar_rescue": (
        ("disturbed", "seeing", "step_limit"),
        ("env",),
        ("pictures",),
        ("contacts", "disturbances", "episode", "observation", "rewards", "tasks"),
        ("physics",),
        ("scenes",),
        ("arrays", "data"),
    ),
}
LONGEST_FILE, LONGEST_FUNCTION = 300, 40  # lines
SHORT_DOCSTRING, SHORT_DOCSTRINGS = 5, 30  # words; fewer of them than
MOST_LINES = 22_800  # without examples

Definition = ast.FunctionDef | ast.AsyncFunctionDef


@cache
def imports() -> nx.DiGraph:
    """Return which module imports which, inside functions too, without what only types need."""
    graph = grimp.build_graph("reproduce", "lunar_rescue", exclude_type_checking_imports=True, cache_dir=None)
    return nx.DiGraph((m, other) for m in graph.modules for other in graph.find_modules_directly_imported_by(m))


def part(module: str) -> str:
    """Return the folder or top module of a module: ``reproduce.storage`` of ``reproduce.storage.files``."""
    return ".".join(module.split(".")[:2])


def circles(graph: nx.DiGraph) -> list[list[str]]:
    """Return what is in a circle, each circle sorted."""
    return [sorted(circle) for circle in nx.strongly_connected_components(graph) if len(circle) > 1]


def test_no_import_runs_upwards() -> None:
    rank = {f"{p}.{name}": i for p, levels in ORDER.items() for i, names in enumerate(levels) for name in names}
    upwards = []
    for module, other in imports().edges:
        if "." not in module or "." not in other:  # a package's own __init__ only gathers names
            wrong = module == "lunar_rescue" and other.startswith("reproduce")
        elif module.split(".")[0] != other.split(".")[0]:
            wrong = module.startswith("lunar_rescue")
        else:
            wrong = rank.get(part(module), 99) > rank.get(part(other), 99)
        if wrong:
            upwards.append(f"{module} imports {other}")
    assert not upwards, "\n".join(upwards)


def test_every_folder_has_its_place_in_the_order() -> None:
    known = {f"{package}.{name}" for package, levels in ORDER.items() for names in levels for name in names}
    folders = {part(module) for module in imports() if "." in module}
    assert not {f for f in folders if f.startswith("reproduce.")} - known
    modules = {f"lunar_rescue.{path.stem}" for path in (ROOT / "envs" / "lunar_rescue").iterdir() if path.suffix}
    assert not {f for f in folders & modules if not f.endswith("__init__")} - known


def test_no_circle_between_modules() -> None:
    assert not circles(imports())


def test_no_circle_between_folders() -> None:
    folders = nx.DiGraph((part(m), part(o)) for m, o in imports().edges if "." in m and "." in o)
    folders.remove_edges_from(list(nx.selfloop_edges(folders)))
    assert not circles(folders)


@cache
def sources() -> dict[Path, list[str]]:
    """Return the lines of each module of the two packages."""
    paths = [path for folder in ("envs", "reproduce") for path in sorted((ROOT / folder).rglob("*.py"))]
    return {path.relative_to(ROOT): path.read_text(encoding="utf-8").splitlines() for path in paths}


def nodes() -> Iterator[tuple[Path, ast.AST]]:
    """Yield each node of each module."""
    for path, lines in sources().items():
        for node in ast.walk(ast.parse("\n".join(lines))):
            yield path, node


def test_files_are_short() -> None:
    assert not {str(path): len(lines) for path, lines in sources().items() if len(lines) > LONGEST_FILE}


def test_functions_are_short() -> None:
    long = {}
    for path, node in nodes():
        if isinstance(node, Definition):
            first = min([node.lineno, *(decorator.lineno for decorator in node.decorator_list)])
            if node.end_lineno is not None and node.end_lineno - first + 1 > LONGEST_FUNCTION:
                long[f"{path}:{node.lineno} {node.name}"] = node.end_lineno - first + 1
    assert not long


def test_docstrings_are_sentences() -> None:
    short, begins_with_of = [], []
    for path, node in nodes():
        if isinstance(node, Definition | ast.ClassDef | ast.Module) and (text := ast.get_docstring(node)):
            place = f"{path}:{getattr(node, 'lineno', 1)}: {text.splitlines()[0]}"
            short += [place] if len(text.split()) <= SHORT_DOCSTRING else []
            begins_with_of += [place] if text.split()[0] == "Of" else []
    assert len(short) < SHORT_DOCSTRINGS, "\n".join(short)
    assert not begins_with_of, "\n".join(begins_with_of)


def test_the_house_stays_small() -> None:
    assert sum(map(len, sources().values())) <= MOST_LINES
