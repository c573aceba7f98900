"""How far results depend on the solver: the same scenes under settings from coarse to fine (``docs/environment.md``).

Every actor meets the same scenes under each setting: methods and trained policies, which see what happens, and
plans, which are made once under a setting of their own and replayed without looking. The setting to choose is the
coarsest that agrees with the finest.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch as th
from numpy.typing import NDArray

from lunar_rescue import LunarRescueEnv, Scene, sample_scene
from lunar_rescue.physics.simulation import LUNAR_GRAVITY
from lunar_rescue.physics.solver import CONTROL_STEP, SETTINGS, SolverSettings
from reproduce.baselines.planner.planner import RescuePlanner
from reproduce.experiments.evaluate import find_policy
from reproduce.experiments.pool import map_scenes, scene_seeds
from reproduce.learning.policy import begin_episode
from reproduce.storage.files import check_writable, locked
from reproduce.storage.paths import COMMITTED
from reproduce.storage.provenance import write_table

FOLDER = COMMITTED / "convergence"
PLANS = "plans"
DEEP = 0.010  # m, an overlap of arm and body that a suit's padding would not hide


def _uniform(substep: float, iterations: int) -> SolverSettings:
    return SolverSettings(substep, iterations, substep, iterations)


#: Plans are made under this setting, which is none of those compared, so that no setting has plans chosen for it.
PLANNED_WITH = _uniform(0.005, 75)


#: From coarse to fine; the last one is what the others are compared with.
GRID = (
    _uniform(0.02, 10),
    _uniform(0.02, 20),
    _uniform(0.01, 20),
    SETTINGS,
    _uniform(0.01, 50),
    _uniform(0.005, 50),
    _uniform(0.005, 100),
    _uniform(0.0025, 200),
)

Actions = NDArray[np.float32]
_STATE: dict[str, Any] = {}


def label(settings: SolverSettings) -> str:
    """Return a setting in short, such as ``"20 ms x 10, 10 ms x 50"``: free of the astronaut, and at it, if other."""
    paces = dict.fromkeys((settings.free, settings.fine))
    return ", ".join(f"{1000 * pace.substep:g} ms x {pace.iterations}" for pace in paces)


def _prepare(actors: Sequence[str], grid: Sequence[SolverSettings]) -> None:
    th.set_num_threads(1)
    _STATE["environments"] = {label(settings): LunarRescueEnv(solver=settings) for settings in grid}
    _STATE["policies"] = {actor: find_policy(actor)[1] for actor in actors if actor != PLANS}
    _STATE["planner"] = RescuePlanner(solver=PLANNED_WITH) if PLANS in actors else None


def _test(seed: int, actors: Sequence[str]) -> list[dict[str, Any]]:
    scene, rows = sample_scene(seed), []
    plan = _STATE["planner"].plan(scene).actions if PLANS in actors else np.zeros((0, 11), np.float32)
    for actor in actors:
        for name, env in _STATE["environments"].items():
            policy = _STATE["policies"].get(actor)
            rows.append({"actor": actor, "setting": name, "seed": seed, **_run(env, scene, policy, plan)})
    return rows


def _run(env: LunarRescueEnv, scene: Scene, policy: Any, plan: Actions) -> dict[str, Any]:
    """Act one scene out and return how it ended, overlaps of arm and body, and what a step took."""
    observation = begin_episode(env, policy, scene) if policy else env.reset_flat(options={"scene": scene})[0]
    info: dict[str, Any] = {}
    start, overlaps, seconds, done = np.array([True]), [], 0.0, False
    replayed: Iterator[Actions] = iter(plan)
    while not done:
        action = next(replayed, None) if policy is None else policy.act(observation[None], start)[0]
        if action is None:
            break
        before, begun = env.episode.body, time.perf_counter()
        observation, _, terminated, truncated, info = env.step_flat(action)
        seconds += time.perf_counter() - begun
        start, done = np.array([False]), terminated or truncated
        depths = env.simulation.overlaps(env.robot.handle, env.episode.astronaut.handle)
        overlaps += [max(depths)] if depths else []
    balance, success = np.nan, bool(info.get("is_success", False))
    if success and scene.task == "lift":
        # Of the last step: what the arms bore, less weight and what the body gained, in weights.
        borne = (
            env.episode.forces.sum(axis=0) / scene.mass - (env.episode.body.velocity - before.velocity) / CONTROL_STEP
        )
        balance = float(borne @ scene.terrain.up() - LUNAR_GRAVITY) / LUNAR_GRAVITY
    return {
        "task": scene.task,
        "posture": scene.posture,
        "success": success,
        "failure": info.get("failure"),
        "steps": env.episode.steps,
        "contact_steps": len(overlaps),
        "deep_steps": sum(depth > DEEP for depth in overlaps),
        "deepest": max(overlaps, default=0.0),
        "balance": balance,
        "peak_force": env.episode.peak_force,
        "step_us": round(1e6 * seconds / max(1, env.episode.steps)),
    }


def summarise_convergence(rows: pd.DataFrame, finest: str = label(GRID[-1])) -> pd.DataFrame:
    """Return a row an actor and setting: success, lost and gained against the finest, overlaps, balance, cost."""
    best = rows[rows["setting"] == finest].set_index(["actor", "seed"])["success"]
    table = []
    for (actor, setting), group in rows.groupby(["actor", "setting"], sort=False):
        success = group.set_index("seed")["success"]
        reference = best.xs(actor).reindex(success.index)
        lifts = group["task"] == "lift"
        table.append(
            {
                "actor": actor,
                "setting": setting,
                "scenes": len(group),
                "success": success.mean(),
                "lifts": group.loc[lifts, "success"].mean(),
                "turns": group.loc[~lifts, "success"].mean(),
                "lost": int((~success & reference).sum()),
                "gained": int((success & ~reference).sum()),
                "deep_share": group["deep_steps"].sum() / max(1, group["contact_steps"].sum()),
                "deepest_median_mm": 1000 * group["deepest"].median(),
                "balance_error_median": group["balance"].abs().median(),
                "step_us_median": group["step_us"].median(),
            }
        )
    return pd.DataFrame(table)


def measure_convergence(
    actors: Sequence[str],
    tests: int,
    first_seed: int,
    *,
    grid: Sequence[SolverSettings] = GRID,
    folder: Path = FOLDER,
    tell: Callable[[str], object] = print,
    quiet: bool = False,
) -> pd.DataFrame:
    """Run every actor on the same scenes under each setting of ``grid``; write ``scenes.csv`` and ``summary.csv``.

    ``actors`` are run folders, methods that do not learn, and ``"plans"``; there are ``tests`` scenes from
    ``first_seed`` on. Returns the summary, a row an actor and setting, and calls ``tell`` with it as text.

    Raises:
        UserError: On numbers out of range, an actor that does not load, or a place that cannot be written.
    """
    seeds = scene_seeds(tests, first_seed)
    for actor in actors:
        if actor != PLANS:
            find_policy(actor)
    table, summary = folder / "scenes.csv", folder / "summary.csv"
    for path in (table, summary):
        check_writable(path)
    with locked(folder, "convergence study"):
        job = partial(_test, actors=tuple(actors))
        nested = map_scenes(job, seeds, _prepare, (tuple(actors), tuple(grid)), title="convergence", quiet=quiet)
        rows = pd.DataFrame([row for scene in nested for row in scene])
        summaries = summarise_convergence(rows, label(grid[-1]))
        write_table(table, rows.round(6))
        write_table(summary, summaries.round(4))
    tell(summaries.round(3).to_string(index=False))
    return summaries
