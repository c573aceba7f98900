"""Name the places: the checkout, its notebooks and results, and the folder that commands read and write."""

import os
from pathlib import Path

from reproduce.storage.errors import UserError

#: Where the packages lie: the checkout, or the folder into which a wheel was installed.
INSTALLED = Path(__file__).resolve().parents[2]
#: The checkout; the current folder for packages that were installed from a wheel, beside which nothing is written.
ROOT = INSTALLED if (INSTALLED / "pyproject.toml").is_file() else Path.cwd()
NOTEBOOKS = ROOT / "notebooks"
COMMITTED = ROOT / "results"
#: Where commands look for results and write them; a batch has a folder of its own.
RESULTS = Path(os.environ.get("REPRODUCE_RESULTS") or COMMITTED).resolve()
REFERENCE = "reference"  # reference runs, in a results folder
CHECKPOINT = "checkpoint.safetensors"  # in the run folder of a training that has not ended
EASY = "easy"  # short trainings on easy scenes, in a results folder


def choose_notebooks(only: str | None = None, folder: Path = NOTEBOOKS) -> list[Path]:
    """Return the notebooks in order, or the one whose number or name is ``only``."""
    paths = notebook_files(folder)
    if not paths:
        raise UserError(f"{folder}: no notebooks there; they need a checkout of the project")
    if only is None:
        return paths
    chosen = [path for path in paths if only in (path.stem, path.stem[:2])]
    if not chosen:
        names = ", ".join(path.stem for path in paths)
        raise UserError(f"--only: expected a number or name of {names}; got {only!r}")
    return chosen


def notebook_files(folder: Path = NOTEBOOKS) -> list[Path]:
    """Return the notebooks of a folder in the order of their numbers."""
    return sorted(folder.glob("[0-9][0-9]_*.ipynb"))
