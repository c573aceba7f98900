"""Model cards, and folders with a trained policy that can be uploaded to a model hub as they are."""

import shutil
from pathlib import Path

from reproduce.analysis.runs import Run, reference_runs
from reproduce.analysis.tables import by_condition
from reproduce.experiments.methods import METHODS, get_method
from reproduce.report.rendering import render
from reproduce.storage.errors import UserError
from reproduce.storage.files import read_json, write_text
from reproduce.storage.paths import RESULTS
from reproduce.storage.policies import read_policy_json

#: What the scenes of an evaluation are called on a card.
EVALUATIONS = {
    "evaluation": "test scenes, drawn as the training scenes are",
    "heldout": "held-out scenes, whose postures, masses, rock fields and reliefs no training scene has",
}
#: What a shared folder holds besides the card, as far as it is there.
SHARED = (
    *("policy.safetensors", "policy.json", "config.json", "run.json", "progress.csv"),
    *(f"{name}.{ending}" for name in EVALUATIONS for ending in ("json", "csv")),
)
CONDITIONS = ["task", "ground", "mass", "posture"]


def reference_run(method: str, seed: int | None = None, results: Path = RESULTS) -> Run:
    """Return the reference run of a method, of its first seed unless ``seed`` is given."""
    get_method(method)
    runs = [r for r in reference_runs(results) if r.method == method and r.origin and seed in (None, r.seed)]
    if not runs:
        which = "" if seed is None else f" with seed {seed}"
        raise UserError(f"{results / 'reference' / method}: no trained reference run{which}")
    return runs[0]


def card(run: Run) -> str:
    """Return the model card of a trained reference run in Markdown, with the head that model hubs read."""
    rows, conditions, weakest = run.rows(), None, None
    if rows is not None:
        table = by_condition(rows).reset_index()
        conditions = table[table["of"].isin(CONDITIONS)].to_dict("records")
        rates = rows.groupby("posture")["success"].mean()
        weakest = rates.idxmin(), rates.min()
    return render(
        "card.md",
        run=run,
        method=METHODS[run.method],
        origin=run.origin,
        configuration=read_json(run.folder / "config.json", "configuration of a run"),
        evaluations=EVALUATIONS,
        conditions=conditions,
        weakest=weakest,
    )


def export(method: str, out: Path, seed: int | None = None, results: Path = RESULTS) -> Path:
    """Copy a reference policy with its card to a new or empty folder that can be shared."""
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
