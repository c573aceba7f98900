"""Tuning trials: short trainings, judged on validation scenes, as many for each baseline (``trials.toml``).

Trainings and scenes are easy ones (``lunar_rescue.scenes.sampling``): on all scenes a flat method rescues next to
nobody in as many steps as a trial can have, and all trials would look alike. A trial is judged by the share of the two
processes of a rescue that its policy completes: half for both arms under, half for the rescue. Schedules are scaled to
the trial's length.
"""

import json
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pandas as pd

from lunar_rescue import ENVIRONMENT_VERSION
from lunar_rescue.scenes.splits import VALIDATION
from reproduce.experiments.evaluate import evaluate
from reproduce.experiments.methods import METHODS
from reproduce.experiments.presets import CHOSEN, TRIALS, Changes, check_tunable, configuration
from reproduce.experiments.train import train
from reproduce.storage.errors import UserError
from reproduce.storage.files import locked
from reproduce.storage.paths import COMMITTED, RESULTS
from reproduce.storage.provenance import write_table

PRESET = "laptop"
SCENES = "easy"
TUNING = "trials/tuning"  # in results/


def tune(
    method: str,
    steps: int = 300_000,
    tests: int = 100,
    tell: Callable[[str], None] = print,
    quiet: bool = False,
    results: Path = RESULTS,
) -> pd.DataFrame:
    """Make the trials of a method that were not made yet; write and return the table of all.

    A trial has ``steps`` environment steps, then ``tests`` easy validation scenes; ``tell`` gets a line a trial. The
    table is ``trials/tuning/METHOD.csv`` in ``results``, where no other tuning may be writing. After an interruption
    trials that ended are in it, and the same call makes the others.
    """
    check_tunable(method)
    if steps < 1 or tests < 1:
        raise UserError(f"--steps, --tests: expected at least 1, got {steps} and {tests}")
    path = results / TUNING / f"{method}.csv"
    with locked(path.parent, "folder of tuning trials"):
        conditions = {trial: _conditions(trial, changes, steps, tests) for trial, changes in TRIALS[method].items()}
        before: list[Any] = pd.read_csv(path).to_dict("records") if path.is_file() else []
        rows = {row["trial"]: row for row in before if _same(row, conditions.get(row["trial"], {"trial": None}))}
        for trial in conditions:
            if trial not in rows:
                rows[trial] = {**conditions[trial], **_measure(method, trial, steps, tests, quiet)}
                write_table(path, pd.DataFrame([rows[each] for each in conditions if each in rows]))
            tell(f"{method}, {trial}: score {rows[trial]['score']:.3f}")
    return pd.DataFrame([rows[trial] for trial in conditions])


def _same(row: dict[str, Any], conditions: dict[str, Any]) -> bool:
    return all(str(row.get(key)) == str(value) for key, value in conditions.items())


def _conditions(trial: str, changes: Changes, steps: int, tests: int) -> dict[str, Any]:
    """Return what must be equal for a trial not to be made again."""
    return {
        "trial": trial,
        "changes": json.dumps(dict(changes), sort_keys=True),
        "steps": steps,
        "tests": tests,
        "scenes": SCENES,
        "environment_version": ENVIRONMENT_VERSION,
    }


def _measure(method: str, trial: str, steps: int, tests: int, quiet: bool) -> dict[str, Any]:
    config = configuration(METHODS[method].kind, PRESET, {**TRIALS[method][trial], "steps": steps, "scenes": SCENES})
    try:
        with tempfile.TemporaryDirectory() as folder:
            curve = train(METHODS[method], config, 0, Path(folder) / method, PRESET, quiet=quiet)
            result = evaluate(Path(folder) / method, tests, VALIDATION.start, quiet=quiet, easy=True)
    except KeyboardInterrupt:
        words = f"tuning {method}: interrupted in trial {trial!r}; the same command goes on with that trial"
        raise KeyboardInterrupt(words) from None
    return {
        "score": (result["both_arms_under"] + result["success_rate"]) / 2,
        **{name: result[name] for name in ("both_arms_under", "success_rate")},
        "mean_return": round(result["mean_return"], 4),
        "seconds": round(float(curve["seconds"].iloc[-1]), 1),
    }


def tuning_table(results: Path = COMMITTED) -> pd.DataFrame:
    """Return score and rates of all trials, by method and trial, with a mark at those that were chosen."""
    columns = ["score", "both_arms_under", "success_rate", "steps", "tests", "seconds", "chosen"]
    paths = {METHODS[method].title: results / TUNING / f"{method}.csv" for method in TRIALS}
    tables = {title: pd.read_csv(path).set_index("trial") for title, path in paths.items() if path.is_file()}
    if not tables:
        return pd.DataFrame(columns=columns)
    table, choices = pd.concat(tables, names=["method"]), {(METHODS[m].title, trial) for m, trial in CHOSEN.items()}
    return table.assign(chosen=["x" if row in choices else "" for row in table.index])[columns]
