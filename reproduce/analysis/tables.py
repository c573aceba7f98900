"""Make Table 1, ours beside the paper's, and further tables, from the rows of the reference runs."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from lunar_rescue.scenes.scene import MASS_RANGE
from reproduce.analysis.intervals import Interval, crossed_interval, in_points, paired_difference, success_difference
from reproduce.analysis.runs import Run, reference_runs
from reproduce.analysis.trainings import LEVELS, Pool, horizon, read_pools, steps_to
from reproduce.experiments.evaluations import EVALUATIONS
from reproduce.experiments.methods import METHODS
from reproduce.experiments.rows import wilson
from reproduce.storage.paths import RESULTS
from reproduce.storage.provenance import write_table

COUNTS = ["tests", "successes", "success_rate", "wilson_low", "wilson_high"]
COLUMNS = ["method", "seed", "env_steps", "minutes", *COUNTS, "paper_success_rate"]
SPLIT_TITLES = {"test": "evaluation", "held out": "heldout"}
PAPER_LEVEL = 0.986  # success that the paper's method ends with
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
    """Return Table 1 for people: every method, its mean over trainings and each of them, or that there is no run."""
    tested, held_out, rows = read_pools(results), read_pools(results, "heldout"), []
    for name, method in METHODS.items():
        pool, held = tested.get(name), held_out.get(name)
        runs = pool.runs if pool else ()
        rows.append(
            {
                "method": method.title,
                "paper, 1000 tests": _percent(method.paper_success) if method.paper_success else "-",
                "ours, success [95 % interval]": pool.rate_words if pool else "no run in results/ yet",
                "each training": _join(f"{100 * rate:.1f}" for rate in pool.rates) if pool and method.learns else "",
                "held out": held.rate_words if held else ("-" if pool else ""),
                "rescued gently": _percent(float(_gentle(pool).mean())) if pool else "",
                "tests": str(len(pool.scenes)) if pool else "",
                "env steps": _join(sorted({f"{run.env_steps:,}" for run in runs})),
                "minutes": _join(f"{run.minutes:.0f}" for run in runs),
            }
        )
    return pd.DataFrame(rows)


def _gentle(pool: Pool) -> NDArray[np.bool_]:
    """Return which tests ended in a gentle rescue, (trainings, scenes)."""
    return pool.outcomes & (pool.values("gentle") > 0.0)


def methods_table(results: Path = RESULTS) -> pd.DataFrame:
    """Return a row a method and evaluation: mean success over trainings, its interval, the least and the best one."""
    columns = ["method", "evaluation", "trainings", "env_steps", "tests"]
    columns += ["success_rate", "low", "high", "least", "best", "gentle"]
    rows = []
    for title in SPLIT_TITLES.values():
        for name, pool in read_pools(results, title).items():
            scale = name, title, len(pool.runs), pool.env_steps, len(pool.scenes)
            rows.append((*scale, *pool.success, min(pool.rates), max(pool.rates), float(_gentle(pool).mean())))
    return pd.DataFrame(rows, columns=columns)


def levels_table(results: Path = RESULTS) -> pd.DataFrame:
    """Return a row a method and level of success while training: steps and minutes of its trainings to reach it.

    ``restricted_mean`` is of the steps of all trainings, who has not reached the level counted with ``within``, the
    steps of the method's shortest training; ``steps`` and ``minutes`` are of each training, in the order of seeds.
    """
    columns = ["method", "level", "trainings", "within", "reached", "restricted_mean", "steps", "minutes"]
    rows = []
    for name, pool in read_pools(results).items():
        within = horizon([pool]) if pool.curves else 0.0
        for level in (*LEVELS, PAPER_LEVEL) if pool.curves else ():
            steps = [steps_to(curve, level) for curve in pool.curves]
            reached, mean = sum(s <= within for s in steps), float(np.mean([min(s, within) for s in steps]))
            minutes = [c.set_index("env_steps")["seconds"].get(s) for c, s in zip(pool.curves, steps, strict=True)]
            told = _join("-" if np.isinf(s) else f"{s:.0f}" for s in steps)
            lasted = _join("-" if m is None else f"{m / 60:.1f}" for m in minutes)
            rows.append((name, level, len(steps), within, reached, mean, told, lasted))
    return pd.DataFrame(rows, columns=columns)


def _percent(rate: float) -> str:
    return f"{100 * rate:.1f} %"


def write_table1(results: Path = RESULTS) -> Path:
    """Write ``table1.csv`` and return its path."""
    return write_table(results / "table1.csv", table1(results))


def paired_differences(results: Path = RESULTS, to: str = "hrl_dcs", name: str = "evaluation") -> pd.DataFrame:
    """Return how much more often ``to`` rescues than each other method, on the same scenes, with 95 % intervals.

    ``interval of`` says whether the interval is one of new trainings or of one training (each, where both learn), which
    says nothing of others. ``name`` is ``evaluation`` for test scenes, ``heldout`` for held-out ones.
    """
    rows = [
        (f"{to} - {other.method}", f"{len(own.runs)}, {len(other.runs)}", len(own.scenes), *interval, of)
        for own, other, interval, of in _differences(results, to, name)
    ]
    columns = ["success of", "trainings", "tests", "difference", "low", "high", "interval of"]
    return pd.DataFrame(rows, columns=columns).set_index("success of")


def _differences(results: Path, to: str, name: str) -> list[tuple[Pool, Pool, Interval, str]]:
    """Return a method, each other one that met the same scenes, their difference and what its interval is of."""
    pools = read_pools(results, name)
    own = pools.get(to)
    others = [pool for pool in pools.values() if own and pool is not own and pool.scenes == own.scenes]
    return [(own, other, *_difference(own, other)) for other in others if own]


def _difference(first: Pool, second: Pool) -> tuple[Interval, str]:
    if all(len(pool.runs) > 1 or not METHODS[pool.method].learns for pool in (first, second)):
        return success_difference(first.outcomes, second.outcomes), "trainings"
    each = all(METHODS[pool.method].learns for pool in (first, second))
    return paired_difference(first.outcomes[0], second.outcomes[0]), "one training each" if each else "one training"


def readable_differences(results: Path = RESULTS, to: str = "hrl_dcs") -> pd.DataFrame:
    """Return paired differences for people, in points, on test scenes and on held-out ones."""
    columns = {
        title: {
            METHODS[other.method].title + (f", {of}" if of.startswith("one") else ""): in_points(interval)
            for _, other, interval, of in _differences(results, to, name)
        }
        for title, name in SPLIT_TITLES.items()
    }
    table = pd.DataFrame(columns, dtype=object).fillna("-")
    return table.rename_axis(f"{METHODS[to].title} minus").reset_index()


def nearest_to_rocks(
    results: Path = RESULTS, first: str = "hrl_dcs", second: str = "hrl_dcs_no_aapf", name: str = "evaluation"
) -> pd.DataFrame:
    """Return how near two methods' joints come to rocks: means over scenes with rocks, and the difference [m].

    Intervals are over all trainings and scenes; ``name`` is ``evaluation`` for test scenes, ``heldout`` for others.
    """
    pools, rows = read_pools(results, name), []
    if first in pools and second in pools and pools[first].scenes == pools[second].scenes:
        near = [pools[method].values("nearest_mark") for method in (first, second)]
        with_rocks = np.isfinite(np.concatenate(near)).all(axis=0)
        ours, theirs = (marks[:, with_rocks] for marks in near)
        if with_rocks.any():
            cases = {first: (ours, None), second: (theirs, None), f"{first} - {second}": (ours, theirs)}
            rows = [(key, int(with_rocks.sum()), *crossed_interval(*case)) for key, case in cases.items()]
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
        "methods": methods_table(results),
        "levels": levels_table(results),
        "paired_test": paired_differences(results).reset_index(),
        "paired_heldout": paired_differences(results, name="heldout").reset_index(),
    }
    return [write_table(results / "tables" / f"{name}.csv", table) for name, table in tables.items()]
