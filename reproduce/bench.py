"""Speed, measured: every figure with what it is compared to in the same run."""

from __future__ import annotations

import os
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lunar_rescue import LunarRescueEnv, sample_scene
from lunar_rescue.robot import JOINTS
from reproduce.config import PRESETS
from reproduce.provenance import provenance
from reproduce.registry import METHODS
from reproduce.sampling import WorkerVecEnv
from reproduce.training import train

EPISODES, BATCH_STEPS = 60, 200
HOLD = 10  # steps for which a random action is held, so that the arms get somewhere


def measure() -> dict[str, Any]:
    """The figures of ``bench --json``, flat."""
    one = _one_environment()
    return {
        **one,
        "env_steps_per_s_all": round(_all_environments(), 1),
        "training_steps_per_s": round(_training(), 1),
        "cores": len(os.sched_getaffinity(0)),
        "origin": provenance(),
    }


def _one_environment() -> dict[str, Any]:
    """Steps a second of one process with everything on, the share inside PyBullet's step, a reset in steps."""
    env = LunarRescueEnv()
    rng = np.random.default_rng(0)
    inside = 0.0
    advance = env.simulation.advance

    def timed(substeps: int) -> None:
        nonlocal inside
        begun = time.perf_counter()
        advance(substeps)
        inside += time.perf_counter() - begun

    env.simulation.advance = timed  # type: ignore[method-assign]
    stepping = resetting = 0.0
    steps = 0
    for seed in range(EPISODES):
        scene = sample_scene(seed)
        begun = time.perf_counter()
        env.reset_flat(options={"scene": scene})
        resetting += time.perf_counter() - begun
        done = False
        while not done:
            if steps % HOLD == 0:
                action = rng.uniform(-1, 1, JOINTS)
            begun = time.perf_counter()
            *_, terminated, truncated, _ = env.step_flat(action)
            stepping += time.perf_counter() - begun
            steps, done = steps + 1, terminated or truncated
    env.close()
    return {
        "env_steps_per_s_1": round(steps / stepping, 1),
        "share_in_physics": round(inside / stepping, 3),
        "reset_in_steps": round((resetting / EPISODES) / (stepping / steps), 2),
    }


def _all_environments(count: int = 16) -> float:
    venv = WorkerVecEnv(count, seed=0)
    rng = np.random.default_rng(0)
    try:
        venv.reset()
        begun = time.perf_counter()
        for step in range(BATCH_STEPS):
            if step % HOLD == 0:
                actions = rng.uniform(-1, 1, (count, JOINTS)).astype(np.float32)
            venv.step(actions)
        return BATCH_STEPS * count / (time.perf_counter() - begun)
    finally:
        venv.close()


def _training() -> float:
    config = replace(PRESETS["laptop"], steps=12 * 2048)
    with tempfile.TemporaryDirectory() as folder:
        curve = train(METHODS["hrl_dcs"], config, 0, Path(folder) / "run", "laptop", quiet=True)
    # The first updates hold the start of workers and learners.
    steps, seconds = curve["env_steps"].to_numpy(), curve["seconds"].to_numpy()
    return float((steps[-1] - steps[1]) / (seconds[-1] - seconds[1]))
