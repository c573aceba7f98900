"""Put the methods side by side: what each was given, how long it was trained, and what it does here and now."""

import math
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from reproduce.analysis.runs import PAPER_STEPS, Run, reference_runs
from reproduce.analysis.tables import SPLIT_TITLES
from reproduce.analysis.trainings import percent, steps_to
from reproduce.experiments.evaluate import evaluate, rescue_scenes
from reproduce.experiments.methods import METHODS
from reproduce.experiments.train import train
from reproduce.storage.paths import RESULTS
from reproduce.storage.records import to_dict

TRIES = 20  # scenes among which one is looked for that ends as wanted


def first_seeds(runs: Sequence[Run]) -> list[Run]:
    """Return the first training of each method, of runs in the order of ``reference_runs``."""
    return list({run.method: run for run in reversed(runs)}.values())[::-1]


def priors_table(preset: str = "laptop") -> pd.DataFrame:
    """Return a row a method that learns: which priors of ours it has, and whether it begins from demonstrations."""
    rows = {}
    for method in (method for method in METHODS.values() if method.learns):
        priors = method.config(preset).priors
        values = {field.name.replace("_", " "): getattr(priors, field.name) for field in fields(priors)}
        named = [name if value is True else f"{name} {value:g}" for name, value in values.items() if value]
        begins = "imitates the planner" if method.name.endswith("_demos") else "from nothing"
        rows[method.title] = {"begins": begins, "priors that the paper does not have": ", ".join(named) or "none"}
    return pd.DataFrame(rows).T.rename_axis("method")


def lengths(results: Path = RESULTS) -> pd.DataFrame:
    """Return a row a training: its length beside the paper's, and when it rescued 90 %."""
    rows = []
    for run in (run for run in reference_runs(results) if run.origin):
        curve = run.curve()
        steps = steps_to(curve, 0.9) if curve is not None else math.inf
        rows.append(
            {
                "training": f"{METHODS[run.method].title}, seed {run.seed}",
                "million env steps": round(run.env_steps / 1e6, 2),
                "of the paper's at most": f"{100 * run.env_steps / PAPER_STEPS:.2g} %",
                "minutes": round(run.minutes),
                "rescues 90 % after": f"{100 * steps / run.env_steps:.0f} % of it" if math.isfinite(steps) else "never",
            }
        )
    columns = ["million env steps", "of the paper's at most", "minutes", "rescues 90 % after"]
    return pd.DataFrame(rows, columns=["training", *columns]).set_index("training")


def pooled_rows(name: str = "evaluation", results: Path = RESULTS) -> dict[str, pd.DataFrame]:
    """Return the rows of an evaluation by method's title, trainings together; see ``reproduce.analysis.runs``."""
    tables: dict[str, list[pd.DataFrame]] = {}
    for run in reference_runs(results):
        if (rows := run.rows(name)) is not None:
            tables.setdefault(METHODS[run.method].title, []).append(rows)
    return {title: pd.concat(parts, ignore_index=True) for title, parts in tables.items()}


def check_now(runs: Sequence[Run], tests: int, first_seed: int) -> pd.DataFrame:
    """Test the first training of each method on a few scenes now; return what came beside what results/ has."""
    rows = []
    for run in (run for run in first_seeds(runs) if run.origin):
        now = evaluate(run.folder, tests, first_seed, quiet=True)
        recorded = "-" if run.evaluation is None else f"{100 * run.evaluation['success_rate']:.1f} %"
        counts = {"tests now": now["tests"], "rescues now": now["successes"], "in results/": recorded}
        rows.append({"run": run.label, **counts, "seconds a test": round(now["seconds_per_test"], 2)})
    return pd.DataFrame(rows, columns=["run", *("tests now", "rescues now", "in results/", "seconds a test")])


def choose_scene(success: bool, first_seed: int, results: Path = RESULTS) -> tuple[Path | str, int]:
    """Return who is shown and in which scene: the best two-layer run, else the script, where it ends as wanted.

    The scene is the first of the run's tests, or of ``TRIES`` from ``first_seed`` on, that ends in a rescue or, without
    ``success``, does not; the first of all where none does.
    """
    runs = [run for run in reference_runs(results) if run.origin and run.rows() is not None]
    rates = {run.label: run.evaluation["success_rate"] for run in runs if run.evaluation}
    best = max(
        (run for run in runs if run.method.startswith("hrl_dcs")), key=lambda run: rates[run.label], default=None
    )
    if best is not None and (rows := best.rows()) is not None:
        where, seeds, ends = best.folder, rows["seed"].tolist(), rows["success"].tolist()
    else:
        where = Path("scripted")
        tried = rescue_scenes(str(where), TRIES, first_seed, quiet=True)
        seeds, ends = [row["seed"] for row in tried], [row["success"] for row in tried]
    return where, next((seed for seed, end in zip(seeds, ends, strict=True) if end == success), seeds[0])


def short_trainings(steps: int, seed: int = 0, methods: Sequence[str] = ()) -> pd.DataFrame:
    """Train each method that learns, or those named, for ``steps`` steps; return returns of a rescue and seconds."""
    rows = {}
    for name in methods or [name for name, method in METHODS.items() if method.learns]:
        method = METHODS[name]
        with tempfile.TemporaryDirectory() as folder:
            config = replace(method.config("smoke"), steps=steps)
            curve = train(method, config, seed, Path(folder) / name, "smoke", quiet=True)
        rows[method.title] = {
            "env steps": int(curve["env_steps"].iloc[-1]),
            "return a rescue": "none ended" if np.isnan(mean := curve["return_high"].mean()) else round(mean, 2),
            "seconds": round(curve["seconds"].iloc[-1], 1),
        }
    return pd.DataFrame(rows).T.rename_axis("method")


def setting_differences(first: str, second: str, preset: str) -> pd.DataFrame:
    """Return the settings in which two methods differ under a preset, a row a setting."""
    ours, theirs = (pd.json_normalize(to_dict(METHODS[name].config(preset))).T[0] for name in (first, second))
    return pd.DataFrame({first: ours, second: theirs})[ours.astype(str) != theirs.astype(str)].rename_axis("setting")


def success_table(*methods: str, results: Path = RESULTS) -> pd.DataFrame:
    """Return a row an evaluated run of these methods: success with its interval, rock contacts and minutes."""
    rows = [
        {
            "run": run.label,
            "success": percent(s["success_rate"], (s["wilson_low"], s["wilson_high"])),
            "tests": s["tests"],
            "rock contacts a test": round(s["failures"].get("obstacle_contact", 0) / s["tests"], 3),
            "minutes": round(run.minutes),
        }
        for run in reference_runs(results)
        if run.method in methods and (s := run.evaluation)
    ]
    columns = ["run", "success", "tests", "rock contacts a test", "minutes"]
    return pd.DataFrame(rows, columns=columns).set_index("run")


def split_pairs(make: Callable[..., pd.DataFrame], like: str = "", **arguments: Any) -> pd.DataFrame:
    """Return a table of pairs on test scenes above that on held-out ones; ``like`` chooses rows by what they name."""
    tables = {title: make(name=name, **arguments) for title, name in SPLIT_TITLES.items()}
    tables = {title: table[[like in str(row) for row in table.index]] for title, table in tables.items()}
    return pd.concat(tables, names=["scenes"]).round(3)
