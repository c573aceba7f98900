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

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import ttest_ind

from lunar_rescue.scenes.postures import postures
from reproduce.analysis.intervals import paired_difference, same_scenes
from reproduce.analysis.trainings import MARGIN, Pool, percent, read_pools
from reproduce.experiments.rows import CONFIDENCE, wilson
from reproduce.storage.files import write_json
from reproduce.storage.paths import RESULTS
from reproduce.storage.provenance import record_origin

ENOUGH_SEEDS = 5  # one seed each says nothing of the variance between trainings
ENOUGH_TESTS = 1000  # as in the paper; 50 cannot separate 98.6 % from 91.8 %
ENOUGH_STEPS = 5_000_000  # our budget; the paper allows 700 million, stops earlier and does not say where
SERVED = 0.9  # what every posture must reach; the paper gives no figure
UNSOLVED = 0.05  # the paper gives SAC no figure at all
PAPER_SUCCESS = 0.986  # Table 1
PAPER_SECONDS = 0.652  # a test, section 4.3


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
class Part:
    """One thing that a claim says.

    Attributes:
        words: What was found, with figures.
        holds: Whether it is so; None where the rule leaves it open.
    """

    words: str
    holds: bool | None


def succeeds_more(first: Pool, second: Pool) -> Part:
    """Judge whether the first succeeds more often."""
    words = f"success: {first.words()} against {second.words()}"
    if len(first.runs) > 1 and len(second.runs) > 1:
        low, high = ttest_ind(first.rates, second.rates, equal_var=False).confidence_interval(CONFIDENCE)
        kind = "trainings'"
    else:
        ours, theirs = (pool.rows[pool.rows["training"] == pool.runs[0].seed] for pool in (first, second))
        if not same_scenes(ours, theirs):
            return Part(f"{words}, not on the same scenes", None)
        kind, (_, low, high) = "paired", paired_difference(ours["success"], theirs["success"])
    words += f", {kind} difference [{100 * low:+.2f}, {100 * high:+.2f}] points"
    return Part(words, _lies(above=low > 0.0, below=high < 0.0))


def _lies(*, above: bool, below: bool) -> bool | None:
    """Return what holds of a value that lies above a bar, below it or neither."""
    return True if above else (False if below else None)


def unsolved(pool: Pool) -> Part:
    """Judge whether a method does not solve the task."""
    low, high = pool.interval
    words = f"success: {pool.words()}, not solved is below {100 * UNSOLVED:.0f} %"
    return Part(words, _lies(above=high < UNSOLVED, below=low >= UNSOLVED))


def reaches(pool: Pool, level: float) -> Part:
    """Judge whether a method succeeds in this share of the tests."""
    return Part(f"{pool.words()}, paper {100 * level:.1f} %", pool.interval[1] >= level)


def returns_more(first: Pool, second: Pool, times: float = 1.0) -> Part:
    """Judge whether the first one's return in the end is more than so many times the second's."""
    factor = "" if times == 1.0 else f" and {times:g} times as much"
    words = f"return in the end: {_listed(first, first.returns, 2)}, {_listed(second, second.returns, 2)}{factor}"
    return Part(words, _above(first.returns, [times * value for value in second.returns]))


def converges_faster(first: Pool, second: Pool) -> Part:
    """Judge whether the first converges in fewer environment steps."""
    words = f"env steps to converge: {_listed(first, first.steps)}, {_listed(second, second.steps)}"
    return Part(words, _above(second.steps, first.steps))


def _above(high: Sequence[float | None], low: Sequence[float | None]) -> bool | None:
    """Return whether all of one lie above all of the other by the margin, below it, or neither."""
    ours, theirs = np.array(high, dtype=float), np.array(low, dtype=float)
    if not ours.size or not theirs.size or np.isnan([*ours, *theirs]).any():
        return None
    margin = MARGIN * np.abs([*ours, *theirs]).max()
    return _lies(above=ours.min() - theirs.max() > margin, below=theirs.min() - ours.max() > margin)


def _listed(pool: Pool, values: Sequence[float | None], digits: int = 0) -> str:
    told = ", ".join("none" if value is None else f"{value:,.{digits}f}" for value in values)
    return f"{pool.method} {told or 'no curve'}"


def _enough(pool: Pool) -> bool:
    trained = len(pool.runs) >= ENOUGH_SEEDS and pool.env_steps >= ENOUGH_STEPS
    return trained and len(pool.rows) >= ENOUGH_TESTS * len(pool.runs)


def judge(claim: Claim, parts: list[Part], *pools: Pool, enough: bool | None = None, **figures: Any) -> Claim:
    """Return a claim with its verdict.

    Args:
        claim: Without one.
        parts: What it says.
        *pools: Trainings that it rests on; its figure is the success of the first.
        enough: Whether they reach the bars; without it, each one's seeds, steps and tests tell.
        **figures: Fields of the claim that are something else.
    """
    ours, holds = pools[0], [part.holds for part in parts]
    rule = "contradicted" if False in holds else ("inconclusive" if None in holds else "verified")
    names = {True: "holds", False: "fails", None: "open"}
    evidence = "; ".join(f"{part.words} ({names[part.holds]})" for part in parts)
    enough = all(map(_enough, pools)) if enough is None else enough
    if not enough:
        evidence += (
            f"; by the rule alone {rule}; {len(ours.runs)} seed(s) of {ours.env_steps:,} steps, {len(ours.rows)} "
            f"tests; bars {ENOUGH_SEEDS} seeds of {ENOUGH_STEPS:,} steps and {ENOUGH_TESTS} tests"
        )
    found: dict[str, Any] = {
        "measured": float(ours.rows["success"].mean()),
        "low": ours.interval[0],
        "high": ours.interval[1],
        "seeds": len(ours.runs),
        "tests": len(ours.rows),
        "env_steps": ours.env_steps,
        "verdict": rule if enough else "reduced scale",
        "evidence": evidence,
    }
    return replace(claim, **found | figures)


def _convergence(claim: Claim, ours: Pool, theirs: Pool) -> Claim:
    steps = [np.array(pool.steps, dtype=float) for pool in (ours, theirs)]
    known = all(each.size and not np.isnan(each).any() for each in steps)
    ratio = float(steps[0].mean() / steps[1].mean()) if known else None
    return judge(claim, [converges_faster(ours, theirs)], ours, theirs, measured=ratio, low=None, high=None)


def _seconds(claim: Claim, pool: Pool) -> Claim:
    seconds = [run.evaluation["seconds_per_test"] for run in pool.runs if run.evaluation]
    words = f"at most {max(seconds):.3f} s a test over {len(pool.rows)} tests; rule: no slower than the paper"
    part, enough = Part(words, max(seconds) <= PAPER_SECONDS), len(pool.rows) >= ENOUGH_TESTS
    figures = {"measured": float(np.mean(seconds)), "low": min(seconds), "high": max(seconds)}
    return judge(claim, [part], pool, enough=enough, **figures)


def _any_posture(claim: Claim, pool: Pool) -> Claim:
    counts = pool.rows.groupby("posture")["success"].agg(["mean", "sum", "size"])
    name = min(counts.index, key=lambda posture: (counts["mean"][posture], posture))
    rate, (low, high) = float(counts["mean"][name]), wilson(int(counts["sum"][name]), int(counts["size"][name]))
    served = low >= SERVED and set(counts.index) == set(postures())
    part = Part(f"weakest posture {name}: {percent(rate, (low, high))}", _lies(above=served, below=high < SERVED))
    return judge(claim, [part], pool, measured=rate, low=low, high=high)


#: Each claim, the methods that it is about, and the rule.
CLAIMS: list[tuple[Claim, tuple[str, ...], Callable[..., Claim]]] = [
    (
        Claim("C1", "SAC converges faster, to a much lower return, and does not solve the task", "no figure"),
        ("sac", "hrl_dcs"),
        lambda claim, a, b: judge(claim, [converges_faster(a, b), returns_more(b, a, 2.0), unsolved(a)], a, b),
    ),
    (
        Claim("C2", "HRL-DCS converges slightly faster than FeUdal Networks", "59 h against 67 h"),
        ("hrl_dcs", "fun"),
        _convergence,
    ),
    (
        Claim("C3", "HRL-DCS succeeds more often than FeUdal Networks", "98.6 % against 91.8 %"),
        ("hrl_dcs", "fun"),
        lambda claim, a, b: judge(claim, [succeeds_more(a, b)], a, b),
    ),
    (
        Claim(
            "C4",
            "AAPF raises return, speed and success against the contact reward",
            "98.6 % against 87.3 %, 59 h to 86 h",
        ),
        ("hrl_dcs", "hrl_dcs_no_aapf"),
        lambda claim, a, b: judge(claim, [succeeds_more(a, b), returns_more(a, b), converges_faster(a, b)], a, b),
    ),
    (
        Claim("C5", "HRL-DCS succeeds in 98.6 % of 1000 tests", "98.6 % [97.7, 99.2]"),
        ("hrl_dcs",),
        lambda claim, a: judge(claim, [reaches(a, PAPER_SUCCESS)], a),
    ),
    (Claim("C6", "1000 tests take 652 s", f"{PAPER_SECONDS} s a test"), ("hrl_dcs",), _seconds),
    (Claim("C7", "The policy serves any of the 20 postures and any start", "text"), ("hrl_dcs",), _any_posture),
]
#: What no run can tell.
NOT_TESTED = Claim(
    "C8",
    "Tests in a physical environment demonstrate the method",
    "claimed by the abstract, deferred by the conclusion",
    evidence="not testable here: there is no such robot; a second simulator is planned to stand in",
)


def compute_claims(results: Path = RESULTS) -> list[Claim]:
    """Return all claims in order, with their verdicts."""
    pools, judged = read_pools(results), []
    for claim, methods, rule in CLAIMS:
        missing = " and ".join(method for method in methods if method not in pools)
        if missing:
            judged.append(replace(claim, evidence=f"no evaluated run of {missing} in results/reference"))
        else:
            judged.append(rule(claim, *(pools[method] for method in methods)))
    return [*judged, NOT_TESTED]


def write_claims(claims: list[Claim], path: Path | None = None) -> Path:
    """Write ``claims.json``, to results/ unless told otherwise, and return its path."""
    target = path or RESULTS / "claims.json"
    write_json(target, [asdict(claim) for claim in claims])
    record_origin(target)
    return target


def print_claims(claims: list[Claim]) -> None:
    """Print each claim in a line, with its verdict."""
    for c in claims:
        interval = "" if c.low is None else f" [{c.low:.3f}, {c.high:.3f}]"
        measured = "" if c.measured is None else f" {c.measured:.3f}{interval};"
        print(f"{c.id} {c.verdict}: {c.statement} (paper: {c.paper});{measured} {c.evidence}")
