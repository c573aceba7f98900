"""The command line as a user meets it: good calls, and one clear line with exit code 2 for bad ones."""

from __future__ import annotations

import json
import pickle
import re
import shutil
import subprocess
import sys
from pathlib import Path

import nbformat
import numpy as np
import pandas as pd
import pytest
import torch as th
from safetensors.torch import load_file, save_file

from reproduce.experiments.evaluate import evaluate, rescue_scenes
from reproduce.experiments.methods import METHODS, load_policy
from reproduce.experiments.train import train
from reproduce.learning.config import PRESETS, from_dict, to_dict
from reproduce.report import build_report
from reproduce.report.notebooks import check_parameters, find_notebooks, is_complete, parse_assignments, run_notebooks
from reproduce.storage.errors import RunFailedError, UserError

STEPS = 1024


def call(*arguments: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "reproduce", *arguments],
        capture_output=True,
        text=True,
        cwd=cwd,
        timeout=300,
        check=False,
    )


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "hrl"
    done = call("train", "hrl_dcs", "--preset", "smoke", "--seed", "0", "--steps", str(STEPS), "--out", str(folder))
    assert done.returncode == 0, done.stderr
    return folder


def test_run_folder_is_complete(run: Path) -> None:
    assert {p.name for p in run.iterdir()} == {
        "config.json", "policy.json", "policy.safetensors", "progress.csv", "run.json",
    }  # fmt: skip
    origin = json.loads((run / "run.json").read_text())
    assert {"command", "commit", "environment_version", "packages", "machine", "steps", "seconds"} <= set(origin)
    assert origin["command"].startswith("reproduce train hrl_dcs")
    curve = pd.read_csv(run / "progress.csv")
    assert {"env_steps", "seconds", "return_high", "return_low", "success"} <= set(curve.columns)
    assert curve["env_steps"].iloc[-1] >= STEPS


@pytest.mark.parametrize("name", [m.name for m in METHODS.values() if m.train])
def test_every_learning_method_trains_and_acts(name: str, tmp_path: Path) -> None:
    from dataclasses import replace

    config = replace(METHODS[name].config("smoke"), steps=512, n_envs=2)
    curve = train(METHODS[name], config, 0, tmp_path / "run", "smoke", quiet=True)
    assert np.isfinite(curve["seconds"]).all()
    rows = rescue_scenes(tmp_path / "run", 2, quiet=True)
    assert [row["seed"] for row in rows] == [0, 1]
    method, _ = load_policy(tmp_path / "run")
    assert method.name == name


def test_evaluation_has_the_contract_s_fields(run: Path, tmp_path: Path) -> None:
    target = tmp_path / "evaluation.json"
    done = call("evaluate", str(run), "--tests", "4", "--first-seed", "7", "--json", str(target))
    assert done.returncode == 0, done.stderr
    result = json.loads(target.read_text())
    assert {
        "method", "tests", "successes", "success_rate", "wilson_low", "wilson_high", "seconds", "seconds_per_test",
        "first_seed", "both_arms_under", "by_task", "by_posture", "failures",
    } <= set(result)  # fmt: skip
    assert result["tests"] == 4 and result["first_seed"] == 7
    assert sum(c["tests"] for c in result["by_posture"].values()) == 4


def test_results_do_not_depend_on_workers_or_neighbours(run: Path) -> None:
    together = rescue_scenes(run, 6, workers=2, quiet=True)
    alone = [row for seed in range(6) for row in rescue_scenes(run, 1, first_seed=seed, workers=1, quiet=True)]
    assert together == alone


@pytest.mark.parametrize("ending", [".mp4", ".gif", ".png"])
def test_replay_writes_a_film(ending: str, tmp_path: Path) -> None:
    out = tmp_path / f"rescue{ending}"
    done = call("replay", "scripted", "--seed", "0", "--out", str(out))
    assert done.returncode == 0, done.stderr
    assert out.stat().st_size > 10_000


BAD_CALLS = [
    (["train", "hrl_dsc", "--out", "x"], "hrl_dsc"),
    (["train", "scripted", "--out", "x"], "does not learn"),
    (["train", "hrl_dcs", "--out", "x", "--preset", "huge"], "huge"),
    (["train", "hrl_dcs", "--out", "x", "--steps", "0"], "--steps"),
    (["train", "hrl_dcs", "--out", "x", "--steps", "-1"], "--steps"),
    (["train", "hrl_dcs", "--out", "x", "--steps", "many"], "--steps"),
    (["train", "hrl_dcs", "--out", "x", "--seed", "-1"], "--seed"),
    (["train", "hrl_dcs", "--out", "x", "--resume"], "checkpoint"),
    (["train", "hrl_dcs"], "--out"),
    (["evaluate", "nowhere"], "nowhere"),
    (["evaluate", "scripted", "--tests", "0"], "tests"),
    (["evaluate", "scripted", "--first-seed", "-3"], "seed"),
    (["replay", "scripted", "--out", "x.avi"], ".mp4"),
    (["replay", "scripted", "--out", "x.png", "--posture", "sitting"], "sitting"),
    (["notebooks", "--only", "77"], "77"),
    (["notebooks", "--preset", "tiny"], "tiny"),
    (["notebooks", "-p", "sead=1"], "sead"),
    (["notebooks", "-p", "seed=one"], "seed"),
    (["notebooks", "-p", "seed"], "NAME=VALUE"),
    (["dance"], "dance"),
]


@pytest.mark.parametrize(("arguments", "word"), BAD_CALLS, ids=[" ".join(a) for a, _ in BAD_CALLS])
def test_bad_calls_end_with_one_line_and_code_2(arguments: list[str], word: str, tmp_path: Path) -> None:
    done = call(*arguments, cwd=tmp_path)
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    assert done.returncode == 2
    assert len(lines) == 1 and word in lines[0] and lines[0].startswith("reproduce:"), done.stderr
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.iterdir())


class _Payload:
    """Unpickled, it makes a file: harmless, and seen when it fires."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, ...]:
        return Path.touch, (self.path,)


def test_the_payload_would_fire(tmp_path: Path) -> None:
    pickle.loads(pickle.dumps(_Payload(tmp_path / "fired")))
    assert (tmp_path / "fired").exists()


def _damage(folder: Path, how: str) -> None:
    weights, policy = folder / "policy.safetensors", folder / "policy.json"
    match how:
        case "no weights":
            weights.unlink()
        case "cut weights":
            weights.write_bytes(weights.read_bytes()[:1000])
        case "pickle":
            weights.write_bytes(pickle.dumps(_Payload(folder.parent / "fired")))
        case "wrong shape":
            tensors = load_file(weights)
            tensors["sgn.log_std"] = th.zeros(9)
            save_file(tensors, weights)
        case "not finite":
            tensors = load_file(weights)
            tensors["lln.log_std"][0] = float("nan")
            save_file(tensors, weights)
        case "no description":
            policy.unlink()
        case "cut description":
            policy.write_text(policy.read_text()[:40])
        case "foreign method":
            policy.write_text(policy.read_text().replace("hrl_dcs", "magic"))
        case "huge network":
            raw = json.loads(policy.read_text())
            raw["networks"]["sgn"]["hidden_units"] = 10**9
            policy.write_text(json.dumps(raw))


@pytest.mark.parametrize(
    "how",
    ["no weights", "cut weights", "pickle", "wrong shape", "not finite", "no description", "cut description",
     "foreign method", "huge network"],
)  # fmt: skip
def test_damaged_run_folders_are_refused(run: Path, how: str, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(run, folder)
    _damage(folder, how)
    with pytest.raises(UserError, match="policy"):
        evaluate(folder, 1, quiet=True)
    if how in ("cut weights", "no description"):
        done = call("evaluate", str(folder), "--tests", "1")
        assert done.returncode == 2 and len(done.stderr.strip().splitlines()) == 1
    if how == "pickle":
        assert not (tmp_path / "fired").exists()


def test_a_finished_run_is_not_overwritten(run: Path) -> None:
    before = (run / "policy.safetensors").read_bytes()
    done = call("train", "hrl_dcs", "--preset", "smoke", "--steps", "512", "--out", str(run))
    assert done.returncode == 2 and "finished run" in done.stderr
    assert (run / "policy.safetensors").read_bytes() == before


def test_configuration_survives_json_and_refuses_strangers() -> None:
    for preset in PRESETS.values():
        assert from_dict(json.loads(json.dumps(to_dict(preset)))) == preset
    raw = to_dict(PRESETS["smoke"])
    raw["low"]["learning_rat"] = 1.0
    with pytest.raises(ValueError, match="learning_rat"):
        from_dict(raw)


# -- notebooks ---------------------------------------------------------------------------------------------------------
def _notebook(folder: Path, source: str, parameters: str = "steps = 3\nname = 'a'\nrate = 0.5") -> Path:
    document = nbformat.v4.new_notebook()
    first = nbformat.v4.new_code_cell(parameters)
    first.metadata["tags"] = ["parameters"]
    document.cells = [first, nbformat.v4.new_code_cell(source), nbformat.v4.new_code_cell("print('last')")]
    folder.mkdir(exist_ok=True)
    path = folder / "01_try.ipynb"
    nbformat.write(document, path)
    return path


def test_every_notebook_has_a_parameters_cell_and_no_outputs() -> None:
    notebooks = find_notebooks()
    assert [n.name[:2] for n in notebooks] == ["01", "02", "03", "04", "05", "06"]
    for notebook in notebooks:
        assert "preset" in notebook.defaults
        document = nbformat.read(notebook.path, as_version=4)
        code = [cell for cell in document.cells if cell.cell_type == "code"]
        assert "parameters" in code[0].metadata.tags
        assert not any(cell.outputs for cell in code)
        assert document.cells[-1].source.startswith("## Summary")


def test_parameters_are_checked_before_anything_runs(tmp_path: Path) -> None:
    _notebook(tmp_path / "notebooks", "print(steps)")
    notebooks = find_notebooks(sources=tmp_path / "notebooks")
    chosen = check_parameters(notebooks, "smoke", parse_assignments(["steps=5", "name=b", "rate=1"]))
    assert chosen == {"01_try": {"steps": 5, "name": "b", "rate": 1}}
    for bad in ("step=5", "steps=1.5", "steps='x'", "name=3", "steps=True"):
        with pytest.raises(UserError, match=bad.split("=")[0]):
            check_parameters(notebooks, "smoke", parse_assignments([bad]))


@pytest.mark.parametrize("source", ["raise KeyError('gone')", "raise SystemExit(0)"])
def test_a_failed_notebook_is_kept_and_nothing_else_is_lost(source: str, tmp_path: Path) -> None:
    _notebook(tmp_path / "notebooks", source)
    results = tmp_path / "results"
    (results / "notebooks").mkdir(parents=True)
    (results / "notebooks" / "01_try.ipynb").write_text("the good one from before")
    with pytest.raises(RunFailedError, match="01_try"):
        run_notebooks("smoke", results=results, sources=tmp_path / "notebooks")
    assert (results / "notebooks" / "01_try.ipynb").read_text() == "the good one from before"
    assert not is_complete(results / "notebooks" / "01_try.failed.ipynb")
    assert not (results / "report").exists()


def test_notebooks_run_with_this_interpreter_and_make_a_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Other kernels of the same name, registered for the user or by JUPYTER_PATH, are passed over."""
    for variable in ("JUPYTER_PATH", "JUPYTER_DATA_DIR"):
        decoy = tmp_path / variable / "kernels" / "python3"
        decoy.mkdir(parents=True)
        spec = {"argv": ["/bin/false", "{connection_file}"], "display_name": "decoy", "language": "python"}
        (decoy / "kernel.json").write_text(json.dumps(spec))
        monkeypatch.setenv(variable, str(tmp_path / variable))
    _notebook(tmp_path / "notebooks", "import sys\nprint(sys.executable, steps)")
    results = tmp_path / "results"
    made = run_notebooks("smoke", assignments=["steps=41"], results=results, sources=tmp_path / "notebooks")
    build_report(made, results, replays=False)
    text = (results / "report" / "01_try.html").read_text()
    assert sys.executable in text and " 41" in text
    assert not re.search(r'(src|href)="https?://(?!squidfunk)', text)
