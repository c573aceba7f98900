"""Put the trainings of a method together: their tests, the returns that they end with and how fast they converge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from pathlib import Path

import pandas as pd

from reproduce.analysis.intervals import mean_interval
from reproduce.analysis.runs import Run, reference_runs
from reproduce.experiments.rows import wilson

CONVERGED = 0.9  # share of the way up
SMOOTHING = 20  # updates in a running mean
MARGIN = 0.05  # of the larger: what returns or steps must differ by


@dataclass(frozen=True)
class Pool:
    """The evaluated trainings of a method together."""

    method: str
    runs: tuple[Run, ...]

    @cached_property
    def rows(self) -> pd.DataFrame:
        """Return the tests of all trainings, with the column ``training`` beside those of ``SceneRow``."""
        tables = {run.seed: run.rows() for run in self.runs}
        return pd.concat(tables, names=["training"]).reset_index("training")

    @property
    def rates(self) -> pd.Series[float]:
        """Return the success rate of each training."""
        return self.rows.groupby("training")["success"].mean()

    @property
    def interval(self) -> tuple[float, float]:
        """Return Wilson's interval of all tests; for several trainings Student's of their rates where it is wider."""
        groups = self.rows.groupby("training")["success"]
        return pooled_interval(list(zip(groups.sum(), groups.size(), strict=True)))

    @property
    def env_steps(self) -> int:
        """Return the environment steps of the shortest training."""
        return min(run.env_steps for run in self.runs)

    @property
    def returns(self) -> list[float]:
        """Return each training's return in the end; trainings without a curve are left out."""
        return [final_return(curve) for run in self.runs if (curve := run.curve()) is not None]

    @property
    def steps(self) -> list[float | None]:
        """Return each training's environment steps to converge, None where it has not."""
        return [steps_to_converge(curve) for run in self.runs if (curve := run.curve()) is not None]

    def words(self) -> str:
        """Return the success rate with its interval in words."""
        return f"{self.method} {percent(self.rows['success'].mean(), self.interval)}"


def pooled_interval(counts: Sequence[tuple[int, int]]) -> tuple[float, float]:
    """Return an interval of successes and tests of one training or more: see ``Pool.interval``."""
    successes, tests = (sum(column) for column in zip(*counts, strict=True))
    low, high = wilson(int(successes), int(tests))
    if len(counts) > 1:
        _, lower, higher = mean_interval([part / whole for part, whole in counts])
        low, high = max(0.0, min(low, lower)), min(1.0, max(high, higher))
    return low, high


def percent(rate: float, interval: tuple[float, float]) -> str:
    """Return a rate and its interval in words."""
    low, high = interval
    return f"{100 * rate:.1f} % [{100 * low:.1f}, {100 * high:.1f}]"


def read_pools(results: Path) -> dict[str, Pool]:
    """Return the evaluated runs of each method."""
    runs = (run for run in reference_runs(results) if run.evaluation)
    return {method: Pool(method, tuple(group)) for method, group in groupby(runs, key=lambda run: run.method)}


def smooth(values: pd.Series[float]) -> pd.Series[float]:
    """Return the running mean over the last ``SMOOTHING`` updates."""
    return values.rolling(SMOOTHING, min_periods=1).mean()


def final_return(curve: pd.DataFrame) -> float:
    """Return the mean return over the last twentieth of the updates."""
    return float(curve["return_high"].tail(max(1, len(curve) // 20)).mean())


def steps_to_converge(curve: pd.DataFrame) -> float | None:
    """Return environment steps until the smoothed return has come 90 % of its way up; None where it did not rise."""
    means = smooth(curve["return_high"])
    first, last = float(means.iloc[0]), final_return(curve)
    spread = float(curve["return_high"].tail(max(2, len(curve) // 20)).std())
    if not last - first > max(MARGIN * max(abs(first), abs(last)), spread):
        return None
    beyond = curve["env_steps"][means - first >= CONVERGED * (last - first)]
    return float(beyond.iloc[0] if len(beyond) else curve["env_steps"].iloc[-1])
