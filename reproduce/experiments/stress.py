"""The reality gap: one policy on the same scenes undisturbed, under every disturbance, and in the other simulator (C8).

What a severity is of each kind stands in ``lunar_rescue.disturbances``. A row is a rescue; whatever happens in it
follows from the scene's seed, the kind and the severity. The planner plans each scene as it is known, in PyBullet, and
does so without looking, in either simulator.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from lunar_rescue import sample_scene
from lunar_rescue.disturbances import KINDS, NOTHING, SEVERITIES, disturbance
from lunar_rescue.disturbed import DisturbedEnv
from lunar_rescue.physics.engines import DEFAULT, SIMULATORS
from lunar_rescue.scenes.splits import split_of
from reproduce.experiments.evaluate import find_policy, run_episode
from reproduce.experiments.pool import map_scenes, scene_seeds
from reproduce.experiments.rows import wilson
from reproduce.storage.errors import UserError
from reproduce.storage.files import check_writable, locked, write_json
from reproduce.storage.paths import RESULTS
from reproduce.storage.provenance import provenance, write_table

FOLDER = RESULTS / "stress"
TRANSFER = RESULTS / "transfer"  # the same without a disturbance, on more scenes: the two simulators alone
NONE, OTHER = "none", "simulator"  # the kinds that disturb nothing: as always, and in another simulator
COLUMNS = ["method", "kind", "severity", "seed", "task", "posture", "attitude", "success", "failure", "simulator"]
MORE = ["both_arms_under", "steps", "gentle"]  # further columns of the rows
CHUNK = 775  # rescues after which the files are written, rounded to whole scenes, of which an interruption leaves some
_STATE: dict[str, Any] = {}


class Condition(NamedTuple):
    """What one rescue of each scene is done under."""

    kind: str  # of ``KINDS``, ``NONE`` or ``OTHER``
    severity: str  # of ``SEVERITIES``, or ``NONE`` for those two
    simulator: str


def known_kinds(names: Sequence[str] | None) -> tuple[str, ...]:
    """Return the kinds of these names, in their order in ``KINDS``: all without names, no kind of ``["none"]``.

    Raises:
        UserError: On a kind that is not there.
    """
    if unknown := [name for name in names or () if name not in (*KINDS, NONE)]:
        raise UserError(f"--kinds: expected {NONE}, or some of {', '.join(KINDS)}; got {unknown[0]!r}")
    return tuple(name for name in KINDS if not names or name in names)


def conditions(kinds: tuple[str, ...] = tuple(KINDS)) -> list[Condition]:
    """Return what each scene is done under: as always, each kind's severities, every other simulator that is there."""
    others = [name for name in SIMULATORS if name != DEFAULT and find_spec(name)]
    return [
        Condition(NONE, NONE, DEFAULT),
        *(Condition(kind, severity, DEFAULT) for kind in kinds for severity in SEVERITIES),
        *(Condition(OTHER, NONE, name) for name in others),
    ]


def _prepare(where: str, simulators: tuple[str, ...]) -> None:
    import torch as th

    th.set_num_threads(1)
    method, _STATE["policy"] = find_policy(where)
    _STATE["method"] = method.name
    _STATE["environments"] = {name: DisturbedEnv(simulator=name) for name in simulators}


def _test(seed: int, tried: tuple[Condition, ...]) -> list[dict[str, Any]]:
    """Act one scene out under each condition and return a row each."""
    scene, policy, rows = sample_scene(seed), _STATE["policy"], []
    for condition in tried:
        disturbed = condition.severity in SEVERITIES
        what = disturbance(scene, condition.kind, condition.severity) if disturbed else NOTHING
        row = run_episode(_STATE["environments"][condition.simulator], policy, scene, disturbance=what)
        rows.append({"method": _STATE["method"], **row, **condition._asdict()})
    return rows


def summarise_stress(rows: pd.DataFrame) -> list[dict[str, Any]]:
    """Return success by kind and severity: tests, successes, rate with Wilson's interval, what is lost and gained.

    ``kept`` is the share of the undisturbed rescues that are rescues still, None where there were none. The order is
    that of the rows.
    """
    plain = rows[rows["kind"] == NONE].set_index("seed")["success"]
    table = []
    for (kind, severity, simulator), group in rows.groupby(["kind", "severity", "simulator"], sort=False):
        success = group.set_index("seed")["success"]
        before = plain.reindex(success.index)
        tests, count = len(success), int(success.sum())
        low, high = wilson(count, tests)
        known = KINDS.get(str(kind))
        table.append(
            {
                **{"kind": kind, "severity": severity, "simulator": simulator},
                "level": known.levels[SEVERITIES.index(str(severity))] if known else None,
                "unit": known.unit if known else None,
                **{"tests": tests, "successes": count, "success_rate": count / tests},
                **{"wilson_low": low, "wilson_high": high},
                "lost": int((before & ~success).sum()),
                "gained": int((~before & success).sum()),
                "kept": float((before & success).sum() / before.sum()) if before.any() else None,
                "failures": {str(word): int(n) for word, n in group["failure"].value_counts().items()},
            }
        )
    return table


def stress(
    where: str | Path,
    tests: int,
    first_seed: int,
    *,
    folder: Path = FOLDER,
    json: Path | None = None,
    kinds: tuple[str, ...] = tuple(KINDS),
    tell: Callable[[str], object] = print,
    quiet: bool = False,
) -> dict[str, Any]:
    """Test a policy on ``tests`` scenes under every condition; write rows and summary to ``folder``.

    ``where`` is a run folder or a method that does not learn. The files are ``METHOD.csv``, a row a rescue, and
    ``METHOD.json``, which also goes to ``json``; ``kinds`` are those to try. Returns the summary, and calls ``tell``
    with its lines.

    Raises:
        UserError: On numbers out of range, a run folder that does not load, or a place that cannot be written.
    """
    seeds, name, tried = scene_seeds(tests, first_seed), find_policy(where)[0].name, tuple(conditions(kinds))
    table, summary_path = folder / f"{name}.csv", folder / f"{name}.json"
    for path in (table, summary_path, json):
        if path:
            check_writable(path)
    with locked(folder, "stress tests"):
        size = max(1, CHUNK // len(tried))
        parts = [seeds[start : start + size] for start in range(0, tests, size)]
        done: list[pd.DataFrame] = []
        for part in parts:
            done.append(_measure(where, part, tried, name, quiet))
            summary = _write(pd.concat(done), table, (summary_path, json))
    _print(summary["conditions"], tell)
    if all(condition.simulator == DEFAULT for condition in tried):
        tell("no other simulator is installed: pip install 'lunar-rescue[mujoco]'")
    return summary


def _measure(where: str | Path, seeds: range, tried: tuple[Condition, ...], name: str, quiet: bool) -> pd.DataFrame:
    """Return the rows of some scenes."""
    simulators = tuple(dict.fromkeys(condition.simulator for condition in tried))
    job, title = partial(_test, tried=tried), f"stress {name}"
    nested = map_scenes(job, seeds, _prepare, (str(where), simulators), title=title, quiet=quiet)
    return pd.DataFrame([row for scene in nested for row in scene], columns=[*COLUMNS, *MORE])


def _write(rows: pd.DataFrame, table: Path, summaries: tuple[Path | None, ...]) -> dict[str, Any]:
    """Write the rows and their summary, and return that."""
    first, tests = int(rows["seed"].min()), rows["seed"].nunique()
    summary = {"method": rows["method"].iloc[0], "first_seed": first, "split": split_of(first), "tests": tests}
    summary |= {"conditions": summarise_stress(rows), "origin": provenance()}
    write_table(table, rows)
    for path in filter(None, summaries):
        write_json(path, summary)
    return summary


def _print(table: list[dict[str, Any]], tell: Callable[[str], object]) -> None:
    for row in table:
        what = (
            row["kind"] if row["level"] is None else f"{row['kind']} {row['severity']} ({row['level']:g} {row['unit']})"
        )
        rate, low, high = (100 * row[key] for key in ("success_rate", "wilson_low", "wilson_high"))
        tell(f"{what}: {row['successes']} of {row['tests']}, {rate:.1f} % [{low:.1f}, {high:.1f}]")
