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

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
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
CLAIMS = Path(__file__).with_suffix(".yaml")  # what the paper claims, and the rules for it


@dataclass(frozen=True)
class Claim:
    """One claim of the paper with its verdict."""

    id: str  # C1 to C8
    statement: str  # what the paper claims
    paper: str  # its figure
    measured: float | None = None  # ours: a share of tests; C2 a ratio of environment steps, C6 seconds a test
    low: float | None = None  # ends of the interval of ``measured``
    high: float | None = None
    seeds: int = 0  # training seeds behind it
    tests: int = 0  # over all seeds
    env_steps: int = 0  # of the shortest training
    verdict: str = "inconclusive"  # see the module
    evidence: str = ""  # where it comes from, in words with figures


@dataclass(frozen=True)
class Part:
    """One thing that a claim says."""

    words: str  # what the runs show, with figures
    holds: bool | None  # None where the rule leaves it open
    figures: dict[str, Any] = field(default_factory=dict)  # of the claim; without them its first method's success
    one_training: bool = False  # whether enough tests of one training decide it


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
    words = f"return in the end: {_values(first, first.returns, 2)}, {_values(second, second.returns, 2)}{factor}"
    return Part(words, _above(first.returns, [times * value for value in second.returns]))


def converges_faster(first: Pool, second: Pool) -> Part:
    """Judge whether the first converges in fewer environment steps."""
    words = f"env steps to converge: {_values(first, first.steps)}, {_values(second, second.steps)}"
    return Part(words, _above(second.steps, first.steps))


def _above(high: Sequence[float | None], low: Sequence[float | None]) -> bool | None:
    """Return whether all of one lie above all of the other by the margin, below it, or neither."""
    ours, theirs = np.array(high, dtype=float), np.array(low, dtype=float)
    if not ours.size or not theirs.size or np.isnan([*ours, *theirs]).any():
        return None
    margin = MARGIN * np.abs([*ours, *theirs]).max()
    return _lies(above=ours.min() - theirs.max() > margin, below=theirs.min() - ours.max() > margin)


def _values(pool: Pool, values: Sequence[float | None], digits: int = 0) -> str:
    numbers = ", ".join("none" if value is None else f"{value:,.{digits}f}" for value in values)
    return f"{pool.method} {numbers or 'no curve'}"


def converges_in_a_share(first: Pool, second: Pool) -> Part:
    """Judge as ``converges_faster``; the figure is the ratio of mean steps, None where one has not converged."""
    steps = [np.array(pool.steps, dtype=float) for pool in (first, second)]
    both_converge = all(each.size and not np.isnan(each).any() for each in steps)
    ratio = float(steps[0].mean() / steps[1].mean()) if both_converge else None
    return replace(converges_faster(first, second), figures={"measured": ratio, "low": None, "high": None})


def takes_at_most(pool: Pool, most: float) -> Part:
    """Judge whether no evaluation takes longer than so many seconds a test; the figure is their mean."""
    seconds = [run.evaluation["seconds_per_test"] for run in pool.runs if run.evaluation]
    words = f"at most {max(seconds):.3f} s a test over {len(pool.rows)} tests; rule: no slower than the paper"
    figures = {"measured": float(np.mean(seconds)), "low": min(seconds), "high": max(seconds)}
    return Part(words, max(seconds) <= most, figures, one_training=True)


def serves_every_posture(pool: Pool) -> Part:
    """Judge whether the weakest of all postures is served; the figure is its success."""
    counts = pool.rows.groupby("posture")["success"].agg(["mean", "sum", "size"])
    name = min(counts.index, key=lambda posture: (counts["mean"][posture], posture))
    rate, (low, high) = float(counts["mean"][name]), wilson(int(counts["sum"][name]), int(counts["size"][name]))
    serves_all = low >= SERVED and set(counts.index) == set(postures())
    words, figures = f"weakest posture {name}: {percent(rate, (low, high))}", dict(measured=rate, low=low, high=high)
    return Part(words, _lies(above=serves_all, below=high < SERVED), figures)


#: What ``claims.yaml`` may name.
_RULES = (succeeds_more, unsolved, reaches, returns_more, converges_faster, converges_in_a_share, takes_at_most)
RULES: dict[str, Callable[..., Part]] = {rule.__name__: rule for rule in (*_RULES, serves_every_posture)}


def _enough(pool: Pool, one_training: bool) -> bool:
    enough_training = one_training or (len(pool.runs) >= ENOUGH_SEEDS and pool.env_steps >= ENOUGH_STEPS)
    return enough_training and len(pool.rows) >= ENOUGH_TESTS * (1 if one_training else len(pool.runs))


def judge(claim: Claim, parts: list[Part], pools: list[Pool]) -> Claim:
    """Return a claim with the verdict of its parts; without figures of theirs it is the first method's success."""
    ours, holds = pools[0], [part.holds for part in parts]
    rule = "contradicted" if False in holds else ("inconclusive" if None in holds else "verified")
    names = {True: "holds", False: "fails", None: "open"}
    evidence = "; ".join(f"{part.words} ({names[part.holds]})" for part in parts)
    enough = all(_enough(pool, all(part.one_training for part in parts)) for pool in pools)
    if not enough:
        evidence += (
            f"; by the rule alone {rule}; {len(ours.runs)} seed(s) of {ours.env_steps:,} steps, {len(ours.rows)} "
            f"tests; bars {ENOUGH_SEEDS} seeds of {ENOUGH_STEPS:,} steps and {ENOUGH_TESTS} tests"
        )
    success = {"measured": float(ours.rows["success"].mean()), "low": ours.interval[0], "high": ours.interval[1]}
    return replace(
        claim,
        **next((part.figures for part in parts if part.figures), success),
        seeds=len(ours.runs),
        tests=len(ours.rows),
        env_steps=ours.env_steps,
        verdict=rule if enough else "reduced scale",
        evidence=evidence,
    )


def compute_claims(results: Path = RESULTS) -> list[Claim]:
    """Return all claims in order, with their verdicts."""
    pools, verdicts = read_pools(results), []
    for entry in yaml.safe_load(CLAIMS.read_text(encoding="utf-8")):
        methods, rules = entry.pop("methods", []), entry.pop("parts", [])
        claim = Claim(**entry)
        missing = " and ".join(method for method in methods if method not in pools)
        if missing:
            claim = replace(claim, evidence=f"no evaluated run of {missing} in results/reference")
        elif methods:
            parts = [RULES[name](*(pools.get(argument, argument) for argument in rest)) for name, *rest in rules]
            claim = judge(claim, parts, [pools[method] for method in methods])
        verdicts.append(claim)
    return verdicts


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
