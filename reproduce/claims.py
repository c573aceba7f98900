"""The paper's claims C1 to C8, each with a verdict by rule from what lies in results/. Nothing is typed.

A claim has one part or several. A part about success holds when the 95 % Wilson intervals of the pooled tests do not
overlap in the claimed direction, and fails when they do not overlap in the other. A part about the training return
(of the environment's own reward, over the last twentieth of the updates) or about convergence (environment steps
until the return has come 90 % of its way up, smoothed over 20 updates) holds when all seeds of one method lie on the
claimed side of all of the other's, by 5 % of the larger at least, and fails when they lie on the other so. "Much
lower" is less than half, "not solved" fewer than 5 % of the tests. A claim is ``verified`` when all its parts hold,
``contradicted`` when one fails, else ``inconclusive``. A claim about a number is ``verified`` when the paper's number
lies in our interval or below it, ``contradicted`` when above. Fewer training seeds than ``ENOUGH_SEEDS`` or tests a
seed than ``ENOUGH_TESTS`` make any such verdict ``reduced scale``; the evidence then says what the rule alone would
give. Without runs a claim is ``inconclusive``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from reproduce.files import write_json
from reproduce.provenance import record_origin
from reproduce.results import RESULTS, Run, runs_of
from reproduce.statistics import intervals_overlap, wilson

ENOUGH_SEEDS = 5  # one seed each says nothing of the variance between trainings
ENOUGH_TESTS = 1000  # as in the paper; 50 cannot separate 98.6 % from 91.8 %
POSTURES = 20
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
        measured: Ours, or None.
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
    def interval(self) -> tuple[float, float]:
        """Wilson interval."""
        return wilson(self.successes, self.tests)

    @property
    def enough(self) -> bool:
        """Whether seeds and tests reach the bars."""
        return len(self.runs) >= ENOUGH_SEEDS and self.tests >= ENOUGH_TESTS * len(self.runs)

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
    words = f"success: {first.words()} against {second.words()}"
    apart = not intervals_overlap(first.interval, second.interval)
    return Part(words, first.rate > second.rate if apart else None)


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
    found = [[float(steps_to_converge(curve)) for curve in pool.curves()] for pool in (first, second)]
    words = f"env steps to converge: {first.method} {_listed(found[0])}, {second.method} {_listed(found[1])}"
    return Part(words, _above(found[1], found[0]))


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


def steps_to_converge(curve: pd.DataFrame) -> int:
    """Environment steps until the smoothed return has come 90 % of its way from the first to the last."""
    smooth = curve["return_high"].rolling(20, min_periods=1).mean()
    first, last = float(smooth.iloc[0]), final_return(curve)
    reached = np.flatnonzero((smooth - first).abs() >= CONVERGED * abs(last - first))
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
    bars = f"{len(found.runs)} seed(s), {found.tests} tests; bars {ENOUGH_SEEDS} seeds of {ENOUGH_TESTS} tests"
    return _with(
        claim,
        measured=found.rate,
        low=found.interval[0],
        high=found.interval[1],
        seeds=len(found.runs),
        tests=found.tests,
        env_steps=max(run.env_steps for run in found.runs),
        verdict=rule if enough else "reduced scale",
        evidence=words if enough else f"{words}; by the rule alone {rule}; {bars}",
    )


def _with(claim: Claim, **changes: object) -> Claim:
    return Claim(**{**asdict(claim), **changes})


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
        env_steps=max(run.env_steps for run in found.runs),
        verdict=rule if enough else "reduced scale",
        evidence=f"at most {max(seconds):.3f} s a test over {found.tests} tests; rule: no slower than the paper",
    )


def _c7(results: Path) -> Claim:
    claim = Claim("C7", "The policy serves any of the 20 postures and any start", "text")
    found = pool("hrl_dcs", results)
    if found is None:
        return _with(claim, evidence="no evaluated run of hrl_dcs in results/reference")
    worst = [
        (counts["successes"] / counts["tests"], wilson(counts["successes"], counts["tests"]), name)
        for run in found.runs
        if run.evaluation
        for name, counts in run.evaluation["by_posture"].items()
    ]
    rate, (low, high), name = min(worst)
    met = len({w[2] for w in worst}) == POSTURES
    rule = "verified" if met and low >= 0.9 else ("contradicted" if high < 0.9 else "inconclusive")
    words = f"weakest posture {name}: {100 * rate:.1f} % [{100 * low:.1f}, {100 * high:.1f}]; rule: 90 % in each"
    judged = _judged(claim, found, rule, words, found.enough)
    return _with(judged, measured=rate, low=low, high=high)


def compute_claims(results: Path = RESULTS) -> list[Claim]:
    """All claims in order."""
    c1 = Claim("C1", "SAC converges faster, to a much lower return, and does not solve the task", "no figure")
    c2 = Claim("C2", "HRL-DCS converges slightly faster than FeUdal Networks", "59 h against 67 h")
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
        judge(c2, "hrl_dcs", "fun", lambda a, b: [converges_faster(a, b)], results),
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
        measured = "" if c.measured is None or c.low is None else f" {c.measured:.3f} [{c.low:.3f}, {c.high:.3f}];"
        print(f"{c.id} {c.verdict}: {c.statement} (paper: {c.paper});{measured} {c.evidence}")
