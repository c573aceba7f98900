"""Name the places: the checkout, its notebooks and results, and the folder that commands read and write."""

import os
from pathlib import Path

#: Where the packages lie: the checkout, or the folder into which a wheel was installed.
INSTALLED = Path(__file__).resolve().parents[2]
#: The checkout; the current folder for packages that were installed from a wheel, beside which nothing is written.
ROOT = INSTALLED if (INSTALLED / "pyproject.toml").is_file() else Path.cwd()
NOTEBOOKS = ROOT / "notebooks"
COMMITTED = ROOT / "results"
#: Where commands look for results and write them; a batch has a folder of its own.
RESULTS = Path(os.environ.get("REPRODUCE_RESULTS") or COMMITTED).resolve()
REFERENCE = "reference"  # reference runs, in a results folder
EASY = "easy"  # short trainings on easy scenes, in a results folder


def notebook_files(folder: Path = NOTEBOOKS) -> list[Path]:
    """Return the notebooks of a folder in the order of their numbers."""
    return sorted(folder.glob("[0-9][0-9]_*.ipynb"))
