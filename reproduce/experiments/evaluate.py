"""Tests a policy on scenes by seed, one scene at a time in as many processes as there are cores.

Every method meets the same scenes, and the result of a scene does not depend on which others are tested beside it.
"""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from tqdm.auto import tqdm

from lunar_rescue import LunarRescueEnv, Scene, sample_scene
from lunar_rescue.env import OUTCOME
from lunar_rescue.scenes.scene import MASS_RANGE
from lunar_rescue.scenes.splits import split_of
from reproduce.analysis.intervals import summarise
from reproduce.experiments.methods import METHODS, Method, load_policy
from reproduce.hrl_dcs.ablation import ablated
from reproduce.learning.policy import Policy
from reproduce.learning.workers import easy_scene
from reproduce.storage.errors import UserError
from reproduce.storage.processes import map_in_processes
from reproduce.storage.provenance import provenance

_STATE: dict[str, Any] = {}


def find_policy(where: str | Path, ablation: str | None = None) -> tuple[Method, Policy]:
    """Load the policy of a run folder, or of a method that does not learn by its name; see ``hrl_dcs.ablation``."""
    name = str(where)
    if name in METHODS and METHODS[name].train is None and not Path(where).exists():
        method, policy = METHODS[name], METHODS[name].act(0)
    else:
        method, policy = load_policy(Path(where))
    return method, policy if ablation is None else ablated(policy, ablation, method.name)


def run_episode(env: LunarRescueEnv, policy: Policy, scene: Scene) -> dict[str, Any]:
    """One rescue; return how it ended."""
    observation, info = env.reset_flat(options={"scene": scene})
    if hasattr(policy, "prepare"):  # the planner knows the scene
        policy.prepare(scene)
    start, total, done = np.array([True]), 0.0, False
    while not done:
        action = policy.act(observation[None], start)[0]
        observation, reward, terminated, truncated, last = env.step_flat(action)
        start, total, done = np.array([False]), total + reward, terminated or truncated
    kept = {key: last[key] for key in OUTCOME}
    return {
        "seed": info["scene"].seed,
        **kept,
        "steps": env.episode.steps,
        "return": total,
        "mass": scene.mass,
        "mass_class": mass_class(scene.mass),
        "terrain": scene.terrain.kind,
        "rocks": len(scene.rocks),
        "nearest_mark": env.episode.nearest_mark if scene.rocks else None,
    }


def mass_class(mass: float) -> str:
    """The third of the mass range that a mass [kg] lies in."""
    low, high = MASS_RANGE
    edges = np.linspace(low, high, 4).round().astype(int)
    index = min(int(3 * (mass - low) / (high - low)), 2)
    return f"{edges[index]} to {edges[index + 1]} kg"


def _prepare(where: str, ablation: str | None) -> None:
    th.set_num_threads(1)
    _STATE["env"] = LunarRescueEnv()
    _STATE["policy"] = find_policy(where, ablation)[1]


def _test(seed: int, posture: str | None, task: str | None, easy: bool) -> dict[str, Any]:
    if hasattr(_STATE["policy"], "reseed"):
        _STATE["policy"].reseed(seed)
    scene = easy_scene(seed) if easy else sample_scene(seed, posture=posture, task=task)
    return run_episode(_STATE["env"], _STATE["policy"], scene)


def rescue_scenes(
    where: str | Path,
    tests: int,
    first_seed: int = 0,
    workers: int | None = None,
    quiet: bool = False,
    posture: str | None = None,
    task: str | None = None,
    ablation: str | None = None,
    easy: bool = False,
) -> list[dict[str, Any]]:
    """Test a policy; one row a scene, in the order of seeds.

    Raises:
        UserError: On numbers out of range or a run folder that does not load.
    """
    if tests < 1:
        raise UserError(f"tests: expected at least 1, got {tests}")
    if first_seed < 0:
        raise UserError(f"first seed: expected at least 0, got {first_seed}")
    if split_of(first_seed) != split_of(first_seed + tests - 1):
        raise UserError(
            f"first seed {first_seed}, tests {tests}: the scenes belong to {split_of(first_seed)} and "
            f"{split_of(first_seed + tests - 1)}; choose seeds of one split"
        )
    find_policy(where, ablation)  # a bad run folder fails here, in one line, and not in a worker
    job = partial(_test, posture=posture, task=task, easy=easy)
    answers = map_in_processes(job, range(first_seed, first_seed + tests), workers, _prepare, (str(where), ablation))
    return list(tqdm(answers, total=tests, unit="test", disable=quiet, desc=Path(where).name))


def evaluate(
    where: str | Path,
    tests: int,
    first_seed: int = 0,
    quiet: bool = False,
    ablation: str | None = None,
    easy: bool = False,
) -> dict[str, Any]:
    """What ``evaluation.json`` holds."""
    method, _ = find_policy(where, ablation)
    begun = time.monotonic()
    rows = rescue_scenes(where, tests, first_seed, quiet=quiet, ablation=ablation, easy=easy)
    seconds = time.monotonic() - begun
    return {
        "method": method.name,
        **({} if ablation is None else {"ablation": ablation}),
        **({"scenes": "easy"} if easy else {}),
        "first_seed": first_seed,
        "split": split_of(first_seed),
        **summarise(rows),
        "mean_return": float(np.mean([row["return"] for row in rows])),
        "mean_steps": float(np.mean([row["steps"] for row in rows])),
        "seconds": round(seconds, 2),
        "seconds_per_test": round(seconds / tests, 4),
        "origin": provenance(),
    }
