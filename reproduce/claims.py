"""The paper's claims C1 to C8, each with a verdict by rule from what lies in results/. Nothing is typed.

Rules: a claim about a comparison is ``verified`` when the 95 % Wilson intervals of the pooled tests do not overlap in
the claimed direction, ``contradicted`` when they do not overlap in the other, else ``inconclusive``. A claim about a
number is ``verified`` when the paper's number lies in our interval or below it, ``contradicted`` when above. Fewer
training seeds than ``ENOUGH_SEEDS`` or tests a seed than ``ENOUGH_TESTS`` make any such verdict ``reduced scale``; the
evidence then says what the rule alone would give. Without runs a claim is ``inconclusive``.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from reproduce.files import write_json
from reproduce.provenance import record_origin
from reproduce.results import RESULTS, Run, runs_of
from reproduce.statistics import intervals_overlap, wilson

ENOUGH_SEEDS = 5  # one seed each says nothing of the variance between trainings
ENOUGH_TESTS = 1000  # as in the paper; 50 cannot separate 98.6 % from 91.8 %
POSTURES = 20


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

    def words(self) -> str:
        """Figures in words."""
        low, high = self.interval
        return f"{self.method} {100 * self.rate:.1f} % [{100 * low:.1f}, {100 * high:.1f}]"


def pool(method: str, results: Path) -> Pool | None:
    """All evaluated runs of a method, or None."""
    runs = runs_of(method, results)
    return Pool(method, tuple(runs)) if runs else None


def compare(claim: Claim, better: str, worse: str, results: Path) -> Claim:
    """Verdict on: ``better`` succeeds more often than ``worse``."""
    first, second = pool(better, results), pool(worse, results)
    if first is None or second is None:
        missing = " and ".join(name for name, p in ((better, first), (worse, second)) if p is None)
        return _with(claim, evidence=f"no evaluated run of {missing} in results/reference")
    rule = "inconclusive"
    if not intervals_overlap(first.interval, second.interval):
        rule = "verified" if first.rate > second.rate else "contradicted"
    return _judged(claim, first, rule, f"{first.words()} against {second.words()}", first.enough and second.enough)


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


def _c2(results: Path) -> Claim:
    claim = Claim("C2", "HRL-DCS converges slightly faster than FeUdal Networks", "59 h against 67 h")
    return _faster(claim, "hrl_dcs", "fun", results)


def _faster(claim: Claim, first: str, second: str, results: Path) -> Claim:
    ours, theirs = pool(first, results), pool(second, results)
    if ours is None or theirs is None:
        missing = " and ".join(name for name, p in ((first, ours), (second, theirs)) if p is None)
        return _with(claim, evidence=f"no evaluated run of {missing} in results/reference")
    times = [[_steps_to_half(run) for run in p.runs] for p in (ours, theirs)]
    words = f"env steps to half of the final success: {first} {times[0]}, {second} {times[1]}"
    enough = ours.enough and theirs.enough
    separate = max(times[0]) < min(times[1]) or min(times[0]) > max(times[1])
    rule = "inconclusive" if not separate else ("verified" if max(times[0]) < min(times[1]) else "contradicted")
    return _judged(claim, ours, rule, words, enough)


def _steps_to_half(run: Run) -> int:
    curve = run.curve()
    if curve is None:
        return 0
    smooth = curve["success"].rolling(20, min_periods=1).mean()
    reached = np.flatnonzero(smooth >= smooth.iloc[-1] / 2)
    return int(curve["env_steps"].iloc[reached[0]])


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
    c3 = Claim("C3", "HRL-DCS succeeds more often than FeUdal Networks", "98.6 % against 91.8 %")
    c4 = Claim("C4", "AAPF raises success against the contact reward", "98.6 % against 87.3 %")
    c5 = Claim("C5", "HRL-DCS succeeds in 98.6 % of 1000 tests", "98.6 % [97.7, 99.2]")
    c8 = Claim(
        "C8",
        "Tests in a physical environment demonstrate the method",
        "claimed by the abstract, deferred by the conclusion",
        evidence="not testable here: there is no such robot; a second simulator is planned to stand in",
    )
    return [
        compare(c1, "hrl_dcs", "sac", results),
        _c2(results),
        compare(c3, "hrl_dcs", "fun", results),
        compare(c4, "hrl_dcs", "hrl_dcs_no_aapf", results),
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
