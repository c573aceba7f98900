"""Which command makes which item of the paper, for the README; minutes come from what was measured."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from reproduce.analysis.runs import reference_runs
from reproduce.experiments.workflow.plan import REPORT, TABLES, Plan
from reproduce.storage.paths import RESULTS


@dataclass(frozen=True)
class Item:
    """A row of the README's table.

    Attributes:
        what: Item of the paper.
        command: That makes it.
        output: Where it goes.
        minutes: How long that takes, in words, given ``timings.csv``.
    """

    what: str
    command: str
    output: str
    minutes: Callable[[pd.DataFrame], str]


def _of(*steps: str) -> Callable[[pd.DataFrame], str]:
    """Minutes of some steps of the batch that was timed."""

    def minutes(timings: pd.DataFrame) -> str:
        found = timings.loc[timings["step"].isin(steps), "seconds"]
        return _words(float(found.sum())) if len(found) == len(steps) else "not timed"

    return minutes


def _all(timings: pd.DataFrame) -> str:
    return f"{_words(float(timings['seconds'].sum()))}, one step after the other"


def _trainings(timings: pd.DataFrame) -> str:
    found = [f"{run.method} {run.minutes:.0f}" for run in reference_runs() if run.origin]
    return ", ".join(found) or "not timed"


def _tests(timings: pd.DataFrame) -> str:
    found = [run.evaluation["seconds"] for run in reference_runs() if run.origin and run.evaluation]
    return _words(max(found)) + " a policy at most" if found else "not timed"


def _words(seconds: float) -> str:
    return f"{seconds / 60:.1f}"


def items(plan: Plan) -> list[Item]:
    """All rows; outputs and steps are the workflow's."""
    notebook = {name[:2]: (f"notebooks/{name}.ipynb", f"notebook {name}") for name in plan.notebooks}

    def shown(number: str, what: str) -> Item:
        output, step = notebook[number]
        return Item(what, f"reproduce notebooks --only {number} --no-report", output, _of(step))

    return [
        shown("01", "MOMDP, Eq. 1, 20 postures (P1, P2, P8)"),
        shown("02", "Eq. 2 and AAPF, Fig. 2 (P5)"),
        shown("03", "SGN and LLN, settings, Fig. 3 and 4 (P3, P4, P9)"),
        Item(
            "the methods of Table 1, trained",
            "reproduce train METHOD --preset laptop --seed K --out results/reference/METHOD/seedK",
            "reference/METHOD/seedK/run.json",
            _trainings,
        ),
        Item(
            "their 1000 tests",
            "reproduce evaluate RUN --tests 1000 --json RUN/evaluation.json",
            "reference/METHOD/seedK/evaluation.json",
            _tests,
        ),
        Item("Table 1", "reproduce table1", TABLES[0], _of("tables")),
        shown("04", "comparison, Fig. 5 and 6"),
        shown("05", "ablation without AAPF"),
        Item("claims C1 to C8", "reproduce claims", TABLES[1], _of("tables")),
        shown("06", "claims C1 to C8 with their rules"),
        Item("the report", "reproduce report", REPORT, _of("report")),
        Item("all of it, in short form", "reproduce batch --preset smoke", f"batch/smoke/{REPORT}", _all),
    ]


def timings(results: Path = RESULTS) -> pd.DataFrame:
    """Seconds by step of the smoke batch that was timed last, empty without one."""
    path = results / "timings.csv"
    return pd.read_csv(path) if path.is_file() else pd.DataFrame({"step": [], "seconds": []})
