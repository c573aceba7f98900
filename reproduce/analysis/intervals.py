"""Compute intervals of means and of differences, and tell which tests are pairs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy.stats import norm, ttest_1samp

from reproduce.experiments.rows import CONFIDENCE


def same_scenes(first: pd.DataFrame | None, second: pd.DataFrame | None) -> bool:
    """Return whether two evaluations' rows are of the same scenes, so that their tests are pairs."""
    return first is not None and second is not None and list(first["seed"]) == list(second["seed"])


def paired_difference(first: ArrayLike, second: ArrayLike) -> tuple[float, float, float]:
    """Return the difference of two success rates on the same scenes, with its 95 % interval.

    Wald's interval for paired proportions with half a test added to each of the four cells, which keeps its level for
    few tests and rates near 0 or 1 (Agresti and Min, Statistics in Medicine 24, 2005). ``first`` and ``second`` say
    whether each scene ended in a rescue, (tests,) of booleans in the same order; anything else is a ``ValueError``.
    """
    ours, theirs = np.asarray(first), np.asarray(second)
    if ours.shape != theirs.shape or not ours.size or ours.dtype != bool or theirs.dtype != bool:
        raise ValueError(f"paired_difference: expected outcomes of the same tests, got {ours.shape} and {theirs.shape}")
    tests, better, worse = ours.size, int((ours & ~theirs).sum()), int((theirs & ~ours).sum())
    p, q = (better + 0.5) / (tests + 2), (worse + 0.5) / (tests + 2)
    half = float(norm.ppf(0.5 + CONFIDENCE / 2)) * ((p + q - (p - q) ** 2) / (tests + 2)) ** 0.5
    return (better - worse) / tests, max(-1.0, p - q - half), min(1.0, p - q + half)


def mean_interval(values: Sequence[float] | pd.Series[float]) -> tuple[float, float, float]:
    """Return the mean of two or more values with Student's 95 % interval; of differences of pairs a paired t-test's."""
    if len(values) < 2:
        raise ValueError(f"mean_interval: expected two values at least, got {len(values)}")
    interval = ttest_1samp(values, 0.0).confidence_interval(CONFIDENCE)
    return float(np.mean(values)), float(interval.low), float(interval.high)
