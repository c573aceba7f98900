"""Read the evidence in results/, reference runs with their curves and evaluations, and refuse what is not sound."""

import filecmp
import math
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from pydantic import ConfigDict, NonNegativeFloat, NonNegativeInt, with_config
from typing_extensions import TypedDict

from lunar_rescue import ENVIRONMENT_VERSION
from lunar_rescue.scenes.splits import split_of
from reproduce.experiments.evaluations import EVALUATIONS
from reproduce.experiments.methods import METHODS
from reproduce.experiments.rows import read_rows, summarise
from reproduce.storage.errors import UserError
from reproduce.storage.paths import REFERENCE, RESULTS
from reproduce.storage.records import read_record

PAPER_STEPS = 700_000_000  # at most, section 4.1
_STRICT = with_config(ConfigDict(strict=True, allow_inf_nan=False, extra="allow"))


@_STRICT
class _Origin(TypedDict):
    command: str
    environment_version: str


@_STRICT
class _Training(_Origin):
    method: str
    seed: NonNegativeInt
    steps: NonNegativeInt
    seconds: NonNegativeFloat


@_STRICT
class _Summary(TypedDict):
    method: str
    seconds: NonNegativeFloat
    seconds_per_test: NonNegativeFloat
    origin: _Origin


@dataclass(frozen=True)
class Run:
    """One reference run; its evaluations are read and checked when one is first asked for."""

    method: str  # name in the registry
    seed: int  # of the training
    folder: Path
    origin: dict[str, Any] | None  # ``run.json``, or None without a training

    @property
    def label(self) -> str:
        """Return method and seed, as tables and figures name the run."""
        return f"{self.method} seed {self.seed}"

    @property
    def env_steps(self) -> int:
        """Return the environment steps of the training; 0 without one."""
        return self.origin["steps"] if self.origin else 0

    @property
    def minutes(self) -> float:
        """Return the minutes of the training; 0 without one."""
        return self.origin["seconds"] / 60 if self.origin else 0.0

    @cached_property
    def _evaluations(self) -> dict[str, tuple[dict[str, Any], pd.DataFrame]]:
        files = {name: self.folder / f"{name}.json" for name in EVALUATIONS}
        return {name: read_evaluation(path, self.method) for name, path in files.items() if path.is_file()}

    @property
    def evaluation(self) -> dict[str, Any] | None:
        """Return the summary of ``evaluation.json``, or None."""
        return self.summary("evaluation")

    def summary(self, name: str) -> dict[str, Any] | None:
        """Return the summary of an evaluation, such as ``heldout`` or an ablation, or None."""
        return self._evaluations[name][0] if name in self._evaluations else None

    def rows(self, name: str = "evaluation") -> pd.DataFrame | None:
        """Return an evaluation's rows, a scene each with the columns of ``SceneRow``, or None."""
        return self._evaluations[name][1] if name in self._evaluations else None

    def curve(self) -> pd.DataFrame | None:
        """Return ``progress.csv``, or None; one that is no table of env steps and returns is a ``UserError``."""
        path = self.folder / "progress.csv"
        try:
            curve = pd.read_csv(path)
            sound = len(curve) > 0 and np.isfinite(curve[["env_steps", "return_high"]].to_numpy(dtype=float)).all()
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError) as error:
            raise UserError(f"{path}: learning curve: not readable: {error}") from None
        if not sound:
            raise UserError(f"{path}: learning curve: expected rows with finite env_steps and return_high")
        return curve


def read_evaluation(path: Path, method: str) -> tuple[dict[str, Any], pd.DataFrame]:
    """Read ``NAME.json`` and ``NAME.csv``, NAME in ``EVALUATIONS``; return the summary and the rows of scenes.

    It is a ``UserError`` where it is another method's, split's, ablation's or environment's, an easy one, or its
    summary is not that of its rows.
    """
    summary, rows = read_record(path, "evaluation", _Summary), read_rows(path.with_suffix(".csv"))
    plan = EVALUATIONS[path.stem]
    expected = {"method": method, "ablation": plan.ablation, "scenes": None, "split": split_of(plan.first_seed)}
    _expect(path, expected, summary)
    _expect(path, {"environment_version": ENVIRONMENT_VERSION}, summary["origin"])
    for key, value in summarise(rows).items():
        entry = summary.get(key)
        numbers = isinstance(value, float) and isinstance(entry, int | float)
        if not (math.isclose(entry, value, rel_tol=1e-9) if numbers else entry == value):
            raise UserError(f"{path}: {key}: expected {value}, as {path.stem}.csv has it, got {entry!r}")
    return summary, rows


def _expect(path: Path, expected: dict[str, Any], data: dict[str, Any]) -> None:
    for key, value in expected.items():
        if data.get(key) != value:
            words = "none" if value is None else value
            raise UserError(f"{path}: {key}: expected {words}, got {data.get(key, 'none')!r}")


def reference_runs(results: Path = RESULTS, kind: str = REFERENCE) -> list[Run]:
    """Return all runs of a kind, ``REFERENCE`` or ``EASY``, ordered by method and seed.

    A folder or description that is another run's, and weights that two runs share, are a ``UserError``.
    """
    runs = [_run(folder) for folder in sorted((results / kind).glob("*/seed*"))]
    weights = [path for run in runs if (path := run.folder / "policy.safetensors").is_file()]
    for first, second in combinations(weights, 2):
        if filecmp.cmp(first, second, shallow=False):
            raise UserError(f"{second}: expected a training's own weights, got those of {first}")
    return sorted(runs, key=lambda run: (run.method, run.seed))


def _run(folder: Path) -> Run:
    method, number, path = folder.parent.name, folder.name.removeprefix("seed"), folder / "run.json"
    if method not in METHODS:
        raise UserError(f"{folder.parent}: expected a folder named for one of {', '.join(METHODS)}")
    if not number.isdigit():
        raise UserError(f"{folder}: expected a folder name seedK with a number K")
    origin = read_record(path, "run description", _Training) if path.is_file() else None
    if origin:
        _expect(path, {"method": method, "seed": int(number), "environment_version": ENVIRONMENT_VERSION}, origin)
    return Run(method, int(number), folder, origin)


def runs_of(method: str, results: Path = RESULTS) -> list[Run]:
    """Return the reference runs of one method that were evaluated."""
    return [run for run in reference_runs(results) if run.method == method and run.evaluation is not None]


def runs_with_curves(*methods: str, results: Path = RESULTS, kind: str = REFERENCE) -> list[Run]:
    """Return the runs of these methods, or of all without one named, that have a learning curve."""
    runs = reference_runs(results, kind)
    return [run for run in runs if run.method in (methods or METHODS) and run.curve() is not None]
