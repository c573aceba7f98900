"""The paper's claims C1 to C8, each with a verdict by rule from what lies in results/. Nothing is typed.

A claim has one part or several. It ``agrees`` when all its parts do, ``differs`` when one does, and else is
``undecided``; so it is without runs, and with fewer than three trainings of a method where trainings could differ.
What cannot be compared is ``not comparable``. How large the experiment was is a column, ``scale``, and no verdict.

- Success of two methods: the 95 % interval of the difference on the same scenes lies above 0. It differs when that
  lies below 0, or within 3 points of it. Not solved is a success whose interval lies below 5 %.
- A success rate (C5): our whole 95 % interval lies within 3 points of the paper's figure (two one-sided tests). It
  differs when the figure lies outside the interval, on whichever side.
- Speed (C1, C2, C4): environment steps until success while training, a mean of 20 updates, reaches 50, 80 and 90 %;
  who has not by the end of the shortest training is counted with its end. The ratio of the methods' means has an
  interval that lies below 1, or above for the contrary.
- Return in the end (of the environment's own reward, over the last twentieth of the updates): Welch's 95 % interval of
  the difference and 0. "Much lower" is less than half.
- Time (C6): simulator and machine are others than the paper's, so our figure stands beside its, not comparable.
- Any posture (C7): each one's 95 % interval lies above 90 %. It differs when a simultaneous one lies below.
- A physical test (C8): a policy keeps 90 % of its success in the other engine and under every disturbance of middle
  severity; intervals as in C7.

Intervals over trainings and scenes are ``success_interval`` and ``success_difference`` of ``intervals.py``. The rules
were fixed before there was any run of this environment; ``reproduce rules`` measures how often they err.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import yaml

from reproduce.analysis.rules import RULES, Part
from reproduce.analysis.trainings import Pool, read_pools
from reproduce.analysis.verdicts import Verdict
from reproduce.experiments.methods import METHODS
from reproduce.storage.files import write_json
from reproduce.storage.paths import RESULTS
from reproduce.storage.provenance import record_origin

CLAIMS = Path(__file__).with_suffix(".yaml")  # what the paper claims, and the rules for it


@dataclass(frozen=True)
class Claim:
    """One claim of the paper with its verdict."""

    id: str  # C1 to C8
    statement: str  # what the paper claims
    paper: str  # its figure
    measured: float | None = None  # ours: a success rate; C2 a ratio of env steps, C6 seconds a test, C8 a share kept
    low: float | None = None  # ends of the interval of ``measured``
    high: float | None = None
    seeds: int = 0  # trainings of the first method
    tests: int = 0  # over all of them
    env_steps: int = 0  # of its shortest training
    scale: str = "no training"  # trainings and steps of every method, beside the paper's
    verdict: Verdict = "undecided"  # see the module
    evidence: str = ""  # where it comes from, in words with figures


def combined(verdicts: Sequence[Verdict]) -> Verdict:
    """Return the verdict of a claim from those of its parts: the first of these words that any part has."""
    order: tuple[Verdict, ...] = ("differs", "undecided", "not comparable", "agrees")
    return next(verdict for verdict in order if verdict in verdicts)


def scale(pools: Sequence[Pool]) -> str:
    """Return how many trainings of how many steps are behind a claim, beside the steps that the paper allows."""
    allowed = METHODS["hrl_dcs"].config("paper").steps
    return "; ".join(
        f"{pool.method} {len(pool.runs)} training{'s' if len(pool.runs) > 1 else ''} of {pool.env_steps:,} steps "
        f"({100 * pool.env_steps / allowed:.2g} % of {allowed / 1e6:.0f} M), {len(pool.scenes)} scenes"
        for pool in pools
    )


def judge(claim: Claim, parts: Sequence[Part], pools: Sequence[Pool]) -> Claim:
    """Return a claim with the verdict of its parts; without figures of theirs it is the first method's success."""
    ours = pools[0]
    success = dict(zip(("measured", "low", "high"), ours.success, strict=True))
    return replace(
        claim,
        **next((part.figures for part in parts if part.figures), success),
        seeds=len(ours.runs),
        tests=len(ours.rows),
        env_steps=ours.env_steps,
        scale=scale(pools),
        verdict=combined([part.verdict for part in parts]),
        evidence="; ".join(f"{part.words} ({part.verdict})" for part in parts),
    )


def compute_claims(results: Path = RESULTS) -> list[Claim]:
    """Return all claims in order, with their verdicts."""
    pools, verdicts = read_pools(results), []
    for entry in yaml.safe_load(CLAIMS.read_text(encoding="utf-8")):
        methods, rules = entry.pop("methods"), entry.pop("parts")
        claim = Claim(**entry)
        if missing := " and ".join(method for method in methods if method not in pools):
            verdicts.append(replace(claim, evidence=f"no evaluated run of {missing} in results/reference"))
            continue
        parts = [RULES[name](*(pools.get(argument, argument) for argument in rest)) for name, *rest in rules]
        verdicts.append(judge(claim, parts, [pools[method] for method in methods]))
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
        print(f"{c.id} {c.verdict}: {c.statement} (paper: {c.paper});{measured} {c.evidence}; {c.scale}")
