"""Statistics of success: intervals and groups."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import binomtest, norm, ttest_1samp

CONFIDENCE = 0.95
CONDITIONS = ("terrain", "mass_class", "rocks")  # of a scene, which not every row tells


def wilson(successes: int, tests: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a success rate; (0, 1) without tests."""
    if not 0 <= successes <= tests:
        raise ValueError(f"wilson: expected 0 <= successes <= tests, got {successes} of {tests}")
    if tests == 0:
        return 0.0, 1.0
    interval = binomtest(successes, tests).proportion_ci(confidence_level=CONFIDENCE, method="wilson")
    return float(interval.low), float(interval.high)


def intervals_overlap(first: tuple[float, float], second: tuple[float, float]) -> bool:
    """Whether two intervals share a point."""
    return first[0] <= second[1] and second[0] <= first[1]


def same_scenes(first: Mapping[str, Any], second: Mapping[str, Any]) -> bool:
    """Whether two evaluations are of the same scenes, so that their tests are pairs."""
    return all(first.get(key) == second.get(key) for key in ("first_seed", "tests"))


def paired_difference(first: str, second: str) -> tuple[float, float, float]:
    """Difference of two success rates on the same scenes, with its 95 % interval.

    Wald's interval for paired proportions with half a test added to each of the four cells, which keeps its level for
    few tests and rates near 0 or 1 (Agresti and Min, Statistics in Medicine 24, 2005).

    Args:
        first: ``outcomes`` of one evaluation, "1" for a rescue and "0" for none, in the order of scenes.
        second: Of the other.

    Returns:
        The rate of ``first`` minus that of ``second``, and the ends of the interval.

    Raises:
        ValueError: Where they are not outcomes of as many tests each.
    """
    if len(first) != len(second) or not first or set(first + second) - {"0", "1"}:
        raise ValueError(f"paired_difference: expected outcomes of the same tests, got {len(first)} and {len(second)}")
    tests = len(first)
    better = sum(a > b for a, b in zip(first, second, strict=True))
    worse = sum(a < b for a, b in zip(first, second, strict=True))
    p, q = (better + 0.5) / (tests + 2), (worse + 0.5) / (tests + 2)
    half = float(norm.ppf(0.5 + CONFIDENCE / 2)) * ((p + q - (p - q) ** 2) / (tests + 2)) ** 0.5
    return (better - worse) / tests, max(-1.0, p - q - half), min(1.0, p - q + half)


def summarise(episodes: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Success, intervals, groups and failures of tests (rows as from ``run_episode``)."""
    tests, successes = len(episodes), sum(bool(e["is_success"]) for e in episodes)
    low, high = wilson(successes, tests)
    return {
        "tests": tests,
        "successes": successes,
        "success_rate": successes / tests if tests else 0.0,
        "outcomes": "".join(str(int(e["is_success"])) for e in episodes),
        "wilson_low": low,
        "wilson_high": high,
        "both_arms_under": sum(bool(e["both_arms_under"]) for e in episodes) / tests if tests else 0.0,
        **nearest_marks(episodes),
        "by_task": count_by(episodes, "task"),
        "by_posture": count_by(episodes, "posture"),
        "by_posture_and_task": count_by(
            ({**e, "pair": f"{e['posture']} {e['task']}"} for e in episodes),
            "pair",
        ),
        **{f"by_{key}": count_by(episodes, key) for key in CONDITIONS if episodes and key in episodes[0]},
        "failures": dict(Counter(str(e["failure"]) for e in episodes if e["failure"] is not None).most_common()),
    }


def nearest_marks(episodes: Sequence[dict[str, Any]]) -> dict[str, list[float | None]]:
    """How near a joint came to a rock's mark points in each test [m], to the millimetre; None in scenes without."""
    if not episodes or "nearest_mark" not in episodes[0]:
        return {}
    found = (e["nearest_mark"] for e in episodes)
    return {"nearest_mark": [None if distance is None else round(float(distance), 3) for distance in found]}


def mean_interval(values: Sequence[float]) -> tuple[float, float, float]:
    """Mean with Student's 95 % interval; of differences of pairs, that of a paired t-test.

    Raises:
        ValueError: Where there are not two values at least.
    """
    if len(values) < 2:
        raise ValueError(f"mean_interval: expected two values at least, got {len(values)}")
    interval = ttest_1samp(values, 0.0).confidence_interval(CONFIDENCE)
    return float(np.mean(values)), float(interval.low), float(interval.high)


def count_by(episodes: Iterable[dict[str, Any]], key: str) -> dict[str, dict[str, int]]:
    """Tests and successes by the value of a key."""
    table = pd.DataFrame(list(episodes), columns=[key, "is_success"])
    grouped = table.groupby(key)["is_success"].agg(["size", "sum"])
    return {str(name): {"tests": int(row["size"]), "successes": int(row["sum"])} for name, row in grouped.iterrows()}
