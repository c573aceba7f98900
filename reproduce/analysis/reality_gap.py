"""Read the stress tests; tell what a policy loses and gains under disturbances and from simulator to simulator."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from lunar_rescue.disturbances import KINDS, SEVERITIES
from lunar_rescue.physics.engines import DEFAULT
from reproduce.analysis.intervals import in_points, paired_difference, same_scenes
from reproduce.experiments.methods import METHODS
from reproduce.experiments.stress import COLUMNS, NONE, OTHER, summarise_stress
from reproduce.storage.errors import UserError
from reproduce.storage.files import read_json
from reproduce.storage.paths import RESULTS

NO_STRESS = "No stress tests yet: `reproduce stress DIR` writes them to results/stress/."
NO_PAIR = "No policy was tested in both simulators yet: `reproduce stress DIR --kinds none`, where MuJoCo is installed."
SIDES = {"in PyBullet": "first", "in MuJoCo": "second"}
GROUPS = {"task": ["task"], "attitude": ["task", "attitude"], "posture": ["task", "posture"]}


def severities() -> pd.DataFrame:
    """Return what each severity of each kind is, a row a kind, as ``lunar_rescue.disturbances`` has it."""
    rows = [
        {
            "kind": kind.title,
            "unit": kind.unit,
            **dict(zip(SEVERITIES, kind.levels, strict=True)),
            "meaning": kind.about,
        }
        for kind in KINDS.values()
    ]
    return pd.DataFrame(rows).set_index("kind")


def stress_rows(results: Path = RESULTS, folder: str = "stress") -> pd.DataFrame:
    """Return the rows of all stress tests, ``stress/METHOD.csv``, methods in the registry's order; may be empty.

    With ``folder="transfer"`` they are those of the two simulators alone, on more scenes.

    Raises:
        UserError: On a file that is no table of stress tests, or another method's.
    """
    tables = []
    for name in METHODS:
        path = results / folder / f"{name}.csv"
        if not path.is_file():
            continue
        try:
            table = pd.read_csv(path, dtype={"failure": object})
        except (OSError, ValueError) as error:
            raise UserError(f"{path}: rows of stress tests: not readable: {error}") from None
        if missing := [column for column in COLUMNS if column not in table]:
            raise UserError(f"{path}: rows of stress tests: expected a column {missing[0]}")
        if len(table) and set(table["method"]) != {name}:
            raise UserError(f"{path}: method: expected {name} alone, got {', '.join(sorted(set(table['method'])))}")
        tables.append(table)
    return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame(columns=COLUMNS)


def by_severity(rows: pd.DataFrame) -> pd.DataFrame:
    """Return ``summarise_stress`` of each method, a row a method, kind and severity."""
    tables = [
        pd.DataFrame(summarise_stress(group)).assign(method=name) for name, group in rows.groupby("method", sort=False)
    ]
    return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame(columns=["method", "kind", "severity"])


def readable_stress(rows: pd.DataFrame) -> pd.DataFrame:
    """Return success at the middle severity in words, and what share of the undisturbed rescues is kept.

    A row a condition, a column a method; of the undisturbed tests, the first row, success alone.
    """
    cells: dict[str, dict[str, str]] = {}
    for line in by_severity(rows).to_dict("records"):
        if line["severity"] in (NONE, SEVERITIES[1]):
            kept = "" if line["kind"] == NONE or pd.isna(line["kept"]) else f", {100 * line['kept']:.0f} % kept"
            cells.setdefault(METHODS[line["method"]].title, {})[_condition(line)] = _rate(line) + kept
    return pd.DataFrame(cells).fillna("").rename_axis("under")


def _condition(line: Mapping[Any, Any]) -> str:
    """Return kind and severity in words."""
    if line["kind"] in KINDS:
        return f"{KINDS[line['kind']].title}, {line['level']:g} {line['unit']}"
    return "nothing" if line["simulator"] == DEFAULT else f"nothing, in {line['simulator']}"


def simulators(rows: pd.DataFrame) -> tuple[pd.DataFrame, pd.DataFrame] | None:
    """Return a method's undisturbed rows in the usual simulator and in the other one; None without the latter."""
    first, second = (rows[rows["kind"] == kind].reset_index(drop=True) for kind in (NONE, OTHER))
    return (first, second) if len(second) else None


def simulator_rows(results: Path = RESULTS) -> pd.DataFrame:
    """Return each method's undisturbed rows in both simulators: of ``transfer/``, where it has more, or ``stress/``."""
    more, rows = stress_rows(results, "transfer"), stress_rows(results)
    return pd.concat([more, rows[~rows["method"].isin(set(more["method"]))]], ignore_index=True)


def transfer_table(first: pd.DataFrame, second: pd.DataFrame) -> pd.DataFrame:
    """Return what is lost and gained between two tests of the same scenes: in all, by task, attitude and posture.

    ``difference`` is that of the success rates, second less first, with the 95 % interval for pairs (``intervals``).

    Raises:
        UserError: Where the scenes are not the same.
    """
    if not same_scenes(first, second):
        raise UserError("transfer: expected two tests of the same scenes in the same order")
    table = [_lost_and_gained("all", "", first["success"], second["success"])]
    for name, columns in GROUPS.items():
        for values, group in first.groupby(columns):
            label = " ".join(map(str, values))
            table.append(_lost_and_gained(name, label, group["success"], second.loc[group.index, "success"]))
    return pd.DataFrame(table)


def transfers(rows: pd.DataFrame) -> pd.DataFrame:
    """Return ``transfer_table`` of each method that was tested in both simulators, without postures; may be empty."""
    tables = {}
    for name, group in rows.groupby("method", sort=False):
        if pair := simulators(group):
            table = transfer_table(*pair)
            tables[METHODS[str(name)].title] = table[table["by"] != "posture"].drop(columns="by").set_index("group")
    return pd.concat(tables, names=["method"]).round(3) if tables else pd.DataFrame()


def readable_transfers(rows: pd.DataFrame) -> pd.DataFrame:
    """Return success in both simulators and their difference in points with its interval; a column a method.

    The difference stands in all, by task and by how the body lies; the table is empty without a test in both.
    """
    columns: dict[str, dict[str, str]] = {}
    for line in transfers(rows).reset_index().to_dict("records"):
        cells, group = columns.setdefault(line["method"], {}), line["group"]
        if not group:
            cells.update({name: f"{100 * line[at] / line['tests']:.1f} %" for name, at in SIDES.items()})
        cells[f"difference, {group or 'all'}"] = in_points([line[key] for key in ("difference", "low", "high")])
    return pd.DataFrame(columns).fillna("")


def _lost_and_gained(by: str, group: str, first: pd.Series[Any], second: pd.Series[Any]) -> dict[str, Any]:
    before, after = first.to_numpy(bool), second.to_numpy(bool)
    difference, low, high = paired_difference(after, before)
    counts = {"tests": len(before), "first": int(before.sum()), "second": int(after.sum())}
    counts |= {"lost": int((before & ~after).sum()), "gained": int((after & ~before).sum())}
    return {"by": by, "group": group.replace("_", " "), **counts, "difference": difference, "low": low, "high": high}


def in_words(rows: pd.DataFrame) -> list[str]:
    """Return a sentence a method: success undisturbed, what it keeps least and most of, and in the other simulator."""
    sentences = []
    for name, group in rows.groupby("method", sort=False):
        lines = summarise_stress(group)
        plain = next(line for line in lines if line["kind"] == NONE)
        middle = sorted(
            (line for line in lines if line["severity"] == SEVERITIES[1]), key=lambda line: line["kept"] or 0.0
        )
        words = f"{METHODS[str(name)].title}: {_rate(plain)} of {plain['tests']} scenes undisturbed"
        if middle and plain["successes"]:
            words += f"; of these rescues, at the middle severity, least are kept under {_kept(middle[0])}"
            words += f", most under {_kept(middle[-1])}"
        for other in (line for line in lines if line["kind"] == OTHER):
            words += f"; in {other['simulator']} {_rate(other)}, {other['lost']} lost and {other['gained']} gained"
        sentences.append(f"{words}.")
    return sentences or [NO_STRESS]


def _rate(line: Mapping[Any, Any]) -> str:
    return f"{100 * line['success_rate']:.1f} %"


def _kept(line: dict[str, Any]) -> str:
    return f"{_condition(line)} ({100 * line['kept']:.0f} %)"


def agreement(results: Path = RESULTS) -> pd.DataFrame:
    """Return what became of the planner's plans in each simulator and setting, see ``agreement``; may be empty."""
    path = results / "agreement" / "summary.json"
    if not path.is_file():
        return pd.DataFrame()
    engines = pd.DataFrame(read_json(path, "agreement of the simulators")["engines"]).T
    columns = {
        "plans": "plans",
        "successes": "successes",
        "wilson_low": "low",
        "wilson_high": "high",
        "joints_before_contact_median_deg": "joints apart before contact [deg]",
        "parted": "bodies that part",
        "parted_after_steps_median": "after steps",
    }
    table = engines[list(columns)].rename(columns=columns).infer_objects().round(3)
    return table.astype(object).fillna("-")  # nothing parts in the simulator that the plans were made in
