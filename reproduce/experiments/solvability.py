"""Measure what share of scenes can be solved at all: the planner's plans, each acted out in a fresh environment."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import closing
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import pandas as pd

from lunar_rescue import LunarRescueEnv, sample_scene
from reproduce.baselines.planner.planner import VARIANTS, PlannerPolicy, RescuePlanner
from reproduce.experiments.evaluate import run_episode
from reproduce.experiments.pool import map_scenes, scene_seeds
from reproduce.experiments.rows import count_by, wilson
from reproduce.storage.files import check_writable, locked, write_json
from reproduce.storage.paths import COMMITTED
from reproduce.storage.provenance import provenance, write_table

FOLDER = COMMITTED / "solvability"
#: Column of a scene's row and what its share tells.
SHARES = {
    "process1": "both arms under, without contact with rocks",
    "rescued": "whole rescue",
    "first_try_process1": "both arms under with the first way that the collision check let pass",
    "first_try_rescued": "whole rescue with the first way and the first variant, nothing tried out before",
}
GROUPS = ("task", "posture", "pair", "terrain")


def solve_scene(seed: int, planner: RescuePlanner) -> dict[str, Any]:
    """Plan one scene, act the plan out in an environment of its own and return the scene's row."""
    scene = sample_scene(seed)
    policy = PlannerPolicy(planner)
    with closing(LunarRescueEnv()) as env:
        ended = run_episode(env, policy, scene)
    plan, under, rescued = policy.plan, ended["both_arms_under"], ended["success"]
    return {
        **{key: ended[key] for key in ("seed", "task", "posture", "terrain", "rocks", "mass", "steps", "failure")},
        "slope": scene.terrain.slope,
        "process1": int(under),
        "rescued": int(rescued),
        # A first try counts when it was the plan, and the plan did here what it had promised.
        "first_try_process1": int(plan.first_under and under),
        "first_try_rescued": int(plan.first_rescued and rescued),
        "as_planned": int((rescued, under) == (plan.rescued, plan.under)),
        **{key: getattr(plan, key) for key in ("way", "ways_tried", "variants_tried", "variant", "seconds")},
    }


_planner = lru_cache(RescuePlanner)  # one for a worker's life


def _solve(seed: int, variants: int) -> dict[str, Any]:
    return solve_scene(seed, _planner(variants))


def summarise_solvability(scenes: pd.DataFrame) -> dict[str, Any]:
    """Summarise rows as from ``solve_scene``: shares with 95 % Wilson intervals, groups, and the time a scene takes."""
    paired = scenes.assign(pair=scenes["posture"] + " " + scenes["task"])
    return {
        "tests": len(scenes),
        "shares": {column: {"meaning": meaning, **_share(scenes[column])} for column, meaning in SHARES.items()},
        "by_group": {
            column: {key: count_by(paired, key, column) for key in GROUPS} for column in ("process1", "rescued")
        },
        "as_planned": int(scenes["as_planned"].sum()),
        "ways": scenes["way"].value_counts().to_dict(),
        "failures": scenes["failure"].value_counts().to_dict(),
        "mean_steps": float(scenes["steps"].mean()),
        "mean_variants_tried": float(scenes["variants_tried"].mean()),
        "planning_seconds_per_scene": float(scenes["seconds"].mean()),
        "longest_planning_seconds": float(scenes["seconds"].max()),
    }


def _share(successes: pd.Series[int]) -> dict[str, float]:
    count, tests = int(successes.sum()), len(successes)
    low, high = wilson(count, tests)
    return {"scenes": count, "share": count / tests, "wilson_low": low, "wilson_high": high}


def measure_solvability(
    tests: int,
    first_seed: int = 0,
    *,
    variants: int = VARIANTS,
    json: Path | None = None,
    folder: Path = FOLDER,
    quiet: bool = False,
) -> dict[str, Any]:
    """Plan scenes and write ``scenes.csv``, a row a scene, and ``summary.json``, computed from it.

    Args:
        tests: Number of scenes.
        first_seed: Seed of the first one.
        variants: Most lifts or turns tried out for a scene.
        json: Also write the summary to this file.
        folder: Where the two files go.
        quiet: No progress bar.

    Returns:
        The summary.

    Raises:
        UserError: On numbers out of range or a place that cannot be written, before any scene is planned.
    """
    begun, seeds = time.monotonic(), scene_seeds(tests, first_seed)
    RescuePlanner(variants)  # a bad cap fails here, in one line, and not in a worker
    table, summaries = folder / "scenes.csv", [folder / "summary.json", *filter(None, [json])]
    for path in [table, *summaries]:
        check_writable(path)
    with locked(folder, "results of the planner"):
        rows = map_scenes(partial(_solve, variants=variants), seeds, title="planner", quiet=quiet)
        scenes = pd.DataFrame(rows).round(3)
        took = {"seconds": round(time.monotonic() - begun, 2), "origin": provenance()}
        summary = {"first_seed": first_seed, "most_variants": variants} | summarise_solvability(scenes) | took
        write_table(table, scenes)
        for path in summaries:
            write_json(path, summary)
    return summary


def print_solvability(summary: dict[str, Any], tell: Callable[[str], object]) -> None:
    """Print shares and weak spots, a line each, with ``tell``."""
    for share in summary["shares"].values():
        rate, low, high = (100 * share[key] for key in ("share", "wilson_low", "wilson_high"))
        tell(f"{share['meaning']}: {share['scenes']} of {summary['tests']}, {rate:.1f} % [{low:.1f}, {high:.1f}]")
    tell(f"{summary['planning_seconds_per_scene']:.2f} s a scene to plan; ways {summary['ways']}")
    for name, counts in summary["by_group"]["rescued"]["pair"].items():
        if counts["successes"] < counts["tests"]:
            tell(f"  {name}: {counts['successes']} of {counts['tests']}")
