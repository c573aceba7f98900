"""Compute intervals: of a method's success, of two methods' difference, of ratios and of what is kept.

An interval for a method speaks of new trainings on new scenes. All trainings meet the same scenes, so that a mean has
two sources of chance, crossed: which trainings were drawn and which scenes. Their variances add, each with its own
degrees of freedom (Welch and Satterthwaite); what one training does on one scene by chance stands in both and is taken
off once (Cameron, Gelbach and Miller, Journal of Business and Economic Statistics 29, 2011).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from scipy.special import expit, logit, ndtri, stdtrit  # and nothing of scipy.stats, which takes a second to import

from reproduce.experiments.rows import CONFIDENCE, wilson

Outcomes = NDArray[np.bool_]  # (trainings, scenes), whether a rescue succeeded
Values = NDArray[np.float64]
Interval = tuple[float, float, float]  # estimate, lower and upper end


def in_points(interval: Sequence[float]) -> str:
    """Return a difference of rates with the ends of its interval in percentage points, as tables and verdicts do."""
    return "{:+.1f} [{:+.1f}, {:+.1f}]".format(*(100 * value for value in interval))


def same_scenes(first: pd.DataFrame | None, second: pd.DataFrame | None) -> bool:
    """Return whether two evaluations' rows are of the same scenes, so that their tests are pairs."""
    return first is not None and second is not None and list(first["seed"]) == list(second["seed"])


def success_interval(outcomes: Outcomes, confidence: float = CONFIDENCE) -> Interval:
    """Return a method's success rate with its interval over trainings and scenes.

    Student's t over the trainings' log-odds (half a test added to successes and to failures), about the log-odds of
    the mean rate: rates near 1 are skewed, and a draw without a bad training would show too little spread. The part of
    the scenes is added. One training, and tests that all end alike, have Wilson's interval of the scenes.

    Args:
        outcomes: (trainings, scenes); all trainings met the same scenes.
        confidence: Level of the interval, both sides together.

    Raises:
        ValueError: Where there is no training or no scene.
    """
    rate, scenes = float(_checked(outcomes).mean()), outcomes.shape[1]
    if len(outcomes) == 1 or rate in (0.0, 1.0):
        return rate, *wilson(round(rate * scenes), scenes, confidence)
    least = rate * (1.0 - rate) / outcomes.size - _variance(outcomes.mean(axis=1))  # single tests' chance has as much
    by_scene = max(_variance(outcomes.mean(axis=0)) - _residual(outcomes), least, 0.0) / (rate * (1.0 - rate)) ** 2
    by_training = _odds_variance(outcomes)
    quantile = _quantile([(by_training, len(outcomes) - 1), (by_scene, scenes - 1)], confidence)
    return rate, *_about(rate, quantile * (by_training + by_scene) ** 0.5)


def success_difference(first: Outcomes, second: Outcomes, confidence: float = CONFIDENCE) -> Interval:
    """Return how much more often the first method succeeds, with its interval over trainings and scenes.

    Welch's t over the trainings of the paired difference: both met the same scenes, whose difficulty so falls out, and
    what is left of it, scenes that suit one of the two, is added. Each method's part is as uneven as its rate's
    interval, and squares of parts are added on either side (Zou and Donner, Statistics in Medicine 27, 2008). A method
    with one training adds nothing for its trainings, which is right for one that does not learn. Where no test tells
    anything apart it is the interval of pairs of one training each.

    Args:
        first: (trainings, scenes).
        second: (trainings of its own, scenes), the same scenes in the same order.
        confidence: Level of the interval, both sides together.

    Raises:
        ValueError: Where there is no training or no scene, or scenes differ in number.
    """
    if _checked(first).shape[1] != _checked(second).shape[1]:
        raise ValueError(f"success_difference: expected the same scenes, got {first.shape[1]} and {second.shape[1]}")
    by_scene = first.mean(axis=0) - second.mean(axis=0)
    scenes = max(_variance(by_scene) - _residual(first) - _residual(second), 0.0)
    parts = [(_variance(each.mean(axis=1)), len(each) - 1) for each in (first, second)]
    quantile = _quantile([*parts, (scenes, len(by_scene) - 1)], confidence)
    if quantile == 0.0:
        return paired_difference(first[0], second[0], confidence)
    value, square = float(by_scene.mean()), quantile**2 * scenes
    (below, above), (less, more) = (_reach(each, quantile) for each in (first, second))
    low, high = value - (below**2 + more**2 + square) ** 0.5, value + (above**2 + less**2 + square) ** 0.5
    return value, max(-1.0, low), min(1.0, high)


def crossed_interval(values: Values, minus: Values | None = None, confidence: float = CONFIDENCE) -> Interval:
    """Return the mean of a measurement over trainings and scenes, less another method's on the same scenes.

    As ``success_difference`` for numbers without bounds, such as distances: (trainings, scenes), each finite.
    """
    sides = [values] if minus is None else [values, minus]
    if len({side.shape[-1] for side in sides}) > 1 or not all(side.size and np.isfinite(side).all() for side in sides):
        raise ValueError(f"crossed_interval: expected numbers of the same scenes, got {[s.shape for s in sides]}")
    by_scene = sides[0].mean(axis=0) - (0.0 if minus is None else minus.mean(axis=0))
    scenes = max(_variance(by_scene) - sum(map(_residual, sides)), 0.0)
    parts = [(_variance(side.mean(axis=1)), len(side) - 1) for side in sides]
    value, half = float(by_scene.mean()), _half_width([*parts, (scenes, len(by_scene) - 1)], confidence)
    return value, value - half, value + half


def difference_of_means(first: ArrayLike, second: ArrayLike, confidence: float = CONFIDENCE) -> Interval:
    """Return the difference of two means of trainings with Welch's interval; each side needs two trainings."""
    (ours, by_ours), (theirs, by_theirs) = _mean(first), _mean(second)
    value, half = ours - theirs, _half_width([by_ours, by_theirs], confidence)
    return value, value - half, value + half


def ratio_of_means(first: ArrayLike, second: ArrayLike, confidence: float = CONFIDENCE) -> Interval:
    """Return the ratio of two means of positive numbers of trainings with Welch's interval on the log scale."""
    (ours, by_ours), (theirs, by_theirs) = _mean(first), _mean(second)
    if not (ours > 0.0 and theirs > 0.0):
        raise ValueError(f"ratio_of_means: expected positive means, got {ours} and {theirs}")
    parts = [(variance / mean**2, free) for mean, (variance, free) in ((ours, by_ours), (theirs, by_theirs))]
    half = _half_width(parts, confidence)
    return ours / theirs, float(ours / theirs * np.exp(-half)), float(ours / theirs * np.exp(half))


def kept_share(before: ArrayLike, after: ArrayLike, confidence: float = CONFIDENCE) -> Interval:
    """Return which share of its success a policy keeps on the same scenes, with its interval.

    The ratio of paired proportions on the log scale, half a test added to each; ``before`` and ``after`` are (scenes,)
    of booleans in the same order. A policy that never succeeded before keeps nothing that could be told: ValueError.
    """
    ours, theirs = _pair("kept_share", before, after)
    if not ours.any():
        raise ValueError("kept_share: expected successes before, got none")
    old, new, apart = ours.sum() + 0.5, theirs.sum() + 0.5, (ours != theirs).sum() + 1.0
    half = float(ndtri(0.5 + confidence / 2)) * (apart / (old * new)) ** 0.5
    return float(theirs.sum() / ours.sum()), float(new / old * np.exp(-half)), float(new / old * np.exp(half))


def paired_difference(first: ArrayLike, second: ArrayLike, confidence: float = CONFIDENCE) -> Interval:
    """Return the difference of two policies' success rates on the same scenes, with its interval.

    Wald's interval for paired proportions with half a test added to each of the four cells, which keeps its level for
    few tests and rates near 0 or 1 (Agresti and Min, Statistics in Medicine 24, 2005). ``first`` and ``second`` say
    whether each scene ended in a rescue, (tests,) of booleans in the same order; anything else is a ``ValueError``. It
    speaks of one training each and of no other.
    """
    ours, theirs = _pair("paired_difference", first, second)
    tests, better, worse = ours.size, int((ours & ~theirs).sum()), int((theirs & ~ours).sum())
    p, q = (better + 0.5) / (tests + 2), (worse + 0.5) / (tests + 2)
    half = float(ndtri(0.5 + confidence / 2)) * ((p + q - (p - q) ** 2) / (tests + 2)) ** 0.5
    return (better - worse) / tests, max(-1.0, p - q - half), min(1.0, p - q + half)


# -- parts of variances ------------------------------------------------------------------------------------------------
def _quantile(parts: Sequence[tuple[float, int]], confidence: float) -> float:
    """Return Student's quantile for a sum of parts' variances, each with its degrees of freedom (Satterthwaite).

    It is 0 where nothing varies.
    """
    parts = [(variance, degrees) for variance, degrees in parts if variance > 0.0]
    total = sum(variance for variance, _ in parts)
    free = total**2 / sum(variance**2 / degrees for variance, degrees in parts) if parts else 1.0
    return float(stdtrit(free, 0.5 + confidence / 2)) if parts else 0.0


def _half_width(parts: Sequence[tuple[float, int]], confidence: float) -> float:
    return _quantile(parts, confidence) * sum(variance for variance, _ in parts) ** 0.5


def _odds_variance(outcomes: Outcomes) -> float:
    """Return the variance of the mean of trainings' log-odds, half a test added to successes and to failures."""
    wins, scenes = outcomes.sum(axis=1), outcomes.shape[1]
    return _variance(np.log((wins + 0.5) / (scenes - wins + 0.5)))


def _about(rate: float, half: float) -> tuple[float, float]:
    """Return the ends of an interval whose half width is told in log-odds, about those of a rate."""
    low, high = expit(logit(rate) + np.array([-half, half]))
    return float(low), float(high)


def _reach(outcomes: Outcomes, quantile: float) -> tuple[float, float]:
    """Return how far below and above the rate its interval over trainings goes."""
    rate = float(outcomes.mean())
    low, high = _about(rate, quantile * _odds_variance(outcomes) ** 0.5)
    return rate - low, high - rate


def _variance(values: NDArray[np.float64]) -> float:
    """Return the variance of a mean of independent values; of a single one it is 0."""
    return float(values.var(ddof=1) / len(values)) if len(values) > 1 else 0.0


def _residual(outcomes: Outcomes | Values) -> float:
    """Return what a mean varies by for what one training does on one scene by chance; 0 where one cannot tell."""
    trainings, scenes = outcomes.shape
    if min(trainings, scenes) < 2:
        return 0.0
    rates = outcomes.mean(axis=1, keepdims=True), outcomes.mean(axis=0, keepdims=True)
    left = outcomes - rates[0] - rates[1] + outcomes.mean()
    return float((left**2).sum() / ((trainings - 1) * (scenes - 1)) / outcomes.size)


def _mean(values: ArrayLike) -> tuple[float, tuple[float, int]]:
    """Return the mean of two or more trainings' values, and its variance with degrees of freedom."""
    array = np.asarray(values, dtype=float)
    if array.ndim != 1 or len(array) < 2 or not np.isfinite(array).all():
        raise ValueError(f"expected finite values of two trainings at least, got {array}")
    return float(array.mean()), (_variance(array), len(array) - 1)


def _checked(outcomes: Outcomes) -> Outcomes:
    if outcomes.ndim != 2 or not outcomes.size or outcomes.dtype != bool:
        raise ValueError(f"expected outcomes (trainings, scenes) of booleans, got {outcomes.shape} {outcomes.dtype}")
    return outcomes


def _pair(name: str, first: ArrayLike, second: ArrayLike) -> tuple[Outcomes, Outcomes]:
    ours, theirs = np.asarray(first), np.asarray(second)
    if ours.shape != theirs.shape or not ours.size or ours.dtype != bool or theirs.dtype != bool:
        raise ValueError(f"{name}: expected outcomes of the same tests, got {ours.shape} and {theirs.shape}")
    return ours, theirs
