"""Say in a sentence what a figure or table of a notebook shows, with its numbers; and what is missing where it is."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd

from reproduce.analysis.claims import Claim, compute_claims
from reproduce.analysis.runs import PAPER_STEPS, Run
from reproduce.analysis.tables import by_condition, paired_differences
from reproduce.analysis.trainings import read_pools, smooth, steps_to
from reproduce.experiments.methods import METHODS
from reproduce.storage.paths import RESULTS

NO_RUN = "No reference run of this version of the environment has it yet."
NO_PAIRS = "No two runs tested on the same scenes yet, so nothing can be compared in pairs."


def table_or_missing(table: pd.DataFrame, missing: str = NO_RUN) -> pd.DataFrame | None:
    """Return a table for a notebook to show; of one without rows, print what is missing, if told, and return None."""
    if table.empty and missing:
        print(missing)
    return None if table.empty else table


def tell_curves(runs: Sequence[Run]) -> str:
    """Say how each training ended, and when it rescued 90 %."""
    lines = []
    for run in runs:
        if (curve := run.curve()) is None:
            continue
        last, steps = curve.iloc[-1], steps_to(curve, 0.9)
        flat = f"at 90 % after {steps:,.0f} steps" if math.isfinite(steps) else "90 % not reached"
        success = (
            f"{100 * smooth(curve['success']).iloc[-1]:.0f} % rescued while exploring, " if "success" in curve else ""
        )
        lines.append(f"{run.label}: {last['env_steps']:,.0f} steps; {success}{flat}.")
    return "\n".join(lines) or NO_RUN


def tell_trials(table: pd.DataFrame) -> str:
    """Say which of several short trainings got both arms under most often in the end."""
    ends = table.groupby("trial")["both_arms_under"].apply(lambda values: float(smooth(values).iloc[-1]))
    name, best = str(ends.idxmax()).replace("_", " "), 100 * ends.max()
    return f"Of {len(ends)} trials, {name} ended highest: both arms under in {best:.0f} % of rescues while exploring."


def tell_success(results: Path = RESULTS) -> str:
    """Say what share of the test scenes each method rescues, beside the paper's figure where it has one."""
    lines = []
    for name, pool in read_pools(results).items():
        paper = METHODS[name].paper_success
        beside = f", the paper {100 * paper:.1f} %" if paper else ""
        count = f"{len(pool.rows):,} tests of {len(pool.runs)} training{'s' if len(pool.runs) > 1 else ''}"
        lines.append(f"{METHODS[name].title}: {pool.rate_words} of {count}{beside}.")
    return "\n".join(lines) or NO_RUN


def tell_differences(results: Path = RESULTS) -> str:
    """Say against how many runs HRL-DCS is ahead or behind on the same test scenes, beyond doubt."""
    table = paired_differences(results)
    if table.empty:
        return NO_PAIRS
    ahead, behind = int((table["low"] > 0).sum()), int((table["high"] < 0).sum())
    return (
        f"On test scenes HRL-DCS is ahead of {ahead} of {len(table)} runs and behind {behind}; "
        f"of {len(table) - ahead - behind} the interval holds zero."
    )


def tell_failures(runs: Sequence[Run]) -> str:
    """Say what each run fails by most often."""
    lines = []
    for run in runs:
        if (summary := run.evaluation) and summary["failures"]:
            word, count = max(summary["failures"].items(), key=lambda item: item[1])
            share = 100 * count / summary["tests"]
            lines.append(f"{run.label} fails most often by {word.replace('_', ' ')}, in {share:.0f} % of its tests.")
    return "\n".join(lines) or NO_RUN


def tell_weakest(tested: Mapping[str, pd.DataFrame]) -> str:
    """Say in which posture and task each method rescues least often; ``tested`` has rows by title."""
    lines = []
    for title, rows in tested.items():
        rates = rows.groupby(["posture", "task"])["success"].mean()
        posture, task = (str(word).replace("_", " ") for word in rates.index[int(rates.to_numpy().argmin())])
        ends = f"{100 * rates.min():.0f} % at the least ({task}, {posture}), {100 * rates.max():.0f} % at the most"
        lines.append(f"{title}: {ends}.")
    return "\n".join(lines) or NO_RUN


def tell_conditions(tested: Mapping[str, pd.DataFrame], of: Sequence[str] = ("task", "ground", "mass", "rocks")) -> str:
    """Say which condition parts each method's tests most: the best and the worst class of it."""
    lines = []
    for title, rows in tested.items():
        success = by_condition(rows)["success"].loc[[*of]]
        spread = success.groupby(level=0).agg(lambda part: part.max() - part.min())
        key = str(spread.idxmax())
        best, worst = success[key].idxmax(), success[key].idxmin()
        rates = f"{100 * success[key, best]:.0f} % at {best}, {100 * success[key, worst]:.0f} % at {worst}"
        lines.append(f"{title} differs most by {key}: {rates}.".replace("_", " "))
    return "\n".join(lines) or NO_RUN


def tell_lengths(table: pd.DataFrame) -> str:
    """Say how long the trainings were, beside the paper's."""
    if table.empty:
        return NO_RUN
    steps, minutes = table["million env steps"], table["minutes"]
    return (
        f"{len(table)} trainings of {steps.min():g} to {steps.max():g} million steps, {minutes.min()} to "
        f"{minutes.max()} minutes; the longest has {100 * steps.max() / 700:.2g} % of the steps that the paper allows."
    )


def tell_tuning(table: pd.DataFrame) -> str:
    """Say how many trials each method had, and the best score of each."""
    groups = table.groupby("method", sort=False)["score"].agg(["size", "max"]).itertuples()
    return "; ".join(f"{name}: {size} trials, best {best:.2f}" for name, size, best in groups) + "."


def tell_missing(*methods: str, results: Path = RESULTS) -> str:
    """Say which of these methods have no evaluated reference run."""
    missing = [METHODS[name].title for name in methods if name not in read_pools(results)]
    return f"No evaluated reference run yet of: {', '.join(missing)}." if missing else "Both are there."


def conclude(*ids: str, results: Path = RESULTS) -> str:
    """Say of these claims, or all, what the paper claims, what came here and what follows, a line each."""
    chosen = [claim for claim in compute_claims(results) if not ids or claim.id in ids]
    return "\n".join(f"{claim.id} {claim.verdict}: {claim.statement}. {figures_of(claim)}" for claim in chosen)


def figures_of(claim: Claim) -> str:
    """Return the paper's figure and ours side by side, in words."""
    scale = 1.0 if claim.id in ("C2", "C6") else 100.0
    unit = {"C2": " of its steps", "C6": " s"}.get(claim.id, " %")
    if claim.measured is None:
        return f"Paper: {claim.paper}; here: not measured."
    ends = "" if claim.low is None else f" [{scale * claim.low:.3g}, {scale * (claim.high or 0.0):.3g}]"
    return f"Paper: {claim.paper}; here: {scale * claim.measured:.3g}{unit}{ends}."


def answer(claims: Sequence[Claim], results: Path = RESULTS) -> list[str]:
    """Say in two sentences whether the paper held."""
    counts = Counter(claim.verdict for claim in claims)
    verdicts = ", ".join(f"{count} {verdict}" for verdict, count in counts.most_common())
    pools = {name: pool for name, pool in read_pools(results).items() if pool.runs[0].origin}
    pool = pools.get("hrl_dcs")
    first = f"Of the paper's {len(claims)} claims, these are the verdicts so far: {verdicts}."
    if pool is None:
        return [first, "No HRL-DCS policy of this version of the environment has been trained and tested yet."]
    paper = 100 * (METHODS["hrl_dcs"].paper_success or 0.0)
    count, steps = len(pool.runs), max(run.env_steps for run in pool.runs) / 1e6
    trained = f"{'one training' if count == 1 else f'{count} trainings'} of {steps:.0f} million steps"
    found = (
        f"HRL-DCS rescues {pool.rate_words} of the test scenes here, after {trained}, where the paper reports "
        f"{paper:.1f} % after up to {PAPER_STEPS / 1e6:.0f} million"
    )
    best = max(pools.values(), key=lambda pool: pool.success[0])
    if best is not pool:
        found += f"; the best that was trained here ({METHODS[best.method].title}) rescues {best.rate_words}"
    return [f"{found}.", first]
