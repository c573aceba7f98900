"""What lies in results/: reference runs, their curves and evaluations."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from reproduce.storage.errors import UserError
from reproduce.storage.files import read_json
from reproduce.storage.paths import REFERENCE, RESULTS


@dataclass(frozen=True)
class Run:
    """One reference run.

    Attributes:
        method: Name in the registry.
        seed: Training seed.
        folder: Where it lies.
        evaluation: ``evaluation.json``, or None.
        origin: ``run.json``, or None for a method that does not learn.
    """

    method: str
    seed: int
    folder: Path
    evaluation: dict[str, Any] | None
    origin: dict[str, Any] | None

    @property
    def env_steps(self) -> int:
        """Environment steps of the training; 0 without one."""
        return int(self.origin["steps"]) if self.origin else 0

    @property
    def minutes(self) -> float:
        """Minutes of the training; 0 without one."""
        return float(self.origin["seconds"]) / 60 if self.origin else 0.0

    def other(self, name: str) -> dict[str, Any] | None:
        """Another evaluation of the run, such as ``heldout`` or an ablation, or None."""
        path = self.folder / f"{name}.json"
        return read_json(path, "evaluation") if path.is_file() else None

    def curve(self) -> pd.DataFrame | None:
        """``progress.csv``, or None."""
        path = self.folder / "progress.csv"
        return pd.read_csv(path) if path.is_file() else None


def reference_runs(results: Path = RESULTS, kind: str = REFERENCE) -> list[Run]:
    """All runs of a kind, ``REFERENCE`` or ``EASY``, ordered by method and seed."""
    runs = []
    for folder in sorted((results / kind).glob("*/seed*")):
        number = folder.name.removeprefix("seed")
        if not number.isdigit():
            raise UserError(f"{folder}: expected a folder name seedK with a number K")
        evaluation, origin = folder / "evaluation.json", folder / "run.json"
        runs.append(
            Run(
                folder.parent.name,
                int(number),
                folder,
                read_json(evaluation, "evaluation") if evaluation.is_file() else None,
                read_json(origin, "run description") if origin.is_file() else None,
            )
        )
    return runs


def runs_of(method: str, results: Path = RESULTS) -> list[Run]:
    """Reference runs of one method that were evaluated."""
    return [run for run in reference_runs(results) if run.method == method and run.evaluation is not None]
