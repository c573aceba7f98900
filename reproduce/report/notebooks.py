"""Runs the notebooks with papermill, in order.

papermill only warns of a parameter that a notebook does not know, and takes any type; here names and types are checked
for all notebooks before the first one runs.
"""

from __future__ import annotations

import ast
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import nbformat
import papermill
from papermill.exceptions import PapermillExecutionError

from reproduce.learning.config import PRESETS
from reproduce.storage.errors import RunFailedError, UserError
from reproduce.storage.paths import RESULTS, ROOT

SOURCES = ROOT / "notebooks"
OUTPUTS = "notebooks"
TAG = "parameters"


@dataclass(frozen=True)
class Notebook:
    """One notebook and its parameters.

    Attributes:
        path: The source.
        defaults: Value of each parameter in the parameters cell.
    """

    path: Path
    defaults: dict[str, Any]

    @property
    def name(self) -> str:
        """File name without its ending."""
        return self.path.stem


def find_notebooks(only: str | None = None, sources: Path = SOURCES) -> list[Notebook]:
    """The notebooks in order, or the one whose number or name is ``only``."""
    paths = sorted(sources.glob("[0-9][0-9]_*.ipynb"))
    if only is not None:
        chosen = [path for path in paths if only in (path.stem, path.stem[:2])]
        if not chosen:
            known = ", ".join(path.stem for path in paths)
            raise UserError(f"--only: expected a number or name of {known}; got {only!r}")
        paths = chosen
    return [Notebook(path, _parameters(path)) for path in paths]


def _parameters(path: Path) -> dict[str, Any]:
    """Names and values assigned in the cell tagged ``parameters``."""
    document = nbformat.read(path, as_version=4)
    cells = [cell for cell in document.cells if TAG in cell.metadata.get("tags", [])]
    if len(cells) != 1:
        raise UserError(f"{path}: expected one cell tagged {TAG!r}, found {len(cells)}")
    values = {}
    for statement in ast.parse(cells[0].source).body:
        match statement:
            case ast.Assign(targets=[ast.Name(id=name)], value=value):
                values[name] = ast.literal_eval(value)
            case _:
                raise UserError(f"{path}: the {TAG} cell must hold NAME = VALUE only, line {statement.lineno} does not")
    return values


def parse_assignments(assignments: list[str]) -> dict[str, Any]:
    """Values of NAME=VALUE, where VALUE is a Python literal, or text as it stands."""
    values: dict[str, Any] = {}
    for assignment in assignments:
        name, separator, text = assignment.partition("=")
        if not separator or not name.isidentifier():
            raise UserError(f"--parameter: expected NAME=VALUE, got {assignment!r}")
        try:
            values[name] = ast.literal_eval(text)
        except (ValueError, SyntaxError):
            values[name] = text
    return values


def check_parameters(notebooks: list[Notebook], preset: str, given: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Parameters for each notebook by name.

    Raises:
        UserError: On an unknown preset, a name that no chosen notebook has, or a value of another type.
    """
    if preset not in PRESETS:
        raise UserError(f"--preset: expected one of {', '.join(PRESETS)}; got {preset!r}")
    known = sorted({name for notebook in notebooks for name in notebook.defaults})
    for name in given:
        if name not in known:
            raise UserError(f"--parameter: no notebook has {name!r}; expected one of {', '.join(known)}")
    chosen: dict[str, dict[str, Any]] = {}
    for notebook in notebooks:
        values = {name: value for name, value in given.items() if name in notebook.defaults}
        for name, value in values.items():
            _check_type(notebook, name, value)
        own = {"preset": preset} if "preset" in notebook.defaults else {}
        chosen[notebook.name] = {**own, **values}
    return chosen


def _check_type(notebook: Notebook, name: str, value: Any) -> None:
    wanted = type(notebook.defaults[name])
    number = wanted is float and isinstance(value, int) and not isinstance(value, bool)
    if type(value) is not wanted and not number:
        got = f"{value!r} ({type(value).__name__})"
        raise UserError(f"--parameter: {name} of {notebook.name}: expected {wanted.__name__}, got {got}")


@contextmanager
def _own_kernel() -> Iterator[None]:
    """Let Jupyter find this interpreter's own kernel first, whatever is registered on the machine."""
    before = dict(os.environ)
    os.environ.pop("JUPYTER_PATH", None)
    os.environ["JUPYTER_PREFER_ENV_PATH"] = "1"
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


def run_notebooks(
    preset: str,
    only: str | None = None,
    assignments: list[str] | None = None,
    results: Path = RESULTS,
    sources: Path = SOURCES,
) -> Path:
    """Run notebooks; return the folder of what came out.

    Raises:
        UserError: Before anything runs, on a bad name or value.
        RunFailedError: When a notebook fails; its output is kept as ``NAME.failed.ipynb``.
    """
    notebooks = find_notebooks(only, sources)
    parameters = check_parameters(notebooks, preset, parse_assignments(assignments or []))
    folder = results / OUTPUTS
    folder.mkdir(parents=True, exist_ok=True)
    with _own_kernel():
        for notebook in notebooks:
            _run(notebook, parameters[notebook.name], folder, sources.parent)
    return folder


def _run(notebook: Notebook, parameters: dict[str, Any], folder: Path, root: Path) -> None:
    failed, finished = folder / f"{notebook.name}.failed.ipynb", folder / f"{notebook.name}.ipynb"
    try:
        papermill.execute_notebook(
            notebook.path,
            failed,
            parameters=parameters,
            kernel_name="python3",
            language="python",
            cwd=root,
            progress_bar=True,
            autosave_cell_every=0,
            extra_arguments=["--log-level=CRITICAL"],  # a kernel that is interrupted has nothing to say
        )
    except PapermillExecutionError as error:
        where = f"{notebook.name}, cell {error.exec_count}: {error.ename}: {error.evalue}"
        raise RunFailedError(f"notebook failed: {where} (output kept in {failed})") from None
    if not is_complete(failed):
        raise RunFailedError(f"notebook {notebook.name} did not run to its end (output kept in {failed})")
    os.replace(failed, finished)


def is_complete(path: Path) -> bool:
    """Whether an output notebook ran to its end: no exception, an end time, and every code cell was executed."""
    document = nbformat.read(path, as_version=4)
    meta = document.metadata.get("papermill", {})
    code = [cell for cell in document.cells if cell.cell_type == "code" and cell.source.strip()]
    # A cell that raises SystemExit can end a notebook with exit code 0 and the rest not run.
    executed = all(cell.metadata.get("papermill", {}).get("status") == "completed" for cell in code)
    return not meta.get("exception") and bool(meta.get("end_time")) and executed
