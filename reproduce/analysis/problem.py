"""Put the problem into tables for notebook 1: joints, splits, a random episode, its end, what a script does."""

from collections.abc import Mapping
from contextlib import closing
from typing import Any

import numpy as np
import pandas as pd

from lunar_rescue import LunarRescueEnv, sample_scene, tasks
from lunar_rescue.physics.robot import JOINTS
from lunar_rescue.scenes.splits import SPLITS
from reproduce.analysis.runs import runs_of
from reproduce.storage.paths import COMMITTED

DRAWN = 200  # scenes of each split that are looked at
#: The constants by which episodes end, and what they are.
ENDINGS = {
    "MAX_STEPS": "steps at most",
    "TARGET_RADIUS": "an arm is under within [m]",
    "LIFT_HEIGHT": "lifted by [m]",
    "LIFT_TILT": "tilted by at most [deg]",
    "LIFT_ROLL": "rolled by at most [deg]",
    "BACK_ANGLE": "on the back within [deg]",
    "HOLD_STEPS": "held for steps",
    "LOST_DISTANCE": "out of reach, in process 1, then 2, if moved by [m]",
}


def joint_table(env: LunarRescueEnv) -> pd.DataFrame:
    """Return each joint's angle at a = -1, 0 and 1 [deg], and its limits of torque [N m] and speed [rad/s]."""
    robot = env.robot
    reached = {a: np.degrees(robot.joint_targets(np.full(JOINTS, float(a)))).round(1) for a in (-1, 0, 1)}
    angles = {f"q at a = {a:+d} [deg]": q for a, q in reached.items()}
    limits = {"torque [N m]": robot.torque_limits, "speed [rad/s]": np.round(robot.speed_limits, 2)}
    return pd.DataFrame({**angles, **limits}, [name.replace("_", " ") for name in robot.names])


def split_table() -> pd.DataFrame:
    """Return a row a split: its seeds, and what the first ``DRAWN`` of its scenes hold."""
    rows = {}
    for name, seeds in SPLITS.items():
        some = [sample_scene(seeds.start + k) for k in range(DRAWN)]
        rows[name] = {
            "seeds": f"{seeds.start:,} to {seeds.stop - 1:,}",
            "postures": len({s.posture for s in some}),
            "rough ground": f"{100 * np.mean([s.terrain.rough for s in some]):.0f} %",
            "rocks, mean": f"{np.mean([len(s.rocks) for s in some]):.1f}",
            "astronaut with suit [kg]": f"{min(s.mass for s in some):.0f} to {max(s.mass for s in some):.0f}",
        }
    return pd.DataFrame(rows).T.rename_axis("split")


def random_episode(seed: int) -> tuple[pd.DataFrame, dict[str, Any]]:
    """Act at random in the scene of a seed; return each step's reward with its terms, and the last ``info``."""
    rng, rows, done = np.random.default_rng(seed), [], False
    with closing(LunarRescueEnv()) as env:
        env.reset_flat(seed=seed)
        while not done:
            _, reward, terminated, truncated, info = env.step_flat(rng.uniform(-1, 1, JOINTS).astype(np.float32))
            rows.append({"reward": reward} | info["reward_terms"])
            done = terminated or truncated
    return pd.DataFrame(rows), info


def ending_table() -> pd.DataFrame:
    """Return the constants by which episodes end; angles are in degrees."""
    rows = {}
    for name, meaning in ENDINGS.items():
        value = getattr(tasks, name)
        if isinstance(value, dict):
            value = ", then ".join(map(str, value.values()))  # process 1, process 2
        rows[meaning] = {"value": round(float(np.degrees(value)), 1) if "[deg]" in meaning else value, "constant": name}
    return pd.DataFrame(rows, dtype=object).T


def posture_table(by_posture: Mapping[str, Mapping[str, int]], most: int = 6) -> pd.DataFrame:
    """Return the ``most`` postures that an evaluation failed in most often, with tests and failures."""
    table = pd.DataFrame(by_posture).T
    table["failed"] = table["tests"] - table["successes"]
    ranked = table.sort_values("failed", ascending=False, kind="stable").head(most)
    return ranked.rename(index=lambda name: str(name).replace("_", " ")).rename_axis("posture")


def tell_script() -> str:
    """Say of how many pairs of posture and task the script's reference tests hold a rescue."""
    for run in runs_of("scripted", COMMITTED):
        if (rows := run.rows()) is not None:
            pairs = rows.groupby(["posture", "task"])["success"].sum()
            rescued = f"{(pairs > 0).sum()} of {len(pairs)} pairs of posture and task"
            return f"In {len(rows):,} reference tests the script rescues somebody in {rescued}."
    return "The script's reference tests are not in results/reference yet."


def solvable_table() -> pd.DataFrame | str:
    """Return which share of the test scenes can be solved, or in words that nobody has measured it."""
    summary = COMMITTED / "solvability" / "summary.json"
    if not summary.is_file():
        return "not measured yet: reproduce solvable --split test"
    solved = pd.read_json(summary, orient="index", typ="series")
    shares = pd.DataFrame(solved["shares"]).T.set_index("meaning")
    percents = {f"{name} [%]": (100 * shares[name].astype(float)).round(1) for name in shares if name != "scenes"}
    return pd.DataFrame({"scenes": shares["scenes"], **percents}).assign(tests=solved["tests"])
