"""What share of scenes can be solved at all: the planner's plans, each acted out in a fresh environment."""

from __future__ import annotations

import multiprocessing
import os
import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from tqdm.auto import tqdm

from lunar_rescue import LunarRescueEnv, sample_scene
from reproduce.analysis.intervals import count_by, wilson
from reproduce.baselines.planner.planner import VARIANTS, RescuePlanner
from reproduce.baselines.planner.policy import PlannerPolicy
from reproduce.experiments.evaluate import run_episode
from reproduce.storage.errors import UserError
from reproduce.storage.files import write_atomically, write_json
from reproduce.storage.paths import COMMITTED
from reproduce.storage.provenance import provenance, record_origin

FOLDER = COMMITTED / "solvability"
#: Column of a scene's row and what its share tells.
SHARES = {
    "process1": "both arms under, without contact with rocks",
    "rescued": "whole rescue",
    "first_try_process1": "both arms under with the first way that the collision check let pass",
    "first_try_rescued": "whole rescue with the first way and the first variant, nothing tried out before",
}
_STATE: dict[str, Any] = {}


def solve_scene(seed: int, planner: RescuePlanner) -> dict[str, Any]:
    """Plan one scene, act the plan out in an environment of its own and return a row about it."""
    scene = sample_scene(seed)
    policy, env = PlannerPolicy(planner), LunarRescueEnv()
    try:
        ended = run_episode(env, policy, scene)
    finally:
        env.close()
    plan = policy.plan
    assert plan is not None
    return {
        "seed": seed,
        "task": scene.task,
        "posture": scene.posture,
        "terrain": str(getattr(scene.terrain, "kind", scene.terrain)),
        "slope": round(float(getattr(scene.terrain, "slope", 0.0)), 3),
        "rocks": len(scene.rocks),
        "mass": round(scene.mass, 2),
        "process1": int(ended["both_arms_under"]),
        "rescued": int(ended["is_success"]),
        # A first try counts when it was the plan, and the plan did here what it had promised.
        "first_try_process1": int(plan.first_under and ended["both_arms_under"]),
        "first_try_rescued": int(plan.first_rescued and ended["is_success"]),
        "as_planned": int(bool(ended["is_success"]) == plan.rescued and bool(ended["both_arms_under"]) == plan.under),
        "way": plan.way,
        "ways_tried": plan.ways_tried,
        "variants_tried": plan.variants_tried,
        "variant": plan.variant,
        "steps": ended["steps"],
        "failure": ended["failure"] or "",
        "seconds": round(plan.seconds, 3),
    }


def _prepare(variants: int) -> None:
    _STATE["planner"] = RescuePlanner(variants)


def _solve(seed: int) -> dict[str, Any]:
    return solve_scene(seed, _STATE["planner"])


def solve_scenes(
    tests: int, first_seed: int = 0, *, variants: int = VARIANTS, workers: int | None = None, quiet: bool = False
) -> list[dict[str, Any]]:
    """One row a scene, in the order of seeds, in as many processes as there are cores.

    Raises:
        UserError: On numbers out of range.
    """
    if tests < 1:
        raise UserError(f"tests: expected at least 1, got {tests}")
    if first_seed < 0:
        raise UserError(f"first seed: expected at least 0, got {first_seed}")
    RescuePlanner(variants)  # a bad cap fails here, in one line, and not in a worker
    workers = workers or len(os.sched_getaffinity(0))
    context = multiprocessing.get_context("forkserver")
    try:
        with ProcessPoolExecutor(workers, context, _prepare, (variants,)) as pool:
            answers = pool.map(_solve, range(first_seed, first_seed + tests), chunksize=4)
            return list(tqdm(answers, total=tests, unit="scene", disable=quiet, desc="planner"))
    except BrokenProcessPool:
        raise UserError("planner: a process died") from None


def summarise_solvability(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Shares with Wilson intervals, by task, posture and terrain, and the time a scene takes."""
    tests = len(rows)
    shares = {}
    for column, meaning in SHARES.items():
        count = sum(row[column] for row in rows)
        low, high = wilson(count, tests)
        share = {"meaning": meaning, "scenes": count, "share": count / tests if tests else 0.0}
        shares[column] = {**share, "wilson_low": low, "wilson_high": high}
    judged = [{**row, "pair": f"{row['posture']} {row['task']}"} for row in rows]
    groups = {
        column: {
            key: count_by([{**row, "is_success": row[column]} for row in judged], key)
            for key in ("task", "posture", "pair", "terrain")
        }
        for column in ("process1", "rescued")
    }
    seconds = [row["seconds"] for row in rows]
    return {
        "tests": tests,
        "shares": shares,
        "by_group": groups,
        "as_planned": sum(row["as_planned"] for row in rows),
        "ways": dict(Counter(row["way"] for row in rows).most_common()),
        "failures": dict(Counter(row["failure"] for row in rows if row["failure"]).most_common()),
        "mean_steps": float(np.mean([row["steps"] for row in rows])) if rows else 0.0,
        "mean_variants_tried": float(np.mean([row["variants_tried"] for row in rows])) if rows else 0.0,
        "planning_seconds_per_scene": float(np.mean(seconds)) if rows else 0.0,
        "longest_planning_seconds": float(max(seconds, default=0.0)),
    }


def measure_solvability(
    tests: int,
    first_seed: int = 0,
    *,
    variants: int = VARIANTS,
    json: Path | None = None,
    folder: Path = FOLDER,
    quiet: bool = False,
) -> dict[str, Any]:
    """Plan scenes and write ``scenes.csv`` and ``summary.json``.

    Args:
        tests: Number of scenes.
        first_seed: Seed of the first one.
        variants: Most lifts or turns tried out for a scene.
        json: Also write the summary to this file.
        folder: Where the two files go.
        quiet: No progress bar.

    Returns:
        The summary.
    """
    begun = time.monotonic()
    rows = solve_scenes(tests, first_seed, variants=variants, quiet=quiet)
    summary = {
        "first_seed": first_seed,
        "most_variants": variants,
        **summarise_solvability(rows),
        "seconds": round(time.monotonic() - begun, 2),
        "origin": provenance(),
    }
    table = pd.DataFrame(rows)
    write_atomically(folder / "scenes.csv", lambda path: table.to_csv(path, index=False, lineterminator="\n"))
    record_origin(folder / "scenes.csv")
    for path in [folder / "summary.json", *([json] if json else [])]:
        write_json(path, summary)
    return summary


def print_solvability(summary: dict[str, Any], tell: Callable[[str], object]) -> None:
    """Print shares and weak spots."""
    for share in summary["shares"].values():
        rate, low, high = (100 * share[key] for key in ("share", "wilson_low", "wilson_high"))
        tell(f"{share['meaning']}: {share['scenes']} of {summary['tests']}, {rate:.1f} % [{low:.1f}, {high:.1f}]")
    tell(f"{summary['planning_seconds_per_scene']:.2f} s a scene to plan; ways {summary['ways']}")
    for name, counts in summary["by_group"]["rescued"]["pair"].items():
        if counts["successes"] < counts["tests"]:
            tell(f"  {name}: {counts['successes']} of {counts['tests']}")
