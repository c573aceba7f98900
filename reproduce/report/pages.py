"""Writes the blocks of README.md and docs/ that are computed, from code and results/; no number there is typed."""

from __future__ import annotations

import json
import math
import re
import sys
from collections.abc import Callable
from typing import Any

import numpy as np

from lunar_rescue import ENVIRONMENT_VERSION, RewardWeights, tasks
from lunar_rescue.observation import SIZE, observation_table
from lunar_rescue.physics.robot import CONTROL_STEP, CONTROL_SUBSTEPS, Robot
from lunar_rescue.physics.simulation import LUNAR_GRAVITY, SOLVER_ITERATIONS, SUBSTEP, Simulation
from lunar_rescue.rewards import TERMS
from lunar_rescue.scenes.postures import heldout_postures, postures
from lunar_rescue.scenes.rocks import HELDOUT_EXPONENT, MAX_ROCKS, ROCK_BURIED, ROCK_EXPONENT, ROCK_SIZE_RANGE
from lunar_rescue.scenes.scene import BASE_RANGE, FRICTION_RANGE, HELDOUT_MASSES, MASS_RANGE
from lunar_rescue.scenes.splits import SPLITS
from lunar_rescue.scenes.terrain import MAX_SLOPE, MOUND_RADIUS, MOUND_STEEPNESS, MOUNDS, ROUGH_SHARE
from reproduce.analysis.claims import compute_claims
from reproduce.analysis.runs import runs_of
from reproduce.analysis.tables import markdown_table, readable_differences, readable_table1
from reproduce.bench.training import BATCHES
from reproduce.experiments.methods import METHODS
from reproduce.experiments.workflow.plan import Plan
from reproduce.report.items import items, timings
from reproduce.storage.files import write_text
from reproduce.storage.paths import RESULTS, ROOT


def block_pattern(name: str) -> re.Pattern[str]:
    """What finds a block: the line that begins it, what is computed, the line that ends it."""
    return re.compile(rf"(<!-- {name}:begin[^>]*-->\n).*?(<!-- {name}:end -->)", re.DOTALL)


def results_block() -> str:
    """Table 1, where it comes from, and the verdicts in a line."""
    table = readable_table1()
    lines = [markdown_table(list(table.columns), table.to_numpy().tolist())]
    for run in runs_of("hrl_dcs"):
        if run.origin and run.evaluation:
            under = 100 * run.evaluation["both_arms_under"]
            lines.append(
                f"HRL-DCS, seed {run.seed}: trained by `{_without_folder(run.origin['command'])}` in "
                f"{run.minutes:.0f} minutes on {run.origin['machine']['cores']} cores, "
                f"environment {run.origin['environment_version']}; both arms under in {under:.1f} % of tests."
            )
            held = run.summary("heldout")
            if held is not None:
                low, high = 100 * held["wilson_low"], 100 * held["wilson_high"]
                lines.append(
                    f"On {held['tests']} held-out scenes (postures, masses, rock fields and reliefs that no training "
                    f"scene has): {100 * held['success_rate']:.1f} % [{low:.1f} %, {high:.1f} %]."
                )
    paired = readable_differences()
    if len(paired):
        lines += ["", "Paired differences in points, on the same scenes, with 95 % intervals:", ""]
        lines.append(markdown_table(list(paired.columns), paired.to_numpy().tolist()))
    verdicts = ", ".join(f"{c.id} {c.verdict}" for c in compute_claims())
    lines += ["", f"Claims: {verdicts} (`results/claims.json` says why)."]
    return "\n".join(lines) + "\n"


def _without_folder(command: str) -> str:
    """A training's command without the folder that it once wrote to."""
    return re.sub(r" --out \S+", "", command)


def version_block() -> str:
    """The environment's version."""
    return f"Environment version {ENVIRONMENT_VERSION}.\n"


def observation_block() -> str:
    """Keys, shapes and meanings."""
    rows = [(f"`{row['key']}`", row["shape"], row["meaning"]) for row in observation_table()]
    return markdown_table(("key", "shape", "meaning"), rows) + f"\n{SIZE} numbers in all.\n"


def action_block() -> str:
    """Range, torque and speed of each joint."""
    simulation = Simulation()
    try:
        robot = Robot(simulation)
        low, high = (np.degrees(robot.joint_targets(np.full(11, sign))) for sign in (-1.0, 1.0))
        rows = [
            (
                index,
                name.replace("_", " "),
                f"{math.degrees(robot.initial[index]):.0f}",
                f"{low[index]:.0f} to {high[index]:.0f}",
                f"{robot.torque_limits[index]:.0f}",
                f"{robot.speed_limits[index]:.1f}",
            )
            for index, name in enumerate(robot.names)
        ]
    finally:
        simulation.close()
    head = ("index", "joint", "at 0 [deg]", "from -1 to 1 [deg]", "torque limit [N m]", "speed limit [rad/s]")
    return markdown_table(head, rows)


def rewards_block() -> str:
    """Terms and the weights that the environment has unless it is given others."""
    weights = RewardWeights()
    rows = [
        (
            f"`{term.name}`",
            f"${term.formula}$",
            term.meaning,
            ", ".join(f"`{field}` {getattr(weights, field):g}" for field in term.weight),
        )
        for term in TERMS
    ]
    return markdown_table(("term", "formula", "when", "weight"), rows)


def numbers_block() -> str:
    """What an episode is made of."""
    t = tasks
    rows = [
        ("gravity", f"{LUNAR_GRAVITY} m/s²", "standard"),
        ("action held for", f"{CONTROL_STEP:g} s, {CONTROL_SUBSTEPS} substeps of {SUBSTEP:g} s", "assumption"),
        ("solver iterations", SOLVER_ITERATIONS, "as few as pass the physics tests"),
        ("step limit", f"{t.MAX_STEPS} steps", "assumption; a planner needs less than half on average"),
        ("suited mass", _span(MASS_RANGE, "kg"), "Apollo suited person to NASA's suited Artemis crew member"),
        ("friction", _span(FRICTION_RANGE, ""), "regolith friction angle 35 to 42 deg (NTRS 19730039283)"),
        ("base to centre of gravity", _span(BASE_RANGE, "m") + " in any scene", "assumption"),
        ("rocks", f"0 to {MAX_ROCKS}, {_span(ROCK_SIZE_RANGE, 'm')} across", "NASA rock specification"),
        ("rock sizes", f"N(>=D) ~ D^{ROCK_EXPONENT:g} before they are placed", "VIPER intercrater"),
        ("rocks buried", _span((100 * ROCK_BURIED[0], 100 * ROCK_BURIED[1]), "%"), "the same"),
        ("rough ground", f"{100 * ROUGH_SHARE:.0f} % of scenes", "assumption"),
        ("slope of rough ground", f"0 to {MAX_SLOPE:g} deg", "half of the challenge's 20 deg"),
        (
            "mounds",
            f"{MOUNDS}, radius {_span(MOUND_RADIUS, 'm')}, height/radius {_span(MOUND_STEEPNESS, '')}",
            "assumption",
        ),
        ("arm end in its target area", f"within {t.TARGET_RADIUS:g} m", "assumption; the plate is 0.15 m wide"),
        ("lifted", f"centre of gravity up {t.LIFT_HEIGHT:g} m", "assumption; over the rocks"),
        ("lifted level", f"tilt within {_deg(t.LIFT_TILT)}, roll within {_deg(t.LIFT_ROLL)}", "assumption"),
        ("on the back", f"front within {_deg(t.BACK_ANGLE)} of the ground's normal", "assumption"),
        ("held for", f"{t.HOLD_STEPS} steps", "assumption; passing through does not count"),
        ("an arm bears", f"more than {t.BEARING_FORCE:g} N upwards", "assumption; touching is not carrying"),
    ]
    return markdown_table(("what", "value", "source"), rows)


def _span(bounds: tuple[float, float], unit: str) -> str:
    return f"{bounds[0]:g} to {bounds[1]:g} {unit}".strip()


def _deg(angle: float) -> str:
    return f"{math.degrees(angle):.0f} deg"


def splits_block() -> str:
    """Seed ranges and what they are drawn from."""
    masses = " and ".join(_span(interval, "kg") for interval in HELDOUT_MASSES)
    common = f"{len(postures())} postures, masses without {masses}, scattered rocks"
    held = (
        f"{len(heldout_postures())} other postures, masses {masses} only, rocks in clusters (D^{HELDOUT_EXPONENT:g}) "
        "of other stones, other reliefs"
    )
    rows = [(f"`{n}`", f"{r.start:,} to {r.stop - 1:,}", held if n == "heldout" else common) for n, r in SPLITS.items()]
    return markdown_table(("split", "seeds", "drawn from"), rows)


def _result(path: str) -> dict[str, Any] | None:
    file = RESULTS / path
    if not file.exists():
        return None
    made: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    return made


def _measured(path: str, command: str, write: Callable[[dict[str, Any]], str]) -> str:
    """What a result file says, with its origin, or how to make it where it, or a figure of it, is not there."""
    result = _result(path)
    if result is None:
        return f"Not measured yet: `{command}`.\n"
    origin = result["origin"]
    made = f"`{command}`, {origin['machine']['processor']}, {origin['machine']['cores']} cores, `results/{path}`"
    return write(result) + f"\nMeasured by {made}.\n"


def speed_block() -> str:
    """The environment part of bench."""
    return _measured("bench.json", "reproduce bench --json results/bench.json", _speed)


def _speed(b: dict[str, Any]) -> str:
    rows = [
        ("env steps/s, one process", f"{b['env_steps_per_s_1']:,.0f}", f"{b['env_steps_per_s_rough_1']:,.0f}"),
        (
            "the same with resets",
            f"{b['env_steps_per_s_1_with_resets']:,.0f}",
            f"{b['env_steps_per_s_rough_1_with_resets']:,.0f}",
        ),
        (
            "share of a step inside PyBullet's own",
            f"{100 * b['share_in_physics']:.0f} %",
            f"{100 * b['share_in_physics_rough']:.0f} %",
        ),
        ("reset, drawing the scene included, in steps", b["reset_in_steps"], b["reset_in_steps_rough"]),
    ]
    text = markdown_table(("", "smooth", "rough"), rows)
    text += f"\n16 environments on {b['cores']} cores, both grounds: {b['env_steps_per_s_all']:,.0f} steps/s.\n"
    if "peer_steps_per_s_1" in b:
        text += (
            f"{b['peer']} in the same run: {b['peer_steps_per_s_1']:,.0f} steps/s in one process "
            f"(ours on smooth ground is {b['env_over_peer']:.2f} times that).\n"
        )
    return text


def training_block() -> str:
    """The training part of bench."""
    return _measured("bench_training.json", _bench("training"), _training)


def _training(b: dict[str, Any]) -> str:
    rows = [
        ("HRL-DCS, all in", f"{b['training_steps_per_s']:,.0f} steps/s"),
        (
            "the same with stock parts (`SubprocVecEnv`, sb3-contrib's `RecurrentPPO`)",
            f"{b['stock_training_steps_per_s']:,.0f} steps/s",
        ),
        ("ratio", f"{b['training_ratio']:.1f}"),
        *(
            (
                f"our learner over the stock one, same rollout and epochs, minibatches of {batch}",
                f"{b[f'learner_ratio_{batch}']:.1f}",
            )
            for batch in BATCHES
        ),
    ]
    return markdown_table(("", ""), rows)


#: What a second of training is made of (results/bench_profile.json): key and what it is.
SHARES = {
    "environments": "waiting for the workers, which step and reset the environments",
    "lln_acts": "LLN chooses actions and values them",
    "sgn_acts": "SGN chooses sub-goals and values them",
    "hierarchy": "INR, sub-goals, mirrored views, SGN's transitions",
    "collecting": "the rest of SB3's collection: buffers, copies, advantages",
    "lln_learns": "LLN's epochs",
    "sgn_learns": "SGN's epochs",
}


def profile_block() -> str:
    """Where a second of training goes."""
    return _measured("bench_profile.json", _bench("profile"), _profile)


def _bench(part: str) -> str:
    return f"reproduce bench --part {part} --json results/bench_{part}.json"


def _profile(b: dict[str, Any]) -> str:
    rows = [(what, f"{100 * b[f'profile_share_{key}']:.0f} %") for key, what in SHARES.items()]
    text = markdown_table(("", "share"), rows)
    one, two = b["profile_threads_1"], b["profile_threads_2"]
    return text + f"\nThe whole training with one thread for PyTorch {one:,.0f} steps/s, with two {two:,.0f}.\n"


def methods_block() -> str:
    """How fast each method trains."""
    return _measured("bench_methods.json", _bench("methods"), _methods)


def _methods(b: dict[str, Any]) -> str:
    rows = []
    for name, method in METHODS.items():
        if method.train is not None:
            rate, minutes, ratio = (b[f"methods_{name}_{k}"] for k in ("steps_per_s", "minutes", "over_hrl_dcs"))
            taken = ", ".join(f"{run.minutes:.0f}" for run in runs_of(name)) or "no run"
            rows.append((f"`{name}`", f"{rate:,.0f}", f"{ratio:.2f}", f"{minutes:.0f}", taken))
    steps, sooner = f"{b['methods_env_steps']:,}", b["methods_sac_meanwhile_over_afterwards"]
    text = markdown_table(
        ("method", "steps/s", "over HRL-DCS", f"minutes for {steps} steps at that rate", "minutes of the run"), rows
    )
    return text + f"\nSAC that learns while the workers step, over SAC that learns after each step: {sooner:.2f}.\n"


def ground_block() -> str:
    """What kinds of ground cost."""
    return _measured("ground.json", "reproduce bench --part ground --json results/ground.json", _grounds)


def _grounds(result: dict[str, Any]) -> str:
    names = {
        "mounds": "plane with mounds (ours)",
        "heightfield_20cm": "heightfield, cells of 0.2 m",
        "heightfield_10cm": "heightfield, cells of 0.1 m",
        "mesh_20cm": "mesh of triangles, cells of 0.2 m",
    }
    rows = [(title, result[f"{name}_over_plane"]) for name, title in names.items()]
    return markdown_table(("ground", "time of a step's physics over that on a plane"), rows)


def solvable_block() -> str:
    """What the planner solves."""
    return _measured("solvability/summary.json", "reproduce solvable", _solvable)


def _solvable(result: dict[str, Any]) -> str:
    rows = [(s["meaning"], f"{s['scenes']} of {result['tests']}", _interval(s)) for s in result["shares"].values()]
    return markdown_table(("", "scenes", "share [95 % interval]"), rows)


def _interval(share: dict[str, float]) -> str:
    return f"{100 * share['share']:.1f} % [{100 * share['wilson_low']:.1f}, {100 * share['wilson_high']:.1f}]"


def soak_block() -> str:
    """The million random steps."""
    return _measured("soak.json", "reproduce soak", _soak)


def _soak(result: dict[str, Any]) -> str:
    return (
        f"{result['steps']:,} random steps in {result['episodes']:,} episodes, {result['postures']} postures, tasks "
        f"{', '.join(result['tasks'])} and grounds {', '.join(result['terrains'])}: {len(result['faults'])} faults. "
        f"Memory grew by {100 * result['largest_memory_growth']:.2f} % over the last half.\n"
    )


def commands_block() -> str:
    """Item of the paper, command, output, minutes."""
    measured = timings()
    rows = [
        (item.what, f"`{item.command}`", f"`results/{item.output}`", item.minutes(measured))
        for item in items(Plan.make("smoke", list(METHODS), [0], threads=1))
    ]
    table = markdown_table(("paper item", "command", "output", "minutes"), rows)
    return (
        f"{table}\nMinutes on 2 cores: of trainings and their tests those of the reference runs, of all else those of "
        "the smoke batch (`results/timings.csv`, written by `make timings`).\n"
    )


#: Page, block, what makes it.
PAGES: dict[str, dict[str, Callable[[], str]]] = {
    "README.md": {"results": results_block, "commands": commands_block},
    "docs/environment.md": {
        "version": version_block,
        "observation": observation_block,
        "action": action_block,
        "rewards": rewards_block,
        "numbers": numbers_block,
        "splits": splits_block,
        "speed": speed_block,
        "ground": ground_block,
        "solvable": solvable_block,
        "soak": soak_block,
    },
    "docs/training.md": {"training": training_block, "profile": profile_block, "methods": methods_block},
}


def rewritten(page: str) -> str:
    """A page's text with its blocks made anew.

    Raises:
        ValueError: Naming page and block, when a block's lines are not found.
    """
    text = (ROOT / page).read_text(encoding="utf-8")
    for name, make in PAGES[page].items():
        parts = block_pattern(name).split(text)
        if len(parts) != 4:
            raise ValueError(f"{page}: expected one block {name!r}, found {len(parts) // 3}")
        before, begin, end, after = parts
        text = before + begin + make() + end + after
    return text


def main() -> int:
    """Rewrite the blocks of every page in place."""
    for page in PAGES:
        try:
            write_text(ROOT / page, rewritten(page))
        except ValueError as error:
            print(error, file=sys.stderr)
            return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
