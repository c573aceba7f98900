"""Table 1, ours beside the paper's, from the reference runs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd

from lunar_rescue.scenes.postures import all_postures
from reproduce.analysis.intervals import mean_interval, paired_difference, same_scenes, wilson
from reproduce.analysis.runs import Run, reference_runs
from reproduce.experiments.methods import METHODS
from reproduce.storage.files import read_json, write_atomically
from reproduce.storage.paths import RESULTS
from reproduce.storage.provenance import record_origin

COLUMNS = [
    "method", "seed", "env_steps", "minutes", "tests", "successes", "success_rate", "wilson_low", "wilson_high",
    "paper_success_rate",
]  # fmt: skip


#: Files of a run folder that are no evaluations.
NOT_EVALUATIONS = ("config", "policy", "run")


def table1(results: Path = RESULTS) -> pd.DataFrame:
    """A row a method and seed that was evaluated."""
    rows = []
    for run in reference_runs(results):
        if run.evaluation is None:
            continue
        counts = {k: run.evaluation[k] for k in ("tests", "successes", "success_rate", "wilson_low", "wilson_high")}
        paper = METHODS[run.method].paper_success if run.method in METHODS else None
        origin = {
            "method": run.method,
            "seed": run.seed,
            "env_steps": run.env_steps,
            "minutes": round(run.minutes, 1),
        }
        rows.append({**origin, **counts, "paper_success_rate": paper})
    return pd.DataFrame(rows, columns=COLUMNS)


def readable_table1(results: Path = RESULTS) -> pd.DataFrame:
    """Table 1 for people: every method, saying where there is no run."""
    table = table1(results)
    held_out = {(run.method, run.seed): run.other("heldout") for run in reference_runs(results)}
    titles = {name: (m.title, m.paper_success) for name, m in METHODS.items()}
    rows = []
    for name, (title, paper) in titles.items():
        mine = table[table["method"] == name].to_dict("records")
        held = [held_out[name, r["seed"]] for r in mine]
        rows.append(
            {
                "method": title,
                "paper, 1000 tests": _percent(paper) if paper else "-",
                "ours, success [95 % interval]": ", ".join(_success(r) for r in mine) or "no run in results/ yet",
                "held out": ", ".join("-" if found is None else _success(found) for found in held),
                "tests": ", ".join(str(r["tests"]) for r in mine),
                "env steps": ", ".join(f"{r['env_steps']:,}" for r in mine),
                "minutes": ", ".join(f"{r['minutes']:.0f}" for r in mine),
            }
        )
    return pd.DataFrame(rows)


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table as Markdown."""
    cells = [[str(cell).replace("|", "\\|").replace("\n", " ") for cell in row] for row in [head, *rows]]
    lines = ["| " + " | ".join(row) + " |" for row in cells]
    return "\n".join([lines[0], "|" + "---|" * len(head), *lines[1:]]) + "\n"


def _success(found: Mapping[Any, Any]) -> str:
    rates = (_percent(found[key]) for key in ("success_rate", "wilson_low", "wilson_high"))
    return "{} [{}, {}]".format(*rates)


def _percent(rate: float) -> str:
    return f"{100 * rate:.1f} %"


def write_table1(results: Path = RESULTS) -> Path:
    """Write ``table1.csv``."""
    path = results / "table1.csv"
    table = table1(results)
    write_atomically(path, lambda temporary: table.to_csv(temporary, index=False))
    record_origin(path)
    return path


def paired_differences(results: Path = RESULTS, to: str = "hrl_dcs", name: str = "evaluation") -> pd.DataFrame:
    """How much more often ``to`` rescues than each other run, on the same scenes, with intervals.

    Args:
        results: Folder of results.
        to: Method that is compared with the others, its first seed.
        name: ``evaluation`` for test scenes, ``heldout`` for held-out ones.
    """
    rows = [(f"{to} - {run.method} seed {run.seed}", tests, *told) for run, tests, told in _paired(results, to, name)]
    return pd.DataFrame(rows, columns=["success of", "tests", "difference", "low", "high"]).set_index("success of")


def _paired(results: Path, to: str, name: str) -> list[tuple[Run, int, tuple[float, float, float]]]:
    """Runs of other methods that met the same scenes, how many, and the difference with its interval."""
    found = [(run, run.other(name)) for run in reference_runs(results)]
    tested = [(run, value) for run, value in found if value is not None and value.get("outcomes")]
    chosen = next((value for run, value in tested if run.method == to), None)
    return [
        (run, other["tests"], paired_difference(chosen["outcomes"], other["outcomes"]))
        for run, other in tested
        if chosen is not None and run.method != to and same_scenes(chosen, other)
    ]


def readable_differences(results: Path = RESULTS, to: str = "hrl_dcs") -> pd.DataFrame:
    """Paired differences for people, in points, on test scenes and on held-out ones."""
    columns = {
        title: {
            f"{METHODS[run.method].title}, seed {run.seed}": "{:+.1f} [{:+.1f}, {:+.1f}]".format(
                *(100 * value for value in told)
            )
            for run, _, told in _paired(results, to, name)
        }
        for title, name in (("test", "evaluation"), ("held out", "heldout"))
    }
    table = pd.DataFrame(columns, dtype=object).fillna("-")
    return table.rename_axis(f"{METHODS[to].title} minus").reset_index()


def nearest_to_rocks(
    results: Path = RESULTS, first: str = "hrl_dcs", second: str = "hrl_dcs_no_aapf", name: str = "evaluation"
) -> pd.DataFrame:
    """How near two methods' joints come to rocks: means over the scenes that have any, and the paired difference [m].

    Args:
        results: Folder of results.
        first: Method, its first seed.
        second: Method, its first seed.
        name: ``evaluation`` for test scenes, ``heldout`` for held-out ones.
    """
    found = []
    for method in (first, second):
        told = [run.other(name) for run in reference_runs(results) if run.method == method]
        found.append(next((t for t in told if t is not None and "nearest_mark" in t), None))
    one, other = found
    columns = ["nearest mark point of", "scenes with rocks", "mean", "low", "high"]
    if one is None or other is None or not same_scenes(one, other):
        return pd.DataFrame(columns=columns).set_index(columns[0])
    pairs = [
        (a, b)
        for a, b in zip(one["nearest_mark"], other["nearest_mark"], strict=True)
        if a is not None and b is not None
    ]
    ours, theirs = ([pair[i] for pair in pairs] for i in (0, 1))
    rows = [
        (first, len(pairs), *mean_interval(ours)),
        (second, len(pairs), *mean_interval(theirs)),
        (f"{first} - {second}", len(pairs), *mean_interval([a - b for a, b in pairs])),
    ]
    return pd.DataFrame(rows, columns=columns).set_index(columns[0])


#: Key of an evaluation and what its groups are.
CONDITIONS = {
    "by_task": "task",
    "by_terrain": "ground",
    "by_mass_class": "mass",
    "by_rocks": "rocks",
    "by_posture": "posture",
}


def by_condition(evaluation: dict[str, Any]) -> pd.DataFrame:
    """Success by task, ground, mass, number of rocks and posture, with intervals."""
    rows = []
    for key, title in CONDITIONS.items():
        for name, counts in evaluation.get(key, {}).items():
            low, high = wilson(counts["successes"], counts["tests"])
            rate = counts["successes"] / counts["tests"]
            rows.append((title, name, counts["tests"], rate, low, high))
    return pd.DataFrame(rows, columns=["of", "which", "tests", "success", "low", "high"]).set_index(["of", "which"])


def by_attitude(name: str = "evaluation", results: Path = RESULTS) -> pd.DataFrame:
    """Success of every run by task and how the body lies, in words: share and number of tests.

    Args:
        name: ``evaluation`` for test scenes, ``heldout`` for held-out ones.
        results: Folder of results.
    """
    known, columns = all_postures(), {}
    for run in reference_runs(results):
        counts: dict[str, list[int]] = {}
        for key, group in ((run.other(name) or {}).get("by_posture_and_task") or {}).items():
            posture, task = key.split(" ")
            lies = known[posture].attitude.removeprefix("left_").removeprefix("right_")
            mine = counts.setdefault(f"{task} {lies}".replace("_", " "), [0, 0])
            mine[0] += group["successes"]
            mine[1] += group["tests"]
        if counts:
            columns[f"{run.method} seed {run.seed}"] = {
                group: f"{_percent(successes / tests)} of {tests}"
                for group, (successes, tests) in sorted(counts.items())
            }
    return pd.DataFrame(columns).T


def layers(run: Run) -> pd.DataFrame:
    """What each layer adds: the trained policy with one layer put out of action, on the same scenes."""
    titles = {
        "fixed_target": "SGN replaced by the target areas",
        "anchors_alone": "SGN silent: the next point of the way in",
        "untrained_lln": "LLN untrained",
    }
    rows = []
    for name, title in {"both_layers": "both layers, as trained", **titles}.items():
        found = run.other(name)
        if found is not None:
            rate, low, high = (found[key] for key in ("success_rate", "wilson_low", "wilson_high"))
            rows.append((title, found["tests"], found["both_arms_under"], rate, low, high))
    columns = ["policy", "tests", "both arms under", "success", "low", "high"]
    return pd.DataFrame(rows, columns=columns).set_index("policy")


def evaluations(results: Path = RESULTS) -> list[tuple[Run, str, dict[str, Any]]]:
    """Every evaluation of every run: the run, the evaluation's name and what it holds."""
    found = []
    for run in reference_runs(results):
        for path in sorted(run.folder.glob("*.json")):
            if path.stem not in NOT_EVALUATIONS:
                found.append((run, path.stem, read_json(path, "evaluation")))
    return found


def write_tables(results: Path = RESULTS) -> list[Path]:
    """Write ``tables/``: what came out, without times, so that the same work gives the same bytes."""
    success: list[dict[str, Any]] = []
    groups: list[pd.DataFrame] = []
    failures: list[dict[str, Any]] = []
    for run, name, found in evaluations(results):
        key: dict[str, Any] = {"method": run.method, "seed": run.seed, "evaluation": name}
        kept = ("first_seed", "tests", "successes", "success_rate", "wilson_low", "wilson_high", "both_arms_under")
        more: dict[str, Any] = {k: found[k] for k in ("mean_return", "mean_steps") if k in found}
        success.append({**key, "env_steps": run.env_steps, **{k: found[k] for k in kept}, **more})
        groups.append(by_condition(found).reset_index().assign(**key))
        failures += [{**key, "failure": word, "tests": count} for word, count in found["failures"].items()]
    tables: dict[str, pd.DataFrame] = {
        "success": pd.DataFrame(success),
        "conditions": pd.concat(groups) if groups else pd.DataFrame(),
        "failures": pd.DataFrame(failures),
        "paired_test": paired_differences(results).reset_index(),
        "paired_heldout": paired_differences(results, name="heldout").reset_index(),
    }
    written = []
    for name, table in tables.items():
        path = results / "tables" / f"{name}.csv"
        write_atomically(path, partial(_write_csv, table))
        record_origin(path)
        written.append(path)
    return written


def _write_csv(table: pd.DataFrame, path: Path) -> None:
    table.to_csv(path, index=False)
