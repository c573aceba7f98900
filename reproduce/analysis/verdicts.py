"""Judge numbers of trainings by rule: whether they agree with what is claimed, differ from it, or leave it undecided.

The rules are stated here before any run is looked at, and ``reproduce rules`` measures how often each of them is wrong.
Fewer than three trainings a method leave all of them undecided that speak of how trainings differ.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from reproduce.analysis.intervals import (
    Interval,
    Outcomes,
    difference_of_means,
    kept_share,
    ratio_of_means,
    success_difference,
    success_interval,
)
from reproduce.experiments.rows import CONFIDENCE

Verdict = Literal["agrees", "differs", "undecided", "not comparable"]
MARGIN = 0.03  # success rates nearer to each other than 3 points count as the same
LEAST_TRAININGS = 3  # an interval from two covers 89 % where it should cover 95 (``reproduce rules``)
SERVED = 0.9  # what every posture must reach; the paper gives no figure
KEPT = 0.9  # share of its success that a policy must keep in another engine and under a disturbance
UNSOLVED = 0.05  # less success is no solution; the paper gives SAC no figure at all


class Judgement(NamedTuple):
    """A verdict and the figure that it rests on."""

    verdict: Verdict
    value: float
    low: float  # ends of the interval of ``value``
    high: float


def is_figure(outcomes: Outcomes, paper: float) -> Judgement:
    """Judge whether a success rate is the paper's.

    It agrees when two one-sided tests at 2.5 % place it within the margin of the paper's figure, which is when the
    whole 95 % interval lies there; else it differs when the figure lies outside that interval, above it or below it.
    ``outcomes`` are (trainings, scenes).
    """
    interval = success_interval(outcomes)
    agrees, differs = _within(interval, paper), not interval[1] <= paper <= interval[2]
    return _judgement(interval, agrees=agrees, differs=differs, trainings=len(outcomes))


def is_more(first: Outcomes, second: Outcomes) -> Judgement:
    """Judge whether the first method succeeds more often than the second on the same scenes.

    It agrees when the 95 % interval of the difference lies above 0; it differs when that lies below, or when two
    one-sided tests at 2.5 % place the difference within the margin of 0. Both are (trainings, scenes).
    """
    interval = success_difference(first, second)
    agrees, differs = interval[1] > 0.0, interval[2] < 0.0 or _within(interval, 0.0)
    return _judgement(interval, agrees=agrees, differs=differs, trainings=min(len(first), len(second)))


def _within(interval: Interval, of: float) -> bool:
    return of - MARGIN < interval[1] and interval[2] < of + MARGIN


def is_below(outcomes: Outcomes, bar: float = UNSOLVED) -> Judgement:
    """Judge whether a success rate lies below a bar: its 95 % interval must, and differs where it does not reach it."""
    interval = success_interval(outcomes)
    return _judgement(interval, agrees=interval[2] < bar, differs=interval[1] >= bar, trainings=len(outcomes))


def is_larger(first: ArrayLike, second: ArrayLike) -> Judgement:
    """Judge whether a mean of trainings is the larger of two: Welch's 95 % interval of the difference and 0."""
    interval = difference_of_means(first, second)
    trainings = min(np.size(first), np.size(second))
    return _judgement(interval, agrees=interval[1] > 0.0, differs=interval[2] < 0.0, trainings=trainings)


def is_smaller_share(first: ArrayLike, second: ArrayLike) -> Judgement:
    """Judge whether a mean of trainings is the smaller of two, by their ratio: its 95 % interval and 1."""
    interval = ratio_of_means(first, second)
    trainings = min(np.size(first), np.size(second))
    return _judgement(interval, agrees=interval[2] < 1.0, differs=interval[1] > 1.0, trainings=trainings)


def serves_all(groups: Mapping[str, Outcomes], bar: float = SERVED) -> tuple[str, Judgement]:
    """Judge whether a method serves every group of scenes; return the weakest group and its simultaneous interval.

    It differs when one of the groups' simultaneous 95 % intervals (Bonferroni's) lies below the bar. That all are
    served is claimed when each one's own 95 % interval lies above it: a claim of all at once needs no correction (an
    intersection of hypotheses keeps the level of one). ``groups`` are (trainings, scenes) by name.
    """
    simultaneous = 1.0 - (1.0 - CONFIDENCE) / len(groups)
    intervals = {name: success_interval(outcomes, simultaneous) for name, outcomes in groups.items()}
    weakest = min(intervals, key=lambda name: (intervals[name], name))
    agrees = all(success_interval(outcomes)[1] > bar for outcomes in groups.values())
    differs = any(high < bar for _, _, high in intervals.values())
    trainings = min(map(len, groups.values()))
    return weakest, _judgement(intervals[weakest], agrees=agrees, differs=differs, trainings=trainings)


def keeps_all(before: ArrayLike, after: Mapping[str, ArrayLike], share: float = KEPT) -> tuple[str, Judgement]:
    """Judge whether a policy keeps a share of its success under every condition; return the worst and its share.

    As ``serves_all``, over conditions. It is said of one policy, so one training is enough. ``before`` and each of
    ``after`` are (scenes,) of booleans, in the same order.
    """
    simultaneous = 1.0 - (1.0 - CONFIDENCE) / len(after)
    intervals = {name: kept_share(before, outcomes, simultaneous) for name, outcomes in after.items()}
    worst = min(intervals, key=lambda name: (intervals[name], name))
    agrees = all(kept_share(before, outcomes)[1] > share for outcomes in after.values())
    differs = any(high < share for _, _, high in intervals.values())
    return worst, _judgement(intervals[worst], agrees=agrees, differs=differs)


def _judgement(interval: Interval, *, agrees: bool, differs: bool, trainings: int = LEAST_TRAININGS) -> Judgement:
    """Return the verdict; where a rule finds both, what lies within its margin agrees."""
    verdict: Verdict = "agrees" if agrees else ("differs" if differs else "undecided")
    return Judgement(verdict if trainings >= LEAST_TRAININGS else "undecided", *interval)
