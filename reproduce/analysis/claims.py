"""The paper's claims C1 to C8, each with a verdict by rule from what lies in results/. Nothing is typed.

A claim has one part or several. It is ``verified`` when all its parts hold, ``contradicted`` when one fails, else
``inconclusive``.

- Success: the first method's is the higher when the 95 % interval of the difference lies above 0, and the lower when it
  lies below. With one training each that is the interval of paired tests (Agresti and Min), which says nothing of other
  trainings; with several each it is Welch's of the trainings' rates. Not solved is fewer than 5 % of the tests.
- Return in the end (of the environment's own reward, over the last twentieth of the updates) and convergence
  (environment steps until the return, smoothed over 20 updates, has come 90 % of its way up): all trainings of one
  method must lie on the claimed side of all of the other's, by 5 % of the larger at least. A return that ends no
  higher than it began, by that margin and by its own spread, has not converged, and the part stays open. "Much lower"
  is less than half.
- A number (C5): the paper's lies in our interval or below it; contradicted when it lies above. The interval is Wilson's
  of all tests or, for several trainings and where it is wider, Student's of their rates.
- Time (C6): no test takes longer on average than the paper's; this needs tests, and no more than one training.
- Any posture (C7): the weakest of the 20, trainings together, has a Wilson interval above 90 %; contradicted when it
  lies below.

Fewer trainings than ``ENOUGH_SEEDS``, tests a training than ``ENOUGH_TESTS`` or environment steps a training than
``ENOUGH_STEPS`` make any such verdict ``reduced scale``; the evidence then says what the rule alone would give. Without
runs a claim is ``inconclusive``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.stats import ttest_ind

from reproduce.analysis.intervals import CONFIDENCE, mean_interval, paired_difference, same_scenes, wilson
from reproduce.analysis.runs import Run, runs_of
from reproduce.storage.files import write_json
from reproduce.storage.paths import RESULTS
from reproduce.storage.provenance import record_origin

ENOUGH_SEEDS = 5  # one seed each says nothing of the variance between trainings
ENOUGH_TESTS = 1000  # as in the paper; 50 cannot separate 98.6 % from 91.8 %
ENOUGH_STEPS = 5_000_000  # our budget; the paper allows 700 million, stops earlier and does not say where
POSTURES = 20
SERVED = 0.9  # what every posture must reach; the paper gives no figure
UNSOLVED = 0.05  # the paper gives SAC no figure at all
CONVERGED = 0.9  # share of the way up
MARGIN = 0.05  # of the larger: what returns or steps must differ by


@dataclass(frozen=True)
class Claim:
    """One claim with its verdict.

    Attributes:
        id: C1 to C8.
        statement: What the paper claims.
        paper: Its figure.
        measured: Ours, or None: a share of tests; C2 a ratio of environment steps, C6 seconds a test.
        low: Lower end of the interval of ``measured``.
        high: Upper end.
        seeds: Training seeds behind it.
        tests: Tests behind it, over all seeds.
        env_steps: Environment steps a training.
        verdict: See the module.
        evidence: Where it comes from, in words with figures.
    """

    id: str
    statement: str
    paper: str
    measured: float | None = None
    low: float | None = None
    high: float | None = None
    seeds: int = 0
    tests: int = 0
    env_steps: int = 0
    verdict: str = "inconclusive"
    evidence: str = ""


@dataclass(frozen=True)
class Pool:
    """The tests of all seeds of a method together."""

    method: str
    runs: tuple[Run, ...]

    @property
    def tests(self) -> int:
        """Tests of all seeds."""
        return sum(int(run.evaluation["tests"]) for run in self.runs if run.evaluation)

    @property
    def successes(self) -> int:
        """Successes of all seeds."""
        return sum(int(run.evaluation["successes"]) for run in self.runs if run.evaluation)

    @property
    def rate(self) -> float:
        """Success rate."""
        return self.successes / self.tests

    @property
    def rates(self) -> list[float]:
        """Success rate of each training."""
        return [float(run.evaluation["success_rate"]) for run in self.runs if run.evaluation]

    @property
    def interval(self) -> tuple[float, float]:
        """Of the success rate: Wilson's of all tests; for several trainings Student's of their rates where wider."""
        low, high = wilson(self.successes, self.tests)
        if len(self.runs) > 1:
            _, lower, higher = mean_interval(self.rates)
            low, high = max(0.0, min(low, lower)), min(1.0, max(high, higher))
        return low, high

    @property
    def enough(self) -> bool:
        """Whether trainings, their steps and their tests reach the bars."""
        trained = len(self.runs) >= ENOUGH_SEEDS and self.env_steps >= ENOUGH_STEPS
        return trained and self.tests >= ENOUGH_TESTS * len(self.runs)

    @property
    def env_steps(self) -> int:
        """Of the shortest training."""
        return min(run.env_steps for run in self.runs)

    def curves(self) -> list[pd.DataFrame]:
        """Learning curves of the seeds that have one."""
        found = (run.curve() for run in self.runs)
        return [curve for curve in found if curve is not None]

    def words(self) -> str:
        """Figures in words."""
        low, high = self.interval
        return f"{self.method} {100 * self.rate:.1f} % [{100 * low:.1f}, {100 * high:.1f}]"


def pool(method: str, results: Path) -> Pool | None:
    """All evaluated runs of a method, or None."""
    runs = runs_of(method, results)
    return Pool(method, tuple(runs)) if runs else None


@dataclass(frozen=True)
class Part:
    """One thing that a claim says.

    Attributes:
        words: What was found, with figures.
        holds: Whether it is so; None where the rule leaves it open.
    """

    words: str
    holds: bool | None


def succeeds_more(first: Pool, second: Pool) -> Part:
    """Whether the first succeeds more often."""
    found = _difference(first, second)
    words = f"success: {first.words()} against {second.words()}"
    if found is None:
        return Part(f"{words}, not on the same scenes", None)
    kind, low, high = found
    words += f", {kind} difference [{100 * low:+.2f}, {100 * high:+.2f}] points"
    return Part(words, True if low > 0.0 else (False if high < 0.0 else None))


def _difference(first: Pool, second: Pool) -> tuple[str, float, float] | None:
    """Interval of the difference of two success rates and what it is of; None where scenes are not the same."""
    if len(first.runs) > 1 and len(second.runs) > 1:
        low, high = ttest_ind(first.rates, second.rates, equal_var=False).confidence_interval(CONFIDENCE)
        return "trainings'", float(low), float(high)
    ours, theirs = first.runs[0].evaluation or {}, second.runs[0].evaluation or {}
    if not ours.get("outcomes") or not same_scenes(ours, theirs):
        return None
    _, low, high = paired_difference(ours["outcomes"], theirs["outcomes"])
    return "paired", low, high


def unsolved(found: Pool) -> Part:
    """Whether a method does not solve the task."""
    low, high = found.interval
    words = f"success: {found.words()}, not solved is below {100 * UNSOLVED:.0f} %"
    return Part(words, True if high < UNSOLVED else (False if low >= UNSOLVED else None))


def returns_more(first: Pool, second: Pool, times: float = 1.0) -> Part:
    """Whether the first one's return in the end is more than so many times the second's."""
    found = [[final_return(curve) for curve in pool.curves()] for pool in (first, second)]
    factor = "" if times == 1.0 else f" and {times:g} times as much"
    words = f"return in the end: {first.method} {_listed(found[0], 2)}, {second.method} {_listed(found[1], 2)}{factor}"
    return Part(words, _above(found[0], [times * value for value in found[1]]))


def converges_faster(first: Pool, second: Pool) -> Part:
    """Whether the first converges in fewer environment steps."""
    found = [[steps_to_converge(curve) for curve in pool.curves()] for pool in (first, second)]
    told = [", ".join("none" if n is None else f"{n:,}" for n in steps) or "no curve" for steps in found]
    words = f"env steps to converge: {first.method} {told[0]}, {second.method} {told[1]}"
    if any(steps is None for each in found for steps in each):
        return Part(words, None)
    ours, theirs = ([float(steps) for steps in each if steps is not None] for each in found)
    return Part(words, _above(theirs, ours))


def _above(high: list[float], low: list[float]) -> bool | None:
    if not high or not low:
        return None
    margin = MARGIN * max(map(abs, [*high, *low]))
    if min(high) - max(low) > margin:
        return True
    return False if min(low) - max(high) > margin else None


def _listed(values: list[float], digits: int = 0) -> str:
    return ", ".join(f"{value:,.{digits}f}" for value in values) or "no curve"


def final_return(curve: pd.DataFrame) -> float:
    """Mean return over the last twentieth of the updates."""
    return float(curve["return_high"].tail(max(1, len(curve) // 20)).mean())


def steps_to_converge(curve: pd.DataFrame) -> int | None:
    """Environment steps until the smoothed return has come 90 % of its way up; None where it did not rise."""
    smooth = curve["return_high"].rolling(20, min_periods=1).mean()
    first, last = float(smooth.iloc[0]), final_return(curve)
    spread = float(curve["return_high"].tail(max(2, len(curve) // 20)).std())
    if not last - first > max(MARGIN * max(abs(first), abs(last)), spread):
        return None
    reached = np.flatnonzero(smooth - first >= CONVERGED * (last - first))
    return int(curve["env_steps"].iloc[reached[0]]) if len(reached) else int(curve["env_steps"].iloc[-1])


def judge(claim: Claim, first: str, second: str, parts: Callable[[Pool, Pool], list[Part]], results: Path) -> Claim:
    """Verdict on a claim about two methods; its figure is the success of the first."""
    ours, theirs = pool(first, results), pool(second, results)
    if ours is None or theirs is None:
        missing = " and ".join(name for name, p in ((first, ours), (second, theirs)) if p is None)
        return _with(claim, evidence=f"no evaluated run of {missing} in results/reference")
    found = parts(ours, theirs)
    held = [part.holds for part in found]
    rule = "contradicted" if False in held else ("inconclusive" if None in held else "verified")
    names = {True: "holds", False: "fails", None: "open"}
    words = "; ".join(f"{part.words} ({names[part.holds]})" for part in found)
    return _judged(claim, ours, rule, words, ours.enough and theirs.enough)


def reaches(claim: Claim, method: str, level: float, results: Path) -> Claim:
    """Verdict on: ``method`` succeeds in ``level`` of the tests."""
    found = pool(method, results)
    if found is None:
        return _with(claim, evidence=f"no evaluated run of {method} in results/reference")
    rule = "verified" if found.interval[1] >= level else "contradicted"
    return _judged(claim, found, rule, f"{found.words()}, paper {100 * level:.1f} %", found.enough)


def _judged(claim: Claim, found: Pool, rule: str, words: str, enough: bool) -> Claim:
    bars = (
        f"{len(found.runs)} seed(s) of {found.env_steps:,} steps, {found.tests} tests; "
        f"bars {ENOUGH_SEEDS} seeds of {ENOUGH_STEPS:,} steps and {ENOUGH_TESTS} tests"
    )
    return _with(
        claim,
        measured=found.rate,
        low=found.interval[0],
        high=found.interval[1],
        seeds=len(found.runs),
        tests=found.tests,
        env_steps=found.env_steps,
        verdict=rule if enough else "reduced scale",
        evidence=words if enough else f"{words}; by the rule alone {rule}; {bars}",
    )


def _with(claim: Claim, **changes: object) -> Claim:
    return Claim(**{**asdict(claim), **changes})


def _c2(results: Path) -> Claim:
    claim = Claim("C2", "HRL-DCS converges slightly faster than FeUdal Networks", "59 h against 67 h")
    judged = judge(claim, "hrl_dcs", "fun", lambda a, b: [converges_faster(a, b)], results)
    steps = [_mean_steps(pool(method, results)) for method in ("hrl_dcs", "fun")]
    ratio = None if steps[0] is None or steps[1] is None else steps[0] / steps[1]
    return _with(judged, measured=ratio, low=None, high=None)


def _mean_steps(found: Pool | None) -> float | None:
    """Mean of the steps to converge, None where one training has not."""
    steps = [steps_to_converge(curve) for curve in found.curves()] if found else []
    known = [float(number) for number in steps if number is not None]
    return float(np.mean(known)) if known and len(known) == len(steps) else None


def _c6(results: Path) -> Claim:
    claim = Claim("C6", "1000 tests take 652 s", "0.652 s a test")
    found = pool("hrl_dcs", results)
    if found is None:
        return _with(claim, evidence="no evaluated run of hrl_dcs in results/reference")
    seconds = [float(run.evaluation["seconds_per_test"]) for run in found.runs if run.evaluation]
    rule = "verified" if max(seconds) <= 0.652 else "contradicted"
    enough = found.tests >= ENOUGH_TESTS
    return _with(
        claim,
        measured=float(np.mean(seconds)),
        low=min(seconds),
        high=max(seconds),
        seeds=len(seconds),
        tests=found.tests,
        env_steps=found.env_steps,
        verdict=rule if enough else "reduced scale",
        evidence=f"at most {max(seconds):.3f} s a test over {found.tests} tests; rule: no slower than the paper",
    )


def _c7(results: Path) -> Claim:
    claim = Claim("C7", "The policy serves any of the 20 postures and any start", "text")
    found = pool("hrl_dcs", results)
    if found is None:
        return _with(claim, evidence="no evaluated run of hrl_dcs in results/reference")
    pooled: dict[str, list[int]] = {}
    for run in found.runs:
        for name, counts in (run.evaluation or {})["by_posture"].items():
            mine = pooled.setdefault(name, [0, 0])
            mine[0] += int(counts["successes"])
            mine[1] += int(counts["tests"])
    rate, name = min((successes / tests, name) for name, (successes, tests) in pooled.items())
    low, high = wilson(*pooled[name])
    enough = len(pooled) == POSTURES and low >= SERVED
    rule = "verified" if enough else ("contradicted" if high < SERVED else "inconclusive")
    words = f"weakest posture {name}: {100 * rate:.1f} % [{100 * low:.1f}, {100 * high:.1f}]"
    judged = _judged(claim, found, rule, words, found.enough)
    return _with(judged, measured=rate, low=low, high=high)


def compute_claims(results: Path = RESULTS) -> list[Claim]:
    """All claims in order."""
    c1 = Claim("C1", "SAC converges faster, to a much lower return, and does not solve the task", "no figure")
    c3 = Claim("C3", "HRL-DCS succeeds more often than FeUdal Networks", "98.6 % against 91.8 %")
    c4 = Claim(
        "C4",
        "AAPF raises return, speed and success against the contact reward",
        "98.6 % against 87.3 %, 59 h to 86 h",
    )
    c5 = Claim("C5", "HRL-DCS succeeds in 98.6 % of 1000 tests", "98.6 % [97.7, 99.2]")
    c8 = Claim(
        "C8",
        "Tests in a physical environment demonstrate the method",
        "claimed by the abstract, deferred by the conclusion",
        evidence="not testable here: there is no such robot; a second simulator is planned to stand in",
    )
    return [
        judge(
            c1, "sac", "hrl_dcs", lambda a, b: [converges_faster(a, b), returns_more(b, a, 2.0), unsolved(a)], results
        ),
        _c2(results),
        judge(c3, "hrl_dcs", "fun", lambda a, b: [succeeds_more(a, b)], results),
        judge(
            c4,
            "hrl_dcs",
            "hrl_dcs_no_aapf",
            lambda a, b: [succeeds_more(a, b), returns_more(a, b), converges_faster(a, b)],
            results,
        ),
        reaches(c5, "hrl_dcs", 0.986, results),
        _c6(results),
        _c7(results),
        c8,
    ]


def write_claims(claims: list[Claim], path: Path | None = None) -> Path:
    """Write ``claims.json`` (to results/ unless told otherwise)."""
    target = path or RESULTS / "claims.json"
    write_json(target, [asdict(claim) for claim in claims])
    record_origin(target)
    return target


def print_claims(claims: list[Claim]) -> None:
    """Print a line a claim."""
    for c in claims:
        interval = "" if c.low is None else f" [{c.low:.3f}, {c.high:.3f}]"
        measured = "" if c.measured is None else f" {c.measured:.3f}{interval};"
        print(f"{c.id} {c.verdict}: {c.statement} (paper: {c.paper});{measured} {c.evidence}")
