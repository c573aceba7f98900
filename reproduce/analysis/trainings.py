"""Put the trainings of a method together: their tests, the returns that they end with and how fast they succeed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from reproduce.analysis.intervals import Outcomes, success_interval
from reproduce.analysis.runs import Run, reference_runs
from reproduce.storage.errors import UserError
from reproduce.storage.paths import RESULTS

SMOOTHING = 20  # updates in a running mean
LEVELS = (0.5, 0.8, 0.9)  # success while training, fixed before any run: a share of one's own plateau rewards low ones


@dataclass(frozen=True)
class Pool:
    """The trainings of a method that one evaluation tested."""

    method: str
    runs: tuple[Run, ...]
    name: str = "evaluation"  # of the evaluation

    def __post_init__(self) -> None:
        tests = [list(rows["seed"]) for rows in self._tables.values()]
        if any(seeds != tests[0] for seeds in tests):
            sizes = ", ".join(str(len(seeds)) for seeds in tests)
            raise UserError(
                f"{self.method}: {self.name}: expected the same scenes for all trainings, got {sizes} tests"
            )

    @cached_property
    def _tables(self) -> dict[int, pd.DataFrame]:
        return {run.seed: rows for run in self.runs if (rows := run.rows(self.name)) is not None}

    @cached_property
    def rows(self) -> pd.DataFrame:
        """Return the tests of all trainings, with the column ``training`` beside those of ``SceneRow``."""
        return pd.concat(self._tables, names=["training"]).reset_index("training")

    @cached_property
    def outcomes(self) -> Outcomes:
        """Return whether each training rescued in each scene, (trainings, scenes)."""
        return np.stack([rows["success"].to_numpy(dtype=bool) for rows in self._tables.values()])

    @property
    def scenes(self) -> list[int]:
        """Return the seeds of the scenes, which all trainings met."""
        return list(self._tables[self.runs[0].seed]["seed"])

    @property
    def rates(self) -> list[float]:
        """Return the success rate of each training."""
        return [float(rate) for rate in self.outcomes.mean(axis=1)]

    @property
    def success(self) -> tuple[float, float, float]:
        """Return the success rate with its 95 % interval: of new trainings, or for a single one Wilson's."""
        return success_interval(self.outcomes)

    @property
    def interval(self) -> tuple[float, float]:
        """Return the ends of the interval of the success rate."""
        return self.success[1:]

    @property
    def results(self) -> Path:
        """Return the results folder that its runs lie in."""
        return self.runs[0].folder.parents[2]

    def values(self, column: str) -> NDArray[np.float64]:
        """Return a column of numbers of the rows, (trainings, scenes); an empty cell is NaN."""
        return np.stack([rows[column].to_numpy(dtype=float) for rows in self._tables.values()])

    @property
    def env_steps(self) -> int:
        """Return the environment steps of the shortest training."""
        return min(run.env_steps for run in self.runs)

    @cached_property
    def curves(self) -> list[pd.DataFrame]:
        """Return the learning curves of those trainings that have one."""
        return [curve for run in self.runs if (curve := run.curve()) is not None]

    @property
    def returns(self) -> list[float]:
        """Return each training's return in the end; trainings without a curve are left out."""
        return [final_return(curve) for curve in self.curves]

    @property
    def rate_words(self) -> str:
        """Return the success rate with its interval in words."""
        return percent(self.success[0], self.interval)

    def words(self) -> str:
        """Return method, success rate with its interval, and every training's, in words."""
        each = ", ".join(f"{100 * rate:.1f}" for rate in self.rates)
        return f"{self.method} {self.rate_words}" + (f" ({each})" if len(self.runs) > 1 else "")


def percent(rate: float, interval: tuple[float, float]) -> str:
    """Return a rate and its interval in words."""
    low, high = interval
    return f"{100 * rate:.1f} % [{100 * low:.1f}, {100 * high:.1f}]"


def read_pools(results: Path = RESULTS, name: str = "evaluation") -> dict[str, Pool]:
    """Return the runs of each method that an evaluation tested; trainings of other scenes are a ``UserError``."""
    runs = (run for run in reference_runs(results) if run.summary(name))
    return {method: Pool(method, tuple(group), name) for method, group in groupby(runs, key=lambda run: run.method)}


def smooth(values: pd.Series[float]) -> pd.Series[float]:
    """Return the running mean over the last ``SMOOTHING`` updates."""
    return values.rolling(SMOOTHING, min_periods=1).mean()


def final_return(curve: pd.DataFrame) -> float:
    """Return the mean return over the last twentieth of the updates."""
    return float(curve["return_high"].tail(max(1, len(curve) // 20)).mean())


def steps_to(curve: pd.DataFrame, level: float) -> float:
    """Return environment steps until success while training reaches a level; inf if it never does.

    It is a mean of 20 updates, those in which no episode ended left out.
    """
    told = curve[["env_steps", "success"]].dropna()
    reached = told["env_steps"][told["success"].rolling(SMOOTHING).mean() >= level]
    return float(reached.iloc[0]) if len(reached) else float("inf")


def horizon(pools: Sequence[Pool]) -> float:
    """Return the environment steps that every training of some methods has taken."""
    return float(min(curve["env_steps"].iloc[-1] for pool in pools for curve in pool.curves))


def restricted_steps(pool: Pool, most: float) -> NDArray[np.float64]:
    """Return steps to each level of success, ``most`` where one is not reached by then, (trainings, levels).

    Their mean over trainings is the restricted mean: it is defined where some never get there, and none is left out.
    """
    return np.array([[min(steps_to(curve, level), most) for level in LEVELS] for curve in pool.curves])
