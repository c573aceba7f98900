"""Where things lie: the checkout, its results, and the folder that commands read results from and write them to."""

from __future__ import annotations

import os
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
COMMITTED = ROOT / "results"
#: Where commands look for results and write them; a batch has a folder of its own.
RESULTS = Path(os.environ.get("REPRODUCE_RESULTS") or COMMITTED).resolve()
REFERENCE = "reference"  # reference runs, in a results folder
EASY = "easy"  # short trainings on easy scenes, in a results folder
