"""Measure how often intervals and verdicts are wrong, on simulated trainings whose truth is known.

A case counts how often something happens in many simulated experiments, and has a bar where one was set beforehand.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.random import Generator
from scipy.special import expit
from scipy.stats import ttest_1samp

from reproduce.analysis import verdicts
from reproduce.analysis.intervals import Outcomes, success_difference, success_interval
from reproduce.analysis.rule_tables import COLUMNS, FILE
from reproduce.analysis.simulated import (
    Method,
    World,
    beta_trainings,
    centre,
    experiment,
    failing_trainings,
    spread,
)
from reproduce.experiments.rows import CONFIDENCE, wilson
from reproduce.storage.provenance import write_table

COVERAGE = (0.93, 0.97)  # bars for intervals of nominal 95 %
ERROR, POWER = (0.0, 0.05), (0.6, 1.0)  # bars for wrong verdicts, and for right ones
PAPER = 0.986
REPEATS, SEED = 4000, 20_220_610


class Case(NamedTuple):
    """One thing that is counted in many experiments."""

    rule: str
    truth: str  # in words
    trainings: str
    counted: str
    happens: Callable[[Generator], bool]  # one experiment
    bar: tuple[float, float] | None = None  # least and greatest share that is right, if one was set


# -- what may happen in an experiment ----------------------------------------------------------------------------------
def _covered(rng: Generator, world: World, method: Method) -> bool:
    _, low, high = success_interval(experiment(rng, world, method)[0])
    return low <= method.rate <= high


def _covered_by_rates(rng: Generator, world: World, method: Method) -> bool:
    rates = experiment(rng, world, method)[0].mean(axis=1)
    interval = ttest_1samp(rates, 0.0).confidence_interval(CONFIDENCE)
    return bool(interval.low <= method.rate <= interval.high)


def _covered_otherwise(rng: Generator, draw: Callable[[Generator], Outcomes], rate: float) -> bool:
    _, low, high = success_interval(draw(rng))
    return low <= rate <= high


def _difference_covered(rng: Generator, world: World, first: Method, second: Method) -> bool:
    ours, theirs = experiment(rng, world, first, second)
    _, low, high = success_difference(ours, theirs)
    return low <= first.rate - second.rate <= high


def _figure(rng: Generator, world: World, method: Method) -> verdicts.Judgement:
    return verdicts.is_figure(experiment(rng, world, method)[0], PAPER)


def _below(rng: Generator, world: World, method: Method) -> verdicts.Judgement:
    return verdicts.is_below(experiment(rng, world, method)[0])


def _more(rng: Generator, world: World, first: Method, second: Method) -> verdicts.Judgement:
    ours, theirs = experiment(rng, world, first, second)
    return verdicts.is_more(ours, theirs)


def _any_difference(rng: Generator, world: World, first: Method, second: Method) -> bool:
    judged = _more(rng, world, first, second)
    return judged.low > 0.0 or judged.high < 0.0


def _returns(rng: Generator, apart: float, trainings: int) -> verdicts.Judgement:
    """Judge returns of sd 1, the first one's higher by ``apart``."""
    ours, theirs = rng.standard_normal((2, trainings))
    return verdicts.is_larger(ours + apart, theirs)


def _steps(rng: Generator, share: float, trainings: int) -> verdicts.Judgement:
    """Judge steps to a level that are log-normal, sd 0.4; a third of the second method's trainings never gets there."""
    ours, theirs = np.exp(0.4 * rng.standard_normal((2, trainings)))
    most = float(np.exp(0.4 * 0.43))  # two thirds of a normal distribution lie below 0.43
    return verdicts.is_smaller_share(np.minimum(share * ours, most), np.minimum(theirs, most))


def _postures(rng: Generator, rates: Sequence[float], trainings: int) -> verdicts.Judgement:
    """Judge postures of 50 scenes each; a training is as good or bad in all of them."""
    shift = 0.3 * rng.standard_normal((trainings, 1))
    odds = [centre(rate, 0.3) + shift for rate in rates]
    return verdicts.serves_all(
        {f"{i:02}": rng.random((trainings, 50)) < expit(middle) for i, middle in enumerate(odds)}
    )[1]


def _conditions(rng: Generator, kept: Sequence[float], scenes: int) -> verdicts.Judgement:
    """Judge conditions in which a policy of 90 % keeps so much of its success."""
    before = rng.random(scenes) < 0.9
    gained = [0.45 * share for share in kept]  # of the scenes that failed; half of what is kept of the others
    after = {
        f"{i:02}": np.where(before, rng.random(scenes) < (share * 0.9 - 0.1 * gain) / 0.9, rng.random(scenes) < gain)
        for i, (share, gain) in enumerate(zip(kept, gained, strict=True))
    }
    return verdicts.keeps_all(before, after)[1]


def _says(words: Sequence[str], judge: Callable[[Generator], verdicts.Judgement]) -> Callable[[Generator], bool]:
    return lambda rng: judge(rng).verdict in words


# -- the cases ---------------------------------------------------------------------------------------------------------
def _coverage() -> Iterator[Case]:
    situations = [
        *((Method(rate, sd), World(hard)) for rate in (0.92, PAPER) for sd in (0.2, 0.5) for hard in (0.0, 1.0, 2.0)),
        *((Method(rate), World(1.0)) for rate in (0.3, 0.7)),
        *((Method(rate, 0.0), World()) for rate in (0.92,)),
        *((Method(0.92, 1.0), World(hard)) for hard in (0.0, 2.0)),
        *((Method(0.92, 0.5, trainings), World(1.0)) for trainings in (2, 3, 10)),
    ]
    for method, world in situations:
        truth = f"{100 * method.rate:.1f} %, log-odds of trainings sd {method.spread:g}, of scenes {world.difficulty:g}"
        bar = COVERAGE if method.trainings == 5 else None
        happens = partial(_covered, world=world, method=method)
        yield Case("interval of a method", truth, str(method.trainings), "covers the truth", happens, bar)
        if method.trainings == 5 and method.rate == 0.92:
            happens = partial(_covered_by_rates, world=world, method=method)
            yield Case("Student's t of rates alone", truth, "5", "covers the truth", happens)


def _other_families() -> Iterator[Case]:
    """Yield trainings that are not what the intervals were made for."""
    for rate, points in ((0.92, 2), (0.92, 4), (PAPER, 1)):
        draw = partial(beta_trainings, rate=rate, points=points)
        truth = f"{100 * rate:.1f} %, rates of trainings beta, sd {points} points"
        happens = partial(_covered_otherwise, draw=draw, rate=rate)
        yield Case("interval of a method", truth, "5", "covers the truth", happens, COVERAGE)
    draw = partial(failing_trainings, good=0.95, bad=0.65, share=0.1)
    happens = partial(_covered_otherwise, draw=draw, rate=0.92)
    truth = "92.0 %, one training in ten ends with 65 %, all others with 95 %"
    yield Case("interval of a method", truth, "5", "covers the truth", happens, COVERAGE)


def _differences() -> Iterator[Case]:
    far = Method(0.85, spread(5, 0.85)), Method(0.75, spread(5, 0.75))
    same = Method(0.8, spread(5, 0.8)), Method(0.8, spread(5, 0.8))
    near, wide = Method(PAPER, 0.5), Method(0.873, 0.5)
    few = Method(0.92, 0.5, 3), Method(0.92, 0.5, 5)
    worlds = World(), World(2.0, 1.0)
    pairs = {
        "85 % and 75 %, sd 5 points": far,
        "80 % both, sd 5 points": same,
        "98.6 % and 87.3 %, log-odds sd 0.5": (near, wide),
    }
    for (words, pair), world in ((pair, world) for pair in pairs.items() for world in worlds):
        truth = f"{words}, scenes sd {world.difficulty:g}, tastes {world.taste:g}"
        two = partial(_more, world=world, first=pair[0], second=pair[1])
        covered = partial(_difference_covered, world=world, first=pair[0], second=pair[1])
        yield Case("interval of a difference", truth, "5, 5", "covers the truth", covered, COVERAGE)
        if pair[0].rate > pair[1].rate:
            yield Case("succeeds more", truth, "5, 5", "agrees", _says(["agrees"], two), POWER)
        else:
            claimed = partial(_any_difference, world=world, first=pair[0], second=pair[1])
            yield Case("succeeds more", truth, "5, 5", "a difference claimed", claimed, ERROR)
    for words, first, second in (("three and five", *few), ("three each", few[0], few[0])):
        trainings = f"{first.trainings}, {second.trainings}"
        claimed = partial(_any_difference, world=World(1.0), first=first, second=second)
        truth = f"92 % both, {words}, log-odds sd 0.5, scenes sd 1"
        yield Case("succeeds more", truth, trainings, "a difference claimed", claimed, ERROR)
    edge = Method(0.92 + verdicts.MARGIN, 0.2), Method(0.92, 0.2)
    differs = _says(["differs"], partial(_more, world=World(), first=edge[0], second=edge[1]))
    yield Case("succeeds more", "95 % and 92 %, log-odds sd 0.2", "5, 5", "differs", differs, ERROR)


def _figures() -> Iterator[Case]:
    edge = PAPER - verdicts.MARGIN
    for words, sd, hard in (("sd 2 points", spread(2, edge), 0.0), ("log-odds sd 0.2, scenes sd 2", 0.2, 2.0)):
        agrees = _says(["agrees"], partial(_figure, world=World(hard), method=Method(edge, sd)))
        yield Case("is the paper's figure", f"95.6 %, {words}", "5", "agrees", agrees, ERROR)
    for trainings in (3, 5):
        judge = partial(_figure, world=World(1.0), method=Method(PAPER, 0.5, trainings))
        truth, bar = "98.6 %, log-odds sd 0.5, scenes sd 1", POWER if trainings == 5 else None
        yield Case("is the paper's figure", truth, str(trainings), "agrees", _says(["agrees"], judge), bar)
        yield Case("is the paper's figure", truth, str(trainings), "differs", _says(["differs"], judge), ERROR)
    differs = _says(["differs"], partial(_figure, world=World(1.0), method=Method(0.92, 0.5)))
    yield Case("is the paper's figure", "92 %, log-odds sd 0.5, scenes sd 1", "5", "differs", differs, POWER)
    agrees = _says(["agrees"], partial(_below, world=World(1.0), method=Method(verdicts.UNSOLVED, 0.5)))
    yield Case("does not solve it", "5 %, log-odds sd 0.5, scenes sd 1", "5", "agrees", agrees, ERROR)


def _others() -> Iterator[Case]:
    decided = ["agrees", "differs"]
    for trainings in (3, 5):
        number, bar = f"{trainings}, {trainings}", POWER if trainings == 5 else None
        returns, steps = partial(_returns, trainings=trainings), partial(_steps, trainings=trainings)
        none = _says(decided, partial(returns, apart=0.0))
        yield Case("returns more", "the same, sd 1", number, "agrees or differs", none, ERROR)
        yield Case("returns more", "2 sd more", number, "agrees", _says(["agrees"], partial(returns, apart=2.0)), bar)
        none, half = (_says(words, partial(steps, share=s)) for words, s in ((decided, 1.0), (["agrees"], 0.5)))
        truth = "log-normal sd 0.4, a third never"
        yield Case("converges faster", f"the same, {truth}", number, "agrees or differs", none, ERROR)
        yield Case("converges faster", f"half the steps, {truth}", number, "agrees", half, bar)
    for words, rates, verdict, bar in (
        ("all 98.6 %", [PAPER] * 20, "agrees", POWER),
        ("one 90 %, all others 99 %", [verdicts.SERVED] + [0.99] * 19, "agrees", ERROR),
        ("all 90 %", [verdicts.SERVED] * 20, "differs", ERROR),
        ("one 60 %, all others 99 %", [0.6] + [0.99] * 19, "differs", POWER),
    ):
        judge = partial(_postures, rates=rates, trainings=5)
        yield Case("serves every posture", f"{words}, log-odds sd 0.3", "5", verdict, _says([verdict], judge), bar)
    for words, kept, scenes, verdict, bar in (
        ("98 % in all of ten", [0.98] * 10, 200, "agrees", None),
        ("98 % in all of ten", [0.98] * 10, 1000, "agrees", POWER),
        ("90 % in one of ten", [verdicts.KEPT] + [1.0] * 9, 200, "agrees", ERROR),
        ("90 % in all of ten", [verdicts.KEPT] * 10, 200, "differs", ERROR),
        ("75 % in one of ten", [0.75] + [1.0] * 9, 200, "differs", POWER),
    ):
        judge = partial(_conditions, kept=kept, scenes=scenes)
        yield Case("keeps its success", f"keeps {words}, {scenes} scenes", "1", verdict, _says([verdict], judge), bar)


def cases() -> list[Case]:
    """Return all cases, in the order of the table."""
    return [*_coverage(), *_other_families(), *_differences(), *_figures(), *_others()]


def count(case: Case, repeats: int, number: int = 0) -> dict[str, Any]:
    """Return a row of the table: how often a case happens, with Wilson's interval, and whether its bar holds."""
    rng = np.random.default_rng([SEED, number])
    times = sum(case.happens(rng) for _ in range(repeats))
    low, high = wilson(times, repeats)
    row: dict[str, Any] = {"rule": case.rule, "truth": case.truth, "trainings": case.trainings, "counted": case.counted}
    row |= {"share": times / repeats, "low": low, "high": high, "at_least": None, "at_most": None, "holds": None}
    if case.bar:
        row |= {"at_least": case.bar[0], "at_most": case.bar[1], "holds": case.bar[0] <= row["share"] <= case.bar[1]}
    return row | {"repeats": repeats}


def measure_rules(
    repeats: int = REPEATS, path: Path | None = None, tell: Callable[[str], object] = print
) -> pd.DataFrame:
    """Count every case in ``repeats`` experiments and write ``rules.csv``, to results/ unless told otherwise."""
    rows = []
    for number, case in enumerate(cases()):
        row = count(case, repeats, number)
        rows.append(row)
        verdict = {None: "", True: ", the bar holds", False: ", the bar does NOT hold"}[row["holds"]]
        words = f"{case.rule}, {case.trainings} trainings, {case.truth}: {case.counted}"
        tell(f"{words} in {100 * row['share']:.1f} % of {repeats}{verdict}")
    table = pd.DataFrame(rows, columns=COLUMNS)
    write_table(path or FILE, table)
    return table
