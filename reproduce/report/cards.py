"""Model cards, and folders with a trained policy that can be uploaded to a model hub as they are."""

from __future__ import annotations

import shutil
from pathlib import Path

import pandas as pd

from reproduce.analysis.runs import Run, reference_runs
from reproduce.analysis.tables import by_condition
from reproduce.experiments.methods import METHODS, get_method
from reproduce.storage.errors import UserError
from reproduce.storage.files import read_json, write_text
from reproduce.storage.paths import RESULTS
from reproduce.storage.policies import read_policy_json

#: What a shared folder holds besides the card, as far as it is there.
SHARED = (
    "policy.safetensors",
    "policy.json",
    "config.json",
    "run.json",
    "progress.csv",
    "evaluation.json",
    "evaluation.csv",
    "heldout.json",
)


def reference_run(method: str, seed: int | None = None, results: Path = RESULTS) -> Run:
    """The reference run of a method, the first seed unless told otherwise.

    Raises:
        UserError: When there is none.
    """
    get_method(method)
    runs = [r for r in reference_runs(results) if r.method == method and r.origin and seed in (None, r.seed)]
    if not runs:
        which = "" if seed is None else f" with seed {seed}"
        raise UserError(f"{results / 'reference' / method}: no trained reference run{which}")
    return runs[0]


def card(run: Run) -> str:
    """A model card in Markdown, with the head that model hubs read.

    Args:
        run: A reference run with ``run.json``.
    """
    method = METHODS[run.method]
    origin = run.origin or {}
    configuration = read_json(run.folder / "config.json", "configuration of a run")
    parts = [_head(run), f"# {method.title}, seed {run.seed}: dual-arm lunar rescue\n", _about(run)]
    parts += ["## Results\n", _results(run)]
    parts += [
        "## Training\n",
        f"`{origin.get('command')}` at commit `{str(origin.get('commit'))[:12]}`: {run.env_steps:,} environment steps "
        f"in {run.minutes:.0f} minutes on {origin['machine']['cores']} cores ({origin['machine']['processor']}), "
        f"environment version {origin.get('environment_version')}, preset `{configuration['preset']}`, "
        f"{configuration['training']['n_envs']} environments at once. "
        f"{', '.join(f'{k} {v}' for k, v in origin.get('packages', {}).items())}. All settings are in `config.json`, "
        "the learning curve is in `progress.csv`.\n",
        "## How to use it\n",
        "```\nreproduce evaluate DIR --tests 200\nreproduce replay DIR --seed 3 --out rescue.html\n```\n",
        "`policy.json` says how to build the networks and `policy.safetensors` holds their weights; loading them "
        "executes no code. What the networks see and put out is described in the project's `docs/environment.md`.\n",
        "## Limits\n",
        _limits(run),
        "## Licence\n",
        "MIT, as the project's code. Please cite the paper and the project (CITATION.cff).\n",
    ]
    return "\n".join(parts)


def _head(run: Run) -> str:
    found = run.evaluation
    lines = ["---", "license: mit", "library_name: stable-baselines3", "tags:"]
    lines += [f"- {tag}" for tag in ("reinforcement-learning", "hierarchical-reinforcement-learning", "robotics")]
    if found is not None:
        lines += [
            "model-index:",
            f"- name: {run.method}",
            "  results:",
            "  - task:\n      type: reinforcement-learning\n      name: reinforcement-learning",
            "    dataset:\n      name: LunarRescue-v0\n      type: LunarRescue-v0",
            f"    metrics:\n    - type: success_rate\n      value: {found['success_rate']}",
        ]
    return "\n".join([*lines, "---", ""])


def _about(run: Run) -> str:
    return (
        f"{METHODS[run.method].about[0].upper()}{METHODS[run.method].about[1:]}. A robot with two 5-joint arms gets "
        "both arms under a fallen, suited astronaut, among rocks, and turns them over or lifts them for transport, in "
        "a physical simulation under lunar gravity. From a reproduction of Ren, Han and Wang, *Research on Dual-Arm "
        "Control of Lunar Assisted Robot Based on Hierarchical Reinforcement Learning under Unstructured Environment* "
        "(Aerospace 2022, 9, 315).\n"
    )


def _results(run: Run) -> str:
    lines = []
    for name, words in (("evaluation", "test scenes, drawn as the training scenes are"), ("heldout", HELDOUT_WORDS)):
        found = run.summary(name)
        if found is not None:
            rate, low, high = (100 * found[k] for k in ("success_rate", "wilson_low", "wilson_high"))
            lines.append(f"- **{rate:.1f} %** [{low:.1f} %, {high:.1f} %] of {found['tests']} {words}")
    found, tests = run.evaluation, run.rows()
    if found is None or tests is None:
        return "Not evaluated yet.\n"
    table = by_condition(tests).reset_index()
    table = table[table["of"].isin(["task", "ground", "mass", "posture"])]
    rows = [
        f"| {r['of']} | {str(r['which']).replace('_', ' ')} | {r['tests']} | {100 * r['success']:.1f} % "
        f"[{100 * r['low']:.1f}, {100 * r['high']:.1f}] |"
        for r in table.to_dict("records")
    ]
    failures = ", ".join(f"{word.replace('_', ' ')} {count}" for word, count in found["failures"].items()) or "none"
    head = ["", "| of | which | tests | success, 95 % interval |", "|---|---|---|---|"]
    return "\n".join([*lines, *head, *rows, "", f"Failures: {failures}.", ""])


HELDOUT_WORDS = "held-out scenes, whose postures, masses, rock fields and reliefs no training scene has"


def _limits(run: Run) -> str:
    words = [
        "- Trained and tested in simulation only; nothing here has been near a real robot or a person.",
        "- A rigid suit, known poses of body and rocks, no sensor noise: see the project's `docs/assumptions.md`.",
        "- One training seed says nothing of the variance between trainings.",
    ]
    rows = run.rows()
    if rows is not None:
        words.append(f"- Weakest posture: {_weakest(rows)}.")
    return "\n".join([*words, ""])


def _weakest(rows: pd.DataFrame) -> str:
    rates = rows.groupby("posture")["success"].mean()
    return f"{str(rates.idxmin()).replace('_', ' ')}, {100 * float(rates.min()):.0f} %"


def export(method: str, out: Path, seed: int | None = None, results: Path = RESULTS) -> Path:
    """Copy a reference policy with its card to a folder that can be shared.

    Raises:
        UserError: When there is no such policy, or the folder is there and not empty.
    """
    run = reference_run(method, seed, results)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UserError(f"--out: {out} is there and not empty; choose another")
    read_policy_json(run.folder)
    out.mkdir(parents=True, exist_ok=True)
    for name in SHARED:
        if (run.folder / name).is_file():
            shutil.copyfile(run.folder / name, out / name)
    write_text(out / "README.md", card(run))
    return out
