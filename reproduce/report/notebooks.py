"""Run the notebooks with papermill, in order, with nothing of the user's own surroundings in their kernels."""

import ast
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import nbformat
import papermill
from nbclient.exceptions import DeadKernelError
from papermill.exceptions import PapermillExecutionError

from reproduce.report.parameters import check_value
from reproduce.storage.errors import RunFailedError, UserError
from reproduce.storage.paths import NOTEBOOKS, RESULTS, choose_notebooks


@dataclass(frozen=True)
class Notebook:
    """A notebook and the values in its parameters cell."""

    path: Path
    defaults: dict[str, Any]


def find_notebooks(only: str | None = None, sources: Path = NOTEBOOKS) -> list[Notebook]:
    """Return the notebooks in order, or the one whose number or name is ``only``."""
    return [Notebook(path, _defaults(path)) for path in choose_notebooks(only, sources)]


def _defaults(path: Path) -> dict[str, Any]:
    """Read names and values from the cell tagged ``parameters``."""
    try:
        parameters = papermill.inspect_notebook(str(path))
    except ValueError as error:  # no JSON, no notebook, or one of no language
        raise UserError(f"{path}: not a notebook of Python: {error}") from None
    if not parameters:
        raise UserError(f"{path}: expected a cell tagged 'parameters' with NAME = VALUE in it")
    return {name: ast.literal_eval(parameter["default"]) for name, parameter in parameters.items()}


def parse_assignments(assignments: list[str]) -> dict[str, Any]:
    """Read NAME=VALUE pairs, where VALUE is a Python literal, or text as it stands."""
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
    """Return the parameters of each notebook by its name; refuse names that none of them has, and wrong values."""
    check_value("preset", preset, preset)
    defaults = {name: default for notebook in notebooks for name, default in notebook.defaults.items()}
    for name, value in given.items():
        if name not in defaults:
            raise UserError(f"--parameter: no notebook has {name!r}; expected one of {', '.join(sorted(defaults))}")
        check_value(name, value, defaults[name])
    everything = {"preset": preset, **given}
    return {n.path.stem: {name: everything[name] for name in n.defaults if name in everything} for n in notebooks}


def run_notebooks(
    preset: str,
    only: str | None = None,
    assignments: list[str] | None = None,
    results: Path = RESULTS,
    sources: Path = NOTEBOOKS,
) -> Path:
    """Run notebooks; return the folder of what came out.

    A bad name or value is refused before anything runs. The output of a notebook that fails is kept as
    ``NAME.failed.ipynb``.
    """
    notebooks = find_notebooks(only, sources)
    parameters = check_parameters(notebooks, preset, parse_assignments(assignments or []))
    folder = results.resolve() / "notebooks"
    folder.mkdir(parents=True, exist_ok=True)
    with _own_surroundings(results.resolve()):
        for notebook in notebooks:
            _run(notebook.path, parameters[notebook.path.stem], folder, sources.parent)
    return folder


@contextmanager
def _own_surroundings(results: Path) -> Iterator[None]:
    """Give kernels this interpreter, our plotting, our results, and configuration folders that hold nothing.

    What a person has configured (a plotting backend, start-up files, kernels of other environments) would change or
    empty the pictures, and a home that cannot be written to would stop the kernel.
    """
    before = dict(os.environ)
    with tempfile.TemporaryDirectory(prefix="kernel-", dir="/tmp") as name:  # short: sockets lie below it
        folder = Path(name)
        (folder / "matplotlibrc").touch()
        os.environ.pop("JUPYTER_PATH", None)
        os.environ.update(
            JUPYTER_PREFER_ENV_PATH="1",
            MPLBACKEND="module://matplotlib_inline.backend_inline",
            MATPLOTLIBRC=str(folder / "matplotlibrc"),
            REPRODUCE_RESULTS=str(results),
            **{key: str(folder / key.lower()) for key in ("IPYTHONDIR", "JUPYTER_CONFIG_DIR", "JUPYTER_RUNTIME_DIR")},
        )
        if not os.access(os.environ.get("HOME", ""), os.W_OK):
            os.environ.update(HOME=str(folder), MPLCONFIGDIR=str(folder))
        try:
            yield
        finally:
            os.environ.clear()
            os.environ.update(before)


def _run(notebook: Path, parameters: dict[str, Any], folder: Path, root: Path) -> None:
    failed = failed_output(folder, notebook.stem)
    try:
        papermill.execute_notebook(
            notebook,
            failed,
            parameters=parameters,
            kernel_name="python3",
            language="python",
            cwd=root,
            progress_bar=True,
            autosave_cell_every=0,
            shutdown_kernel="immediate",  # one that is asked to end is interrupted first, and says so on the terminal
            extra_arguments=["--log-level=CRITICAL"],  # a kernel that is interrupted has nothing to say
        )
    except (PapermillExecutionError, DeadKernelError) as error:
        what = f"{error.ename}: {error.evalue}" if isinstance(error, PapermillExecutionError) else "the kernel died"
        where = f"{notebook.stem}, cell {stopped_at(failed)}: {what}"
        raise RunFailedError(f"notebook failed: {where} (output kept in {failed})") from None
    if not is_complete(failed):
        where = f"{notebook.stem}, cell {stopped_at(failed)}"
        raise RunFailedError(f"notebook stopped before its end: {where} (output kept in {failed})")
    failed.replace(folder / notebook.name)


def failed_output(folder: Path, name: str) -> Path:
    """Return the place of what is left of a notebook that failed."""
    return folder / f"{name}.failed.ipynb"


def stopped_at(path: Path) -> int:
    """Return the number of the last code cell that began, counted as a reader of the source counts."""
    _, cells = _read(path)
    return max((number for number, cell in enumerate(cells, 1) if cell.get("start_time")), default=1)


def is_complete(path: Path) -> bool:
    """Tell whether an output notebook ran to its end: no exception, an end time, and every code cell completed."""
    meta, cells = _read(path)
    # A cell that raises SystemExit ends a notebook with exit code 0 and the rest not run; and papermill calls cells
    # completed that a dead kernel never began.
    complete = all(cell.get("status") == "completed" and cell.get("start_time") for cell in cells)
    return not meta.get("exception") and bool(meta.get("end_time")) and complete


def _read(path: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return what papermill noted of an output notebook and of each code cell of its source."""
    document = nbformat.read(path, as_version=4)
    papermill_tags = {"injected-parameters", "papermill-error-cell-tag"}
    code = [cell.metadata for cell in document.cells if cell.cell_type == "code" and cell.source.strip()]
    cells = [meta.get("papermill", {}) for meta in code if not papermill_tags & set(meta.get("tags", []))]
    return document.metadata.get("papermill", {}), cells
