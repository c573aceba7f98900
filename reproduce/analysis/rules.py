"""Say what a claim says, as rules over the trainings of one method or two: a verdict, and what it rests on in words."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lunar_rescue.scenes.postures import postures
from reproduce.analysis.intervals import Interval, in_points, paired_difference
from reproduce.analysis.stressed import conditions, read_stress
from reproduce.analysis.trainings import LEVELS, Pool, horizon, percent, restricted_steps
from reproduce.analysis.verdicts import (
    KEPT,
    LEAST_TRAININGS,
    MARGIN,
    SERVED,
    UNSOLVED,
    Verdict,
    is_below,
    is_figure,
    is_larger,
    is_more,
    is_smaller_share,
    keeps_all,
    serves_all,
)


@dataclass(frozen=True)
class Part:
    """One thing that a claim says."""

    words: str  # what the runs show, with figures
    verdict: Verdict
    figures: dict[str, Any] = field(default_factory=dict)  # of the claim; without them its first method's success


def _figures(interval: Interval) -> dict[str, float]:
    return dict(zip(("measured", "low", "high"), interval, strict=True))


def succeeds_more(first: Pool, second: Pool) -> Part:
    """Judge whether the first succeeds more often on the same scenes."""
    words = f"success: {first.words()} against {second.words()}"
    if first.scenes != second.scenes:
        return Part(f"{words}, not on the same scenes", "undecided")
    if min(len(first.runs), len(second.runs)) == 1:
        interval, kind = paired_difference(first.outcomes[0], second.outcomes[0]), "difference of one training each"
        return Part(f"{words}, {kind} {_points(interval)}", "undecided")
    found = is_more(first.outcomes, second.outcomes)
    return Part(f"{words}, difference {_points(found[1:])}", found.verdict)


def _points(interval: Interval) -> str:
    return f"{in_points(interval)} points"


def unsolved(pool: Pool) -> Part:
    """Judge whether a method does not solve the task."""
    words = f"success: {pool.words()}, not solved is below {100 * UNSOLVED:.0f} %"
    return Part(words, is_below(pool.outcomes).verdict)


def reaches(pool: Pool, level: float) -> Part:
    """Judge whether a method's success is the paper's."""
    words = f"{pool.words()}, paper {100 * level:.1f} %, margin {100 * MARGIN:.0f} points"
    return Part(words, is_figure(pool.outcomes, level).verdict)


def returns_more(first: Pool, second: Pool, times: float = 1.0) -> Part:
    """Judge whether the first one's return in the end is more than so many times the second's."""
    factor = "" if times == 1.0 else f", {times:g} times as much"
    words = f"return in the end: {_values(first, first.returns)} against {_values(second, second.returns)}{factor}"
    if min(len(first.returns), len(second.returns)) < LEAST_TRAININGS:
        return Part(f"{words}, too few curves", "undecided")
    found = is_larger(first.returns, times * np.array(second.returns))
    return Part("{}, difference {:+.2f} [{:+.2f}, {:+.2f}]".format(words, *found[1:]), found.verdict)


def _values(pool: Pool, values: Sequence[float]) -> str:
    return f"{pool.method} {', '.join(f'{value:.2f}' for value in values) or 'no curve'}"


def converges_faster(first: Pool, second: Pool) -> Part:
    """Judge whether the first takes fewer steps to fixed levels of success; the figure is the ratio of their means.

    Steps to the levels, restricted to what all trainings took, are averaged, so that a training is one number; Welch's
    interval of the ratio of the methods' means decides. The probability of improvement is that of one training of the
    first being faster than one of the second, ties counted half.
    """
    open_figures = {"measured": None, "low": None, "high": None}
    if min(len(first.curves), len(second.curves)) < LEAST_TRAININGS:
        return Part("env steps to levels of success: too few curves", "undecided", open_figures)
    most = horizon([first, second])
    ours, theirs = (restricted_steps(pool, most) for pool in (first, second))
    reached = np.array([(steps < most).sum(axis=0) for steps in (ours, theirs)])
    levels = "; ".join(
        f"{100 * level:.0f} % {ours[:, i].mean():,.0f} ({reached[0, i]} of {len(ours)} reach it) "
        f"against {theirs[:, i].mean():,.0f} ({reached[1, i]} of {len(theirs)})"
        for i, level in enumerate(LEVELS)
    )
    words = f"env steps to success, within {most:,.0f}: {first.method} against {second.method}, {levels}"
    if not reached.any():
        return Part(f"{words}, no level reached", "undecided", open_figures)
    from scipy.stats import mannwhitneyu  # here, as it takes a second to import

    ours, theirs = ours.mean(axis=1), theirs.mean(axis=1)
    better = mannwhitneyu(theirs, ours).statistic / (len(ours) * len(theirs))
    found = is_smaller_share(ours, theirs)
    words += ", together {:.2f} [{:.2f}, {:.2f}] of the steps".format(*found[1:])
    return Part(f"{words}, probability of improvement {better:.2f}", found.verdict, _figures(found[1:]))


def converges_too(first: Pool, second: Pool) -> Part:
    """Judge as ``converges_faster``, where another part has the claim's figure."""
    return replace(converges_faster(first, second), figures={})


def takes_seconds(pool: Pool, paper: float) -> Part:
    """Tell the seconds a test beside the paper's: another simulator on another machine, so not comparable."""
    seconds = [run.evaluation["seconds_per_test"] for run in pool.runs if run.evaluation]
    figures = {"measured": float(np.mean(seconds)), "low": min(seconds), "high": max(seconds)}
    words = f"{min(seconds):.3f} to {max(seconds):.3f} s a test by training, paper {paper:g} s"
    return Part(f"{words}; simulator and machine are others than the paper's", "not comparable", figures)


def serves_every_posture(pool: Pool) -> Part:
    """Judge whether all postures are served; the figure is the success of the weakest, its interval simultaneous."""
    lies = pool.rows["posture"].to_numpy()[: len(pool.scenes)]
    groups = {str(name): pool.outcomes[:, lies == name] for name in sorted(set(lies))}
    weakest, found = serves_all(groups)
    rate = percent(found.value, found[2:])
    words = f"weakest of {len(groups)} postures {weakest}: {rate}, served is {100 * SERVED:.0f} %"
    verdict = found.verdict
    if missing := sorted(set(postures()) - set(groups)):
        verdict, words = "undecided", f"{words}, no test of {', '.join(missing)}"
    return Part(words, verdict, _figures(found[1:]))


def keeps_success(pool: Pool) -> Part:
    """Judge whether a policy keeps its success in the other engine and under each disturbance of middle severity."""
    path = pool.results / "stress" / f"{pool.method}.csv"
    rows = read_stress(path)
    told = None if rows is None else conditions(rows)
    if told is None or not told[0].any():
        words = f"results/stress/{path.name} tells of no success, of no other engine or of no middle severity"
        return Part(words, "undecided", {"measured": None, "low": None, "high": None})
    worst, found = keeps_all(told[0], told[1])
    kept = f"{percent(found.value, found[2:])}, enough is {100 * KEPT:.0f} %"
    words = f"of {int(told[0].sum())} rescues kept least under {worst}: {kept}"
    each = ", ".join(f"{name} {100 * after.sum() / told[0].sum():.0f} %" for name, after in told[1].items())
    return Part(f"{words} ({each})", found.verdict, _figures(found[1:]))


#: What ``claims.yaml`` may name.
_RULES = (succeeds_more, unsolved, reaches, returns_more, converges_faster, converges_too, takes_seconds)
RULES: dict[str, Callable[..., Part]] = {rule.__name__: rule for rule in (*_RULES, serves_every_posture, keeps_success)}
