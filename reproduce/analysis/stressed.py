"""Read how a policy does in another simulator and under disturbances: ``results/stress/METHOD.csv``, a row a test."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any, Literal

import pandas as pd
from pydantic import NonNegativeInt, TypeAdapter, ValidationError
from typing_extensions import TypedDict

from reproduce.experiments.rows import fault_of_rows
from reproduce.storage.errors import UserError

UNDISTURBED, MIDDLE = "none", "middle"
ENGINE, OTHER_ENGINE = "pybullet", "mujoco"


class StressRow(TypedDict):
    """Columns of ``stress/METHOD.csv`` that verdicts need; there may be more."""

    method: str  # as the file is named
    kind: str  # what is wrong, such as a delay
    severity: Literal["none", "low", "middle", "high"]
    seed: NonNegativeInt  # of the scene
    success: bool  # whether the astronaut was rescued
    simulator: Literal["pybullet", "mujoco"]


_ROWS = TypeAdapter(list[StressRow])


def read_stress(path: Path) -> pd.DataFrame | None:
    """Read and check the rows of one method, or return None where there are none.

    Raises:
        UserError: One line that names file, line and column of the first fault, or the scenes that are not the same.
    """
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows: list[Any] = _ROWS.validate_python(list(csv.DictReader(file)))
    except FileNotFoundError:
        return None
    except (ValidationError, OSError, UnicodeDecodeError, csv.Error) as error:
        raise fault_of_rows(path, "disturbed tests", error) from None
    if others := sorted({row["method"] for row in rows} - {path.stem}):
        raise UserError(f"{path}: method: expected {path.stem}, got {others[0]}")
    return pd.DataFrame(rows, columns=list(StressRow.__annotations__))


def conditions(rows: pd.DataFrame) -> tuple[pd.Series[bool], dict[str, pd.Series[bool]]] | None:
    """Return success by scene without disturbance, and in each condition that C8 names; None where one is not there.

    The conditions are the other engine, undisturbed, and every kind of disturbance at its middle severity. All must be
    of the scenes of the undisturbed tests, each once, else it is a ``UserError``.
    """
    rows = rows.assign(other=rows["simulator"] == OTHER_ENGINE)
    # The other engine may be told as a disturbance of its own; it has no severity then that would matter.
    other = rows[rows["other"]]
    plain, middle = (rows[~rows["other"] & (rows["severity"] == severity)] for severity in (UNDISTURBED, MIDDLE))
    if plain.empty or other.empty or middle.empty:
        return None
    plain = plain.drop_duplicates(["seed", "success"])  # one series may be repeated for each kind
    severities = [level for level in (UNDISTURBED, MIDDLE, *other["severity"]) if level in set(other["severity"])]
    groups = {OTHER_ENGINE: other[other["severity"] == severities[0]]}
    groups |= {str(kind): group for kind, group in middle.groupby("kind")}
    before = plain.set_index("seed")["success"].sort_index()
    after = {name: group.set_index("seed")["success"].sort_index() for name, group in groups.items()}
    for name, success in after.items():
        if not success.index.is_unique or not success.index.equals(before.index):
            raise UserError(f"stress: {name}: expected the {len(before)} scenes of the undisturbed tests, each once")
    return before, after
