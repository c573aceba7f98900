"""Notebooks run in surroundings of their own, and refuse parameters that make no sense, however they are started."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import nbformat
import papermill
import pytest
from papermill.exceptions import PapermillExecutionError

from reproduce.report.notebooks import (
    check_parameters,
    find_notebooks,
    is_complete,
    parse_assignments,
    run_notebooks,
    stopped_at,
)
from reproduce.report.parameters import check, check_value
from reproduce.storage.errors import RunFailedError, UserError
from reproduce.storage.paths import NOTEBOOKS


def write_notebook(folder: Path, name: str, *cells: str) -> Path:
    """A notebook with a parameters cell ``tests = 3`` and these code cells."""
    first = nbformat.v4.new_code_cell("tests = 3", metadata={"tags": ["parameters"]})
    document = nbformat.v4.new_notebook(cells=[first, *map(nbformat.v4.new_code_cell, cells)])
    document.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3", "language": "python"}
    folder.mkdir(parents=True, exist_ok=True)
    nbformat.write(document, folder / f"{name}.ipynb")
    return folder / f"{name}.ipynb"


def test_values_are_checked_by_type_and_range() -> None:
    for name, good in (("preset", "smoke"), ("seed", 0), ("tests", 1), ("steps", 5), ("gamma", 0.5), ("gamma", 1.0)):
        check_value(name, good, good)
    for name, bad in (
        ("preset", "huge"),
        ("preset", 3),
        ("seed", -1),
        ("seed", 10**400),
        ("tests", 0),
        ("tests", "5"),
        ("tests", True),
        ("steps", -5),
        ("gamma", 5.0),
        ("gamma", float("nan")),
    ):
        with pytest.raises(UserError, match=f"^{name}: "):
            check_value(name, bad, bad)


def test_a_notebook_knows_its_own_parameters_when_it_begins() -> None:
    check({"seed": 3, "tests": 5, "check": check, "_i1": "seed = 3"}, "seed", "tests")
    with pytest.raises(UserError, match="sed: no parameter of this notebook; expected seed, tests"):
        check({"seed": 3, "tests": 5, "sed": 4}, "seed", "tests")
    namespace = {"seed": 3}
    check(namespace, "seed")
    namespace["rows"] = 7  # the notebook went on, and a reader runs the cell again
    check(namespace, "seed")
    namespace["seed"] = -1
    with pytest.raises(UserError, match="seed"):
        check(namespace, "seed")


def test_every_notebook_checks_its_own_parameters_first() -> None:
    for notebook in find_notebooks():
        code = [c for c in nbformat.read(notebook.path, as_version=4).cells if c.cell_type == "code"]
        names = ", ".join(f'"{name}"' for name in notebook.defaults)
        assert f"check(globals(), {names})" in code[1].source, notebook.path.stem


def test_names_and_values_are_refused_before_anything_runs() -> None:
    notebooks = find_notebooks("01")
    assert parse_assignments(["seed=5", "gamma=0.5"]) == {"seed": 5, "gamma": 0.5}
    assert check_parameters(notebooks, "smoke", {"seed": 5}) == {"01_momdp": {"preset": "smoke", "seed": 5}}
    for given in ({"sed": 3}, {"tests": 0}, {"tests": "many"}):
        with pytest.raises(UserError):
            check_parameters(notebooks, "smoke", given)
    with pytest.raises(UserError, match="preset"):
        check_parameters(notebooks, "huge", {})
    with pytest.raises(UserError, match="expected a number or name of 01_momdp"):
        find_notebooks("17")


@pytest.mark.process
def test_papermill_alone_refuses_them_too(tmp_path: Path) -> None:
    with pytest.raises(PapermillExecutionError, match="sed: no parameter of this notebook"):
        papermill.execute_notebook(
            NOTEBOOKS / "06_claims.ipynb",
            tmp_path / "out.ipynb",
            parameters={"sed": 3},
            kernel_name="python3",
            language="python",
            progress_bar=False,
        )


PLOT = """import os
import matplotlib.pyplot as plt
from reproduce.storage.paths import RESULTS
print(RESULTS.is_absolute(), RESULTS.name, os.environ.get("STARTED"))
plt.plot([tests, 1]);"""


@pytest.mark.process
def test_the_kernel_has_our_surroundings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_notebook(tmp_path / "notebooks", "01_plot", PLOT)
    profile = tmp_path / "ipython" / "profile_default" / "startup"
    profile.mkdir(parents=True)
    (profile / "00.py").write_text("import os; os.environ['STARTED'] = 'yes'")
    (tmp_path / "matplotlibrc").write_text("backend: agg\nno.such.key: 1\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    monkeypatch.setenv("MATPLOTLIBRC", str(tmp_path / "matplotlibrc"))
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    monkeypatch.setenv("HOME", "/proc/nowhere")
    monkeypatch.setenv("TMPDIR", str(tmp_path / ("long" * 50)))
    folder = run_notebooks("smoke", results=Path("relative"), sources=tmp_path / "notebooks")
    document = nbformat.read(folder / "01_plot.ipynb", as_version=4)
    outputs = [output for cell in document.cells if cell.cell_type == "code" for output in cell.outputs]
    pictures = [o for o in outputs if "image/png" in o.get("data", {})]
    assert len(pictures) == 1 and "True relative None" in str(outputs)
    assert os.environ["MPLBACKEND"] == "Agg", "the command's own surroundings are as before"


@pytest.mark.process
@pytest.mark.parametrize(
    ("cell", "words"),
    [
        ("import os, signal; os.kill(os.getpid(), signal.SIGKILL)", "cell 3: the kernel died"),
        ("1 / 0", "cell 3: ZeroDivisionError"),
        ("raise SystemExit", "cell 3"),
    ],
)
def test_a_notebook_that_fails_is_named_with_its_cell(tmp_path: Path, cell: str, words: str) -> None:
    write_notebook(tmp_path / "notebooks", "01_bad", "a = 1", cell, "b = 2")
    with pytest.raises(RunFailedError, match=f"01_bad, {words}"):
        run_notebooks("smoke", results=tmp_path, sources=tmp_path / "notebooks")
    left = tmp_path / "notebooks" / "01_bad.failed.ipynb"
    assert stopped_at(left) == 3 and not is_complete(left)


@pytest.mark.process
def test_a_command_says_where_notebooks_went_and_nothing_else(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "reproduce", "notebooks", "--only", "06", "--no-report"],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "REPRODUCE_RESULTS": str(tmp_path)},
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == f"{tmp_path / 'notebooks'}: notebooks written"
    assert "KeyboardInterrupt" not in done.stderr and "Traceback" not in done.stderr
