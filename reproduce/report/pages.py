"""Write the computed blocks of README.md and docs/, from code and results/; no number there is typed.

A page's template in ``templates/`` has a block for each of the page's, under the same name.
"""

import re
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from lunar_rescue import ENVIRONMENT_VERSION, RewardWeights, disturbances, tasks
from lunar_rescue.observation import SIZE, observation_table
from lunar_rescue.physics import bullet, robot, simulation
from lunar_rescue.physics.engines import SIMULATORS
from lunar_rescue.physics.solver import SETTINGS
from lunar_rescue.rewards import TERMS
from lunar_rescue.scenes import rocks, scene, terrain
from lunar_rescue.scenes.postures import postures
from lunar_rescue.scenes.splits import HELD_OUT, SPLITS
from reproduce.analysis import perceived, reality_gap
from reproduce.analysis.claims import compute_claims
from reproduce.analysis.rule_tables import read_rules, readable_rules
from reproduce.analysis.runs import reference_runs, runs_of
from reproduce.analysis.sentences import answer
from reproduce.analysis.tables import readable_differences, readable_table1
from reproduce.analysis.trainings import percent
from reproduce.bench.training import BATCHES
from reproduce.experiments.workflow.plan import REPORT, TABLES
from reproduce.report.archive import codemeta
from reproduce.report.reference import reference
from reproduce.report.rendering import template
from reproduce.storage.files import read_json, write_text
from reproduce.storage.paths import RESULTS, ROOT, notebook_files


def _result(path: str) -> dict[str, Any] | None:
    """Return what a file of results/ holds, or None where it has not been made."""
    file = RESULTS / path
    return read_json(file, "measured results") if file.exists() else None


def _joints() -> list[dict[str, Any]]:
    """Return each joint's name, angles [deg] at action 0, -1 and 1, and limits of torque [N m] and speed [rad/s]."""
    with closing(bullet.BulletSimulation()) as world:
        arms = robot.Robot(world)
        low, high = (np.degrees(arms.joint_targets(np.full(11, sign))) for sign in (-1.0, 1.0))
        columns = (arms.names, np.degrees(arms.initial), low, high, arms.torque_limits, arms.speed_limits)
        keys = ("name", "at_0", "low", "high", "torque", "speed")
        return [dict(zip(keys, joint, strict=True)) for joint in zip(*columns, strict=True)]


def _readme() -> dict[str, Any]:
    """Return the results beside the paper's, and what it takes to make each of the paper's items."""
    trained = [run for run in reference_runs() if run.origin]
    tests = [run.evaluation["seconds"] for run in trained if run.evaluation]
    timings = RESULTS / "timings.csv"
    seconds = pd.read_csv(timings, index_col="step")["seconds"] if timings.is_file() else pd.Series(dtype=float)
    return {
        "table1": readable_table1(),
        "differences": readable_differences(),
        "claims": (claims := compute_claims()),
        "answer": answer(claims),
        "runs": runs_of("hrl_dcs"),
        "without_folder": lambda command: re.sub(r" --out \S+", "", command),
        "trained": trained,
        "slowest_tests": f"{max(tests) / 60:.1f} a policy at most" if tests else "not timed",
        "seconds": seconds.to_dict(),
        "embedding": _result("perception/run.json"),
        "notebooks": {path.name[:2]: path.stem for path in notebook_files()},
        "tables": TABLES,
        "report": REPORT,
    }


def _environment() -> dict[str, Any]:
    """Return what the environment's modules say of it, and its measured speed and solvability."""
    return {
        "version": ENVIRONMENT_VERSION,
        "observations": observation_table(),
        "size": SIZE,
        "joints": _joints(),
        "terms": TERMS,
        "weights": RewardWeights(),
        "postures": postures(),
        "heldout_postures": {name: postures(name) for name in HELD_OUT},
        "splits": SPLITS,
        "solver": SETTINGS,
        "convergence": _convergence(),
        "solvable": _result("solvability/summary.json"),
        "bench": _result("bench.json"),
        **{"tasks": tasks, "robot": robot, "simulation": simulation},
        **{"rocks": rocks, "scene": scene, "terrain": terrain},
    }


def _convergence() -> pd.DataFrame | None:
    """Return the summary of the convergence study, its run folder named by its method, or None where there is none."""
    path = RESULTS / "convergence" / "summary.csv"
    if not path.is_file():
        return None
    table = pd.read_csv(path)
    named = table["actor"].map(lambda actor: Path(actor).parent.name or actor)
    return table.assign(actor=named)


def _agreement() -> dict[str, Any]:
    """Return how far the simulators agree, and what each makes of cases with a closed solution."""
    path = RESULTS / "agreement" / "closed_solutions.csv"
    cases = pd.read_csv(path).to_dict("records") if path.is_file() else []
    return {"agreement": _result("agreement/summary.json"), "cases": cases, "settings": SIMULATORS}


def _statistics() -> dict[str, Any]:
    """Return how often each rule of the claims is wrong, or None where that was not measured."""
    table = read_rules()
    return {"rules": table, "readable": None if table is None else readable_rules(table)}


def _reality_gap() -> dict[str, Any]:
    """Return kinds and severities, what was measured of them, and the ranges of randomised trainings."""
    rows = reality_gap.stress_rows()
    names = [f"stress/{method}.json" for method in rows["method"].unique()]
    return {
        "severities": reality_gap.severities().reset_index(),
        "words": reality_gap.in_words(rows),
        "stress": reality_gap.readable_stress(rows).reset_index(),
        "transfer": reality_gap.readable_transfers(reality_gap.simulator_rows()).rename_axis("success").reset_index(),
        "anew": _result("transfer/planner_anew.json"),
        "percent": percent,
        "summaries": [summary for name in names if (summary := _result(name))],
        "d": disturbances,
    }


def _perception() -> dict[str, Any]:
    """Return what was measured of the embedding, and of policies that act on its estimates."""
    return {
        "goals": perceived.goals(),
        "occlusion": perceived.occlusion().reset_index(),
        "states": perceived.states(),
        "training": _result("perception/run.json"),
        "evaluation": _result("perception/evaluation.json"),
    }


#: Page and what computes the data of its template.
PAGES: dict[str, Callable[[], dict[str, Any]]] = {
    "README.md": _readme,
    "docs/environment.md": _environment,
    "docs/simulators.md": _agreement,
    "docs/statistics.md": _statistics,
    "docs/reality_gap.md": _reality_gap,
    "docs/perception.md": _perception,
    "docs/api.md": lambda: {"parts": reference()},
    "docs/training.md": lambda: {"bench": _result("bench_training.json"), "batches": BATCHES},
}


def rewritten(page: str) -> str:
    """Return a page's text with its blocks computed again; a ``ValueError`` names a block that the page lacks."""
    text = (ROOT / page).read_text(encoding="utf-8")
    blocks = template(page.rpartition("/")[2])
    context = blocks.new_context(PAGES[page]())
    for name, render_block in blocks.blocks.items():
        parts = re.split(rf"(<!-- {name}:begin[^>]*-->\n).*?(<!-- {name}:end -->)", text, flags=re.DOTALL)
        if len(parts) != 4:
            raise ValueError(f"{page}: expected one block {name!r}, found {len(parts) // 3}")
        before, begin, end, after = parts
        text = before + begin + "".join(render_block(context)) + end + after
    return text


def main() -> int:
    """Rewrite the blocks of every page in place."""
    for page in PAGES:
        try:
            write_text(ROOT / page, rewritten(page))
        except ValueError as error:
            print(error, file=sys.stderr)
            return 2
    write_text(ROOT / "codemeta.json", codemeta())
    return 0


if __name__ == "__main__":
    sys.exit(main())
