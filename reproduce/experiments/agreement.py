"""How far two simulators agree: the planner's plans, done without looking, in each of them (C8).

Plans are made in PyBullet as the environment has it, and replayed there (which must succeed again), in PyBullet with a
finer solver, and in MuJoCo with its own settings and with a finer and a coarser one; past its end, the last action of a
plan goes on until the body rests or time is up. A replay is open loop, so that two
settings of one engine part, too; how far is what a second engine is to be held against.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from lunar_rescue import LunarRescueEnv, Scene, sample_scene
from lunar_rescue.arrays import Array, Floats
from lunar_rescue.physics.engines import make_simulation
from lunar_rescue.physics.solver import MUJOCO_SETTINGS, SETTINGS, SolverSettings
from lunar_rescue.scenes.postures import all_postures
from reproduce.baselines.planner.planner import RescuePlanner
from reproduce.experiments.hand_calculation import carry, slide, tip
from reproduce.experiments.pool import known_simulator, map_scenes, scene_seeds
from reproduce.experiments.rows import wilson
from reproduce.storage.files import check_writable, locked, write_json
from reproduce.storage.paths import COMMITTED
from reproduce.storage.provenance import provenance, write_table

FOLDER = COMMITTED / "agreement"
REFERENCE = "PyBullet"


class Engine(NamedTuple):
    """A simulator and how finely it works."""

    simulator: str
    settings: SolverSettings


def _uniform(substep: float, iterations: int) -> SolverSettings:
    return SolverSettings(substep, iterations, substep, iterations)


ENGINES = {
    REFERENCE: Engine("pybullet", SETTINGS),
    "PyBullet, 2.5 ms": Engine("pybullet", _uniform(0.0025, 200)),
    "MuJoCo, 20 ms": Engine("mujoco", _uniform(0.02, 50)),
    "MuJoCo, 10 ms": Engine("mujoco", _uniform(0.01, 50)),
    "MuJoCo": Engine("mujoco", MUJOCO_SETTINGS),
    "MuJoCo, 2.5 ms": Engine("mujoco", _uniform(0.0025, 50)),
}
#: Control steps after an arm first touched the body in the reference, at which poses are compared.
AFTER = (0, 2, 5, 10, 15, 20, 30, 40)
APART = 0.02, np.radians(5.0)  # m and rad, bodies that differ by more have parted
SLIDES = ((0.7, 45.0), (0.9, 45.0), (0.7, 40.0))  # friction, slope [deg]
TIPPING_FRICTION = 0.9
_STATE: dict[str, Any] = {}


class Moment(NamedTuple):
    """Where everything is after a control step."""

    angles: Array  # of the joints (11,) [rad]
    centre: Array  # of the body (3,) [m]
    rotation: Array  # of the body (3, 3)
    pressed: bool  # whether an arm pressed on the body in this step
    overlap: float = 0.0  # deepest of arms and body after it [m]
    seconds: float = 0.0  # that it took to simulate


def _replay(env: LunarRescueEnv, scene: Scene, actions: Floats) -> tuple[list[Moment], dict[str, Any]]:
    """Do what was planned, the last action until the end; return the moments and what the last step told."""
    env.reset_flat(options={"scene": scene})
    moments: list[Moment] = []
    done, info = False, dict[str, Any]()
    while not done:
        begun = time.perf_counter()
        *_, terminated, truncated, info = env.step_flat(actions[min(len(moments), len(actions) - 1)])
        seconds, done, e = time.perf_counter() - begun, terminated or truncated, env.episode
        overlap = max(env.simulation.overlaps(env.robot.handle, e.astronaut.handle), default=0.0)
        pressed = bool(np.abs(e.forces).sum() > 0.0)
        moments.append(Moment(e.robot.angles, e.body.centre, e.body.rotation, pressed, max(overlap, 0.0), seconds))
    return moments, info


def _contact(moments: list[Moment]) -> int | None:
    """Return the first step in which an arm pressed on the body."""
    return next((step for step, moment in enumerate(moments) if moment.pressed), None)


def _apart(first: Moment, second: Moment) -> tuple[float, float, float]:
    """Return how far joints [rad], body [m] and its attitude [rad] are apart."""
    turned = Rotation.from_matrix(first.rotation.T @ second.rotation).magnitude()
    between = float(np.linalg.norm(first.centre - second.centre))
    return float(np.abs(first.angles - second.angles).max()), between, float(turned)


def _compare(moments: list[Moment], reference: list[Moment]) -> dict[str, Any]:
    """Return when arms touched the body and when bodies parted, and how far paths differ before and after."""
    touched, steps = _contact(reference), min(len(moments), len(reference))
    apart = np.array([_apart(moments[i], reference[i]) for i in range(steps)])
    begin = steps if touched is None else min(touched, steps)
    parted = np.flatnonzero((apart[:, 1] > APART[0]) | (apart[:, 2] > APART[1]))
    row: dict[str, Any] = {
        "contact": _contact(moments),
        "joints_before": apart[:begin, 0].max(initial=0.0),
        "parted_after": int(parted[0]) - begin if len(parted) else None,
        "position_end": apart[-1, 1],
        "angle_end": apart[-1, 2],
    }
    for after in (a for a in AFTER if begin + a < steps):
        row |= {f"{name}_{after}": apart[begin + after, i] for i, name in enumerate(("joints", "position", "angle"))}
    return row


def _prepare() -> None:
    _STATE["planner"] = RescuePlanner()
    _STATE["environments"] = {name: LunarRescueEnv(simulator=e[0], solver=e[1]) for name, e in ENGINES.items()}


def _test(seed: int) -> list[dict[str, Any]]:
    """Plan one scene, replay the plan in every engine, and return a row an engine."""
    scene, rows, reference = sample_scene(seed), [], list[Moment]()
    plan = _STATE["planner"].plan(scene)
    for name, env in _STATE["environments"].items():
        moments, info = _replay(env, scene, plan.actions)
        reference = reference or moments
        borne = carry(env) if info["is_success"] and scene.task == "lift" else None
        attitude, terrain = all_postures()[scene.posture].attitude, "rough" if scene.terrain.rough else "smooth"
        rows.append(
            {
                **{"seed": seed, "task": scene.task, "posture": scene.posture, "attitude": attitude},
                **{"terrain": terrain, "engine": name, "planned": plan.rescued},
                **{key: info[key] for key in ("is_success", "failure", "both_arms_under", "peak_force")},
                "steps": len(moments),
                "deepest": max(moment.overlap for moment in moments),
                "step_us": round(1e6 * sum(moment.seconds for moment in moments) / len(moments)),
                "waist_error": None if borne is None else borne.error,
                **_compare(moments, reference),
            }
        )
    return rows


# -- summaries ---------------------------------------------------------------------------------------------------------
def closed_solutions() -> pd.DataFrame:
    """Return each engine's sliding friction and tipping angle beside the closed solutions, a row a case."""
    rows = []
    for name, engine in ENGINES.items():
        simulation = make_simulation(*engine)
        cases = [(f"friction of {f:g} on {s:g} deg", slide(simulation, f, s)) for f, s in SLIDES]
        cases.append(("tipping angle [deg]", tip(simulation, TIPPING_FRICTION)))
        simulation.close()
        rows += [(name, case, measured.expected, measured.value, measured.error) for case, measured in cases]
    return pd.DataFrame(rows, columns=["engine", "case", "expected", "value", "error"])


def summarise_agreement(rows: pd.DataFrame) -> dict[str, Any]:
    """Return for each engine what became of the plans that succeed in the reference, and how far paths differ."""
    reference = rows[rows["engine"] == REFERENCE].set_index("seed")
    good = reference.index[reference["is_success"]]
    summary = {}
    for name, group in rows[rows["seed"].isin(good)].groupby("engine", sort=False):
        count, lifts = int(group["is_success"].sum()), group["task"] == "lift"
        low, high = wilson(count, len(group))
        late = group["contact"].to_numpy(float) - reference.loc[group["seed"], "contact"].to_numpy(float)
        both = late[np.isfinite(late)]
        summary[str(name)] = {
            "plans": len(group),
            "successes": count,
            "share": count / max(1, len(group)),
            **{"wilson_low": low, "wilson_high": high},
            "lifts": [int(group.loc[lifts, "is_success"].sum()), int(lifts.sum())],
            "turns": [int(group.loc[~lifts, "is_success"].sum()), int((~lifts).sum())],
            "both_arms_under": int(group["both_arms_under"].sum()),
            "contact_in_the_same_step": float((both == 0).mean()) if len(both) else None,
            "contact_off_by_more_than_a_step": float((np.abs(both) > 1).mean()) if len(both) else None,
            "joints_before_contact_median_deg": float(np.degrees(group["joints_before"].median())),
            "joints_before_contact_most_deg": float(np.degrees(group["joints_before"].max())),
            "parted": int(group["parted_after"].notna().sum()),
            "parted_after_steps_median": _median(group["parted_after"]),
            # Where no scene has a number, the column holds objects.
            "waist_torque_error_median": _median(group["waist_error"].astype(float).abs()),
            "deepest_overlap_median_mm": float(1000 * group["deepest"].median()),
            "step_ms_median": float(group["step_us"].median() / 1000),
            "waist_torques": int(group["waist_error"].notna().sum()),
        }
    return summary


def _median(column: pd.Series[Any]) -> float | None:
    """Return the median of what there is, or None where there is nothing."""
    values = pd.to_numeric(column).dropna()
    return float(values.median()) if len(values) else None


def by_posture(rows: pd.DataFrame) -> pd.DataFrame:
    """Return how far bodies are apart over time: a row an engine, posture and number of steps after first contact."""
    table = []
    for (engine, posture), group in rows[rows["engine"] != REFERENCE].groupby(["engine", "posture"], sort=False):
        for after in AFTER:
            present = group[group[f"position_{after}"].notna()] if f"position_{after}" in group else group.head(0)
            if len(present):
                apart = {name: present[f"{name}_{after}"] for name in ("position", "angle", "joints")}
                table.append(
                    {
                        **{"engine": engine, "posture": posture, "steps_after_contact": after, "scenes": len(present)},
                        "position_median_mm": 1000 * apart["position"].median(),
                        "position_most_mm": 1000 * apart["position"].max(),
                        "angle_median_deg": np.degrees(apart["angle"].median()),
                        "joints_median_deg": np.degrees(apart["joints"].median()),
                    }
                )
    return pd.DataFrame(table)


def measure_agreement(
    tests: int,
    first_seed: int,
    *,
    folder: Path = FOLDER,
    tell: Callable[[str], object] = print,
    quiet: bool = False,
) -> dict[str, Any]:
    """Replay the plans of ``tests`` scenes in every engine; write rows, tables and summary to ``folder``.

    Returns the summary, and calls ``tell`` with its lines.

    Raises:
        UserError: On numbers out of range, without MuJoCo, or on a place that cannot be written.
    """
    seeds = scene_seeds(tests, first_seed)
    for engine in ENGINES.values():
        known_simulator(engine.simulator)
    names = ("scenes.csv", "by_posture.csv", "closed_solutions.csv", "summary.json")
    table, postures, closed, summary_path = (folder / name for name in names)
    for path in (table, postures, closed, summary_path):
        check_writable(path)
    with locked(folder, "agreement of the simulators"):
        nested = map_scenes(_test, seeds, _prepare, title="agreement", quiet=quiet)
        rows, cases = pd.DataFrame([row for scene in nested for row in scene]), closed_solutions()
        summary = {"first_seed": first_seed, "tests": tests, "engines": summarise_agreement(rows)}
        summary["largest_error_of_a_closed_solution"] = cases["error"].abs().groupby(cases["engine"]).max().to_dict()
        write_table(table, rows.round(5))
        write_table(postures, by_posture(rows).round(2))
        write_table(closed, cases.round(5))
        write_json(summary_path, summary | {"origin": provenance()})
    _print(summary, cases, tell)
    return summary


def _print(summary: dict[str, Any], cases: pd.DataFrame, tell: Callable[[str], object]) -> None:
    for name, engine in summary["engines"].items():
        tell(
            f"{name}: {engine['successes']} of {engine['plans']} plans succeed, {100 * engine['share']:.1f} % "
            f"[{100 * engine['wilson_low']:.1f}, {100 * engine['wilson_high']:.1f}]; joints before contact "
            f"{engine['joints_before_contact_median_deg']:.1f} deg apart, {engine['parted']} bodies part"
        )
    tell(cases.round(4).to_string(index=False))
