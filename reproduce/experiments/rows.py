"""The rows of an evaluation, one a tested scene, and the summary that is computed from them and from nothing else."""

import csv
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import pandas as pd
from pydantic import AfterValidator, Field, FiniteFloat, NonNegativeInt, PositiveInt, TypeAdapter, ValidationError
from scipy.special import ndtri  # and nothing of scipy.stats, which takes every process a second to import
from typing_extensions import TypedDict

from lunar_rescue.scenes.postures import all_postures
from lunar_rescue.scenes.splits import split_of
from lunar_rescue.tasks import is_gentle
from reproduce.storage.errors import UserError
from reproduce.storage.files import is_stream, write_atomically

CONFIDENCE = 0.95

#: Columns of ``evaluation.csv``; an empty cell is None.
SceneRow = TypedDict(
    "SceneRow",
    {
        "seed": NonNegativeInt,  # of the scene
        "task": Literal["lift", "turn_over"],
        "posture": str,  # one of ``all_postures``
        "attitude": str,  # how the body lies: supine, prone, left_side or right_side
        "mass": Annotated[FiniteFloat, Field(gt=0)],  # of the suited astronaut [kg]
        "rocks": NonNegativeInt,  # number of rocks
        "terrain": Literal["smooth", "rough"],
        "success": bool,  # whether the astronaut was rescued
        "failure": str | None,  # a word that says why not; empty after a success
        "both_arms_under": bool,  # whether process 1 was completed
        "steps": PositiveInt,  # control steps until the end
        "return": FiniteFloat,  # sum of the environment's rewards, not discounted
        "nearest_mark": FiniteFloat | None,  # least distance of a joint to a mark point [m]; empty without rocks
        "peak_force": Annotated[FiniteFloat, Field(ge=0)],  # greatest of an arm on the body [N], mean of a step
        "peak_speed": Annotated[FiniteFloat, Field(ge=0)],  # greatest of the body [m/s]
        "peak_acceleration": Annotated[FiniteFloat, Field(ge=0)],  # greatest of the body [m/s^2], mean of a step
        "gentle": bool,  # whether the peaks are within what a person would stand (``lunar_rescue.tasks``)
    },
)
COLUMNS = tuple(SceneRow.__annotations__)


def _consistent(row: Mapping[str, Any]) -> Mapping[str, Any]:
    posture = all_postures().get(row["posture"])
    if posture is None or posture.attitude != row["attitude"]:
        raise ValueError(f"posture: expected a known one with its attitude, got {row['posture']}, {row['attitude']}")
    if row["success"] == (row["failure"] is not None):
        raise ValueError(f"failure: expected a word where success is False only, got {row['failure']!r}")
    if (row["rocks"] == 0) != (row["nearest_mark"] is None):
        raise ValueError(f"nearest_mark: expected a number where there are rocks only, got {row['nearest_mark']}")
    if row["gentle"] != is_gentle(row["peak_force"], row["peak_speed"], row["peak_acceleration"]):
        raise ValueError(f"gentle: expected what the peaks say, got {row['gentle']}")
    return row


_ROWS = TypeAdapter(list[Annotated[SceneRow, AfterValidator(_consistent)]])


def as_table(rows: pd.DataFrame | list[dict[str, Any]]) -> pd.DataFrame:
    """Return rows as a table with the columns of ``SceneRow``, in their order."""
    table = pd.DataFrame(rows, columns=list(COLUMNS))
    return table.astype({"failure": object, "nearest_mark": float})


def rows_path(summary: Path) -> Path | None:
    """Return where the rows of an evaluation lie, beside its summary; None where that is a device or a pipe.

    Raises:
        UserError: Where the summary's own name ends in .csv.
    """
    if summary.suffix == ".csv":
        raise UserError(f"{summary}: expected a name for the summary, NAME.json; rows of scenes go to NAME.csv")
    return None if is_stream(summary) else summary.with_suffix(".csv")


def write_rows(path: Path, rows: pd.DataFrame) -> None:
    """Write ``evaluation.csv`` atomically; numbers keep all their digits."""
    write_atomically(path, lambda temporary: rows.to_csv(temporary, index=False, lineterminator="\n"))


def fault_of_rows(path: Path, what: str, error: Exception) -> UserError:
    """Return the error, one line, for rows of ``what`` that are not valid (line and column) or not readable."""
    if not isinstance(error, ValidationError):
        return UserError(f"{path}: rows of {what}: not readable: {error}")
    index, *column = error.errors()[0]["loc"]
    where = ", ".join([f"line {int(index) + 2}", *map(str, column[:1])])
    return UserError(f"{path}: {where}: {error.errors()[0]['msg']}")


def read_rows(path: Path) -> pd.DataFrame:
    """Read and check ``evaluation.csv``.

    Raises:
        UserError: One line that names file, line and column of the first fault.
    """
    try:
        with path.open(encoding="utf-8", newline="") as file:
            raw = [{key: value or None for key, value in row.items()} for row in csv.DictReader(file, restkey="extra")]
        rows: list[Any] = _ROWS.validate_python(raw)
    except FileNotFoundError:
        raise UserError(f"{path}: rows of an evaluation: the file is missing") from None
    except (ValidationError, OSError, UnicodeDecodeError, csv.Error) as error:
        raise fault_of_rows(path, "an evaluation", error) from None
    seeds = [row["seed"] for row in rows]
    if not rows or seeds != list(range(seeds[0], seeds[0] + len(seeds))):
        raise UserError(f"{path}: seed: expected rows of consecutive scenes, each once and in order")
    return as_table(rows)


def wilson(successes: int, tests: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Return Wilson's interval of a success rate, 95 % unless told otherwise; (0, 1) without tests."""
    if not 0 <= successes <= tests:
        raise ValueError(f"wilson: expected 0 <= successes <= tests, got {successes} of {tests}")
    if tests == 0:
        return 0.0, 1.0
    p, z = successes / tests, float(ndtri(0.5 + 0.5 * confidence))
    whole = 2 * (tests + z**2)
    centre = (2 * tests * p + z**2) / whole
    half = z / whole * math.sqrt(4 * tests * p * (1 - p) + z**2)
    return (centre - half if successes else 0.0), (centre + half if successes < tests else 1.0)


def count_by(rows: pd.DataFrame, column: str, success: str = "success") -> dict[str, dict[str, int]]:
    """Return tests and successes by the values of a column; ``success`` is the column that is counted."""
    counts = rows.groupby(column)[success].agg(["size", "sum"])
    return {str(name): {"tests": int(size), "successes": int(total)} for name, size, total in counts.itertuples()}


def summarise(rows: pd.DataFrame) -> dict[str, Any]:
    """Return what ``evaluation.json`` says of the scenes, computed from their rows alone."""
    tests, successes, first = len(rows), int(rows["success"].sum()), int(rows["seed"].iloc[0])
    low, high = wilson(successes, tests)
    return {
        "first_seed": first,
        "split": split_of(first),
        "tests": tests,
        "successes": successes,
        "success_rate": successes / tests,
        "wilson_low": low,
        "wilson_high": high,
        "both_arms_under": float(rows["both_arms_under"].mean()),
        "gentle": float((rows["success"] & rows["gentle"]).mean()),  # of all tests, those rescued gently
        "by_task": count_by(rows, "task"),
        "by_posture": count_by(rows, "posture"),
        "failures": {str(word): int(count) for word, count in rows["failure"].value_counts().items()},
        "mean_return": float(rows["return"].mean()),
        "mean_steps": float(rows["steps"].mean()),
    }
