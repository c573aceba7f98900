"""Make Table 1, ours beside the paper's, and further tables, from the rows of the reference runs."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from lunar_rescue.scenes.scene import MASS_RANGE
from reproduce.analysis.intervals import mean_interval, paired_difference, same_scenes
from reproduce.analysis.runs import Run, reference_runs
from reproduce.experiments.evaluations import EVALUATIONS
from reproduce.experiments.methods import METHODS
from reproduce.experiments.rows import wilson
from reproduce.storage.paths import RESULTS
from reproduce.storage.provenance import write_table

COUNTS = ["tests", "successes", "success_rate", "wilson_low", "wilson_high"]
COLUMNS = ["method", "seed", "env_steps", "minutes", *COUNTS, "paper_success_rate"]
SPLIT_TITLES = {"test": "evaluation", "held out": "heldout"}
MASS_CLASSES = 3  # equal parts of the range of masses
_join = ", ".join


def table1(results: Path = RESULTS) -> pd.DataFrame:
    """Return a row a method and seed that was evaluated, with the columns ``COLUMNS``."""
    rows = [
        {
            "seed": run.seed,
            "env_steps": run.env_steps,
            "minutes": round(run.minutes, 1),
            "paper_success_rate": METHODS[run.method].paper_success,
            **run.evaluation,
        }
        for run in reference_runs(results)
        if run.evaluation
    ]
    return pd.DataFrame(rows, columns=COLUMNS)


def readable_table1(results: Path = RESULTS) -> pd.DataFrame:
    """Return Table 1 for people: every method, saying where there is no run."""
    runs, rows = [run for run in reference_runs(results) if run.evaluation], []
    for name, method in METHODS.items():
        mine = [run for run in runs if run.method == name]
        rows.append(
            {
                "method": method.title,
                "paper, 1000 tests": _percent(method.paper_success) if method.paper_success else "-",
                "ours, success [95 % interval]": _join(_success(run.evaluation) for run in mine)
                or "no run in results/ yet",
                "held out": _join(_success(run.summary("heldout")) for run in mine),
                "rescued gently": _join(_percent(run.evaluation["gentle"]) for run in mine if run.evaluation),
                "tests": _join(str(run.evaluation["tests"]) for run in mine if run.evaluation),
                "env steps": _join(f"{run.env_steps:,}" for run in mine),
                "minutes": _join(f"{run.minutes:.0f}" for run in mine),
            }
        )
    return pd.DataFrame(rows)


def _success(summary: dict[str, Any] | None) -> str:
    return "{} [{}, {}]".format(*(_percent(summary[key]) for key in COUNTS[2:])) if summary else "-"


def _percent(rate: float) -> str:
    return f"{100 * rate:.1f} %"


def write_table1(results: Path = RESULTS) -> Path:
    """Write ``table1.csv`` and return its path."""
    return write_table(results / "table1.csv", table1(results))


def paired_differences(results: Path = RESULTS, to: str = "hrl_dcs", name: str = "evaluation") -> pd.DataFrame:
    """Return how much more often ``to`` rescues than each other run, on the same scenes, with intervals.

    ``to`` is compared by its first seed; ``name`` is ``evaluation`` for test scenes, ``heldout`` for held-out ones.
    """
    rows = [(f"{to} - {run.label}", tests, *difference) for run, tests, difference in _pairs(results, to, name)]
    return pd.DataFrame(rows, columns=["success of", "tests", "difference", "low", "high"]).set_index("success of")


def _pairs(results: Path, to: str, name: str) -> list[tuple[Run, int, tuple[float, float, float]]]:
    """Return runs of other methods that met the same scenes, how many, and the difference with its interval."""
    tests = [(run, rows) for run in reference_runs(results) if (rows := run.rows(name)) is not None]
    own = next((rows for run, rows in tests if run.method == to), None)
    return [
        (run, len(rows), paired_difference(own["success"], rows["success"]))
        for run, rows in tests
        if own is not None and run.method != to and same_scenes(own, rows)
    ]


def readable_differences(results: Path = RESULTS, to: str = "hrl_dcs") -> pd.DataFrame:
    """Return paired differences for people, in points, on test scenes and on held-out ones."""
    columns = {
        title: {
            f"{METHODS[run.method].title}, seed {run.seed}": "{:+.1f} [{:+.1f}, {:+.1f}]".format(
                *(100 * value for value in difference)
            )
            for run, _, difference in _pairs(results, to, name)
        }
        for title, name in SPLIT_TITLES.items()
    }
    table = pd.DataFrame(columns, dtype=object).fillna("-")
    return table.rename_axis(f"{METHODS[to].title} minus").reset_index()


def nearest_to_rocks(
    results: Path = RESULTS, first: str = "hrl_dcs", second: str = "hrl_dcs_no_aapf", name: str = "evaluation"
) -> pd.DataFrame:
    """Return how near two methods' joints come to rocks: means over scenes with rocks, and the paired difference [m].

    Of both methods it is the first seed; ``name`` is ``evaluation`` for test scenes, ``heldout`` for held-out ones.
    """
    runs = {run.method: run.rows(name) for run in reversed(reference_runs(results))}  # the first seed stays
    ours, theirs = runs.get(first), runs.get(second)
    near = pd.DataFrame()
    if ours is not None and theirs is not None and same_scenes(ours, theirs):
        near = pd.DataFrame({first: ours["nearest_mark"], second: theirs["nearest_mark"]}).dropna()
        near[f"{first} - {second}"] = near[first] - near[second]
    rows = [(key, len(near), *mean_interval(near[key])) for key in near]
    columns = ["nearest mark point of", "scenes with rocks", "mean", "low", "high"]
    return pd.DataFrame(rows, columns=columns).set_index(columns[0])


def by_condition(rows: pd.DataFrame) -> pd.DataFrame:
    """Return success by task, ground, mass, number of rocks and posture, with intervals, from an evaluation's rows."""
    edges = np.linspace(*MASS_RANGE, MASS_CLASSES + 1)
    words = [f"{low:.0f} to {high:.0f} kg" for low, high in pairwise(edges)]
    conditions = {
        "task": rows["task"],
        "ground": rows["terrain"],
        "mass": pd.cut(rows["mass"], [*edges[:-1], np.inf], right=False, labels=words).astype(str),
        "rocks": rows["rocks"].astype(str),
        "posture": rows["posture"],
    }
    counts = pd.concat(
        {title: rows.groupby(which)["success"].agg(["size", "sum"]) for title, which in conditions.items()},
        names=["of", "which"],
    )
    cells = [(size, total / size, *wilson(total, size)) for size, total in counts.itertuples(index=False)]
    return pd.DataFrame(cells, index=counts.index, columns=["tests", "success", "low", "high"])


def by_attitude(name: str = "evaluation", results: Path = RESULTS) -> pd.DataFrame:
    """Return the success of every run by task and how the body lies, in words: share and number of tests.

    ``name`` is ``evaluation`` for test scenes, ``heldout`` for held-out ones.
    """
    columns = {}
    for run in reference_runs(results):
        if (rows := run.rows(name)) is not None:
            lies = rows["attitude"].str.removeprefix("left_").str.removeprefix("right_")
            groups = rows.groupby((rows["task"] + " " + lies).str.replace("_", " "))["success"]
            columns[run.label] = groups.agg(lambda tests: f"{_percent(tests.mean())} of {len(tests)}")
    return pd.DataFrame(columns).T


#: What the evaluations of a two-layer policy are called in the table of its layers.
LAYERS = {
    "both_layers": "both layers, as trained",
    "fixed_target": "SGN replaced by the target areas",
    "untrained_lln": "LLN untrained",
}


def layers(run: Run) -> pd.DataFrame:
    """Return what each layer adds: the trained policy with one layer put out of action, on the same scenes."""
    keys = ["tests", "both_arms_under", *COUNTS[2:]]
    rows = [(title, *map(summary.get, keys)) for name, title in LAYERS.items() if (summary := run.summary(name))]
    columns = ["policy", "tests", "both arms under", "success", "low", "high"]
    return pd.DataFrame(rows, columns=columns).set_index("policy")


def write_tables(results: Path = RESULTS) -> list[Path]:
    """Write ``tables/``: what came out, without times, so that the same work gives the same bytes."""
    success, conditions, failures = [], [], []
    for run, name in ((run, name) for run in reference_runs(results) for name in EVALUATIONS):
        summary, rows = run.summary(name), run.rows(name)
        if summary is None or rows is None:
            continue
        key: dict[str, Any] = {"method": run.method, "seed": run.seed, "evaluation": name}
        figures = ["first_seed", *COUNTS, "both_arms_under", "gentle", "mean_return", "mean_steps"]
        success.append({**key, "env_steps": run.env_steps, **{name: summary[name] for name in figures}})
        conditions.append(by_condition(rows).reset_index().assign(**key))
        failures += [{**key, "failure": word, "tests": count} for word, count in summary["failures"].items()]
    tables = {
        "success": pd.DataFrame(success),
        "conditions": pd.concat(conditions) if conditions else pd.DataFrame(),
        "failures": pd.DataFrame(failures),
        "paired_test": paired_differences(results).reset_index(),
        "paired_heldout": paired_differences(results, name="heldout").reset_index(),
    }
    return [write_table(results / "tables" / f"{name}.csv", table) for name, table in tables.items()]
