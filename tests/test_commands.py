"""The command line as a user meets it: good calls, and one clear line with exit code 2 for bad ones."""

from __future__ import annotations

import json
import os
import pickle
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path

import nbformat
import pandas as pd
import pytest
import torch as th
from command_line import call, without_progress  # type: ignore[import-not-found]  # pytest puts this folder on the path
from safetensors.torch import load_file, save_file
from sessions import alive, nobody_left, wait_for  # type: ignore[import-not-found]

from reproduce.experiments.evaluate import evaluate, rescue_scenes
from reproduce.experiments.methods import METHODS
from reproduce.experiments.presets import PRESETS
from reproduce.report.film import film
from reproduce.report.notebooks import check_parameters, find_notebooks, is_complete, parse_assignments, run_notebooks
from reproduce.report.site import build_report
from reproduce.storage.errors import RunFailedError, UserError
from reproduce.storage.records import from_dict, to_dict

STEPS = 1024


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "hrl"
    done = call("train", "hrl_dcs", "--preset", "smoke", "--seed", "0", "--steps", str(STEPS), "--out", str(folder))
    assert done.code == 0, done.err
    return folder


@pytest.mark.process
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


@pytest.mark.process
def test_evaluation_has_the_contract_s_fields(run: Path, tmp_path: Path) -> None:
    target = tmp_path / "evaluation.json"
    done = call("evaluate", str(run), "--tests", "4", "--first-seed", "7", "--json", str(target))
    assert done.code == 0, done.err
    result = json.loads(target.read_text())
    assert {
        "method", "tests", "successes", "success_rate", "wilson_low", "wilson_high", "seconds", "seconds_per_test",
        "first_seed", "both_arms_under", "by_task", "by_posture", "failures",
    } <= set(result)  # fmt: skip
    assert result["tests"] == 4 and result["first_seed"] == 7
    assert sum(c["tests"] for c in result["by_posture"].values()) == 4


@pytest.mark.process
def test_an_evaluation_prints_the_answer_first_and_the_rest_when_asked() -> None:
    short, long = (call("evaluate", "random", "--tests", "6", *more) for more in ([], ["--verbose"]))
    first, *causes = short.out.splitlines()
    told = re.fullmatch(r"random: (\d) of 6 rescued, [\d.]+ % \[([\d.]+), ([\d.]+)\]", first)
    assert told and float(told[2]) <= 100 * int(told[1]) / 6 <= float(told[3])
    counts = [re.fullmatch(r"  failed by [a-z ]+: (\d)", line) for line in causes]
    assert sum(int(count[1]) for count in counts if count) == 6 - int(told[1]) and all(counts)
    assert long.out.startswith(short.out)
    assert "both arms under: " in long.out and "  task lift: " in long.out and "  posture " in long.out


@pytest.mark.process
def test_results_do_not_depend_on_workers_or_neighbours(run: Path) -> None:
    together = rescue_scenes(run, 3, workers=2, quiet=True)
    alone = [row for seed in range(3) for row in rescue_scenes(run, 1, first_seed=seed, workers=1, quiet=True)]
    assert together == alone


@pytest.mark.process
def test_replay_writes_a_film(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("reproduce.report.film.film", cache(film))  # the same rescue in each format
    for ending in (".mp4", ".gif", ".png"):
        out = tmp_path / f"rescue{ending}"
        done = call("replay", "scripted", "--seed", "0", "--out", str(out))
        assert done.code == 0, done.err
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
    (["train", "hrl_dcs", "--out", ""], "--out"),
    (["train", "hrl_dcs", "--out", "x", "--as-needed", "--resume"], "--as-needed"),
    (["evaluate", "scripted", "--tests", "1", "--json", "."], "folder"),
    (["replay", "scripted", "--out", "x.png", "--seed", "-1"], "--seed"),
    (["watch", "scripted", "--rescues", "-1"], "--rescues"),
    (["batch", "--slots", "0"], "--slots"),
    (["tune", "fun", "--tests", "0"], "--tests"),
    (["solvable", "--variants", "-2"], "--variants"),
]


@pytest.mark.parametrize(("arguments", "word"), BAD_CALLS, ids=[" ".join(a) for a, _ in BAD_CALLS])
def test_bad_calls_end_with_one_line_and_code_2(arguments: list[str], word: str, tmp_path: Path) -> None:
    done = call(*arguments, cwd=tmp_path)
    assert done.code == 2
    assert word in done.complaint and done.complaint.startswith("reproduce:")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "arguments",
    [
        ["train", "hrl_dcs", "--out", "file/run"],
        ["train", "hrl_dcs", "--out", "file"],
        ["evaluate", "scripted", "--tests", "1", "--json", "file/x.json"],
        ["replay", "scripted", "--out", "file/x.png"],
        ["claims", "--json", "file/x.json"],
    ],
    ids=" ".join,
)
def test_a_place_that_cannot_be_written_is_refused_before_any_work(arguments: list[str], tmp_path: Path) -> None:
    (tmp_path / "file").write_text("as it was")
    done = call(*arguments, cwd=tmp_path)
    assert (done.code, done.out) == (2, "") and "file" in done.complaint and "cannot be written" in done.complaint
    assert (tmp_path / "file").read_text() == "as it was" and len(list(tmp_path.iterdir())) == 1


@pytest.mark.process
def test_results_are_printed_even_where_their_file_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(path: Path, data: object) -> None:
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr("reproduce.experiments.evaluate.write_json", fail)
    done = call("evaluate", "scripted", "--tests", "1", "--json", str(tmp_path / "x.json"))
    assert done.code == 1 and "of 1 rescued" in done.out
    assert "No space left" in done.complaint and "x.json" in done.complaint


def _shell(command: str) -> subprocess.CompletedProcess[str]:
    line = command.replace("reproduce", f"'{sys.executable}' -O -m reproduce", 1)
    return subprocess.run(["bash", "-c", line], capture_output=True, text=True, timeout=120, check=False)


@pytest.mark.process
def test_a_new_process_and_closed_full_or_broken_outputs() -> None:
    done = _shell("reproduce evaluate scripted --tests 0")
    assert done.returncode == 2 and "--tests" in done.stderr and len(done.stderr.splitlines()) == 1
    for ending, code in (
        ("methods >&-", 0),
        ("--help >&- 2>&-", 0),
        ("--help | true; exit ${PIPESTATUS[0]}", None),
        ("--help >/dev/full", 1),
    ):
        done = _shell(f"reproduce {ending}")
        assert code is None or done.returncode == code, ending
        assert "Traceback" not in done.stderr and len(done.stderr.splitlines()) <= 1, ending


def _interrupt(command: list[str], begun: Callable[[int], bool]) -> list[str]:
    """Start a process, press Ctrl-C once it is at work, and return the lines on standard error, progress bars aside."""
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)
    try:
        assert wait_for(lambda: begun(process.pid))
        os.killpg(process.pid, signal.SIGINT)
        _, said = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 130 and nobody_left(process.pid)
    return without_progress(said)


@pytest.mark.process
def test_ctrl_c_ends_an_evaluation_with_one_line() -> None:
    command = [sys.executable, "-m", "reproduce", "evaluate", "scripted", "--tests", "900"]
    # The command, the fork server, what tracks their resources, and a worker, which still imports.
    assert _interrupt(command, lambda session: len(alive(session)) >= 4) == ["reproduce: interrupted"]


@pytest.mark.process
def test_ctrl_c_ends_notebooks_with_one_line_and_no_kernel(tmp_path: Path) -> None:
    begun = tmp_path / "begun"
    _notebook(tmp_path / "notebooks", f"import pathlib, time\npathlib.Path({str(begun)!r}).touch()\ntime.sleep(600)")
    script = tmp_path / "few_notebooks.py"
    script.write_text(
        "import sys\nfrom functools import partial\nfrom pathlib import Path\nfrom reproduce.__main__ import main\n"
        "import reproduce.report.notebooks as module\nhere = Path(__file__).parent\n"
        "module.run_notebooks = partial(module.run_notebooks, results=here / 'results', sources=here / 'notebooks')\n"
        "sys.argv = ['reproduce', 'notebooks', '--no-report']\nmain()\n"
    )
    assert _interrupt([sys.executable, str(script)], lambda session: begun.is_file()) == ["reproduce: interrupted"]
    assert not (tmp_path / "results" / "notebooks" / "01_try.ipynb").exists()


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


@pytest.mark.process
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
        assert done.code == 2 and done.complaint
    if how == "pickle":
        assert not (tmp_path / "fired").exists()


@pytest.mark.process
def test_a_finished_run_is_neither_overwritten_nor_resumed(run: Path) -> None:
    before = (run / "policy.safetensors").read_bytes()
    for options, words in (([], "choose another --out"), (["--resume"], "nothing is left to resume")):
        done = call("train", "hrl_dcs", "--preset", "smoke", "--steps", "512", "--out", str(run), *options)
        assert done.code == 2 and "finished run" in done.complaint and words in done.complaint
    assert (run / "policy.safetensors").read_bytes() == before


@pytest.mark.process
def test_a_training_is_not_resumed_with_another_configuration(run: Path, tmp_path: Path) -> None:
    shutil.copy(run / "config.json", tmp_path)
    done = call("train", "hrl_dcs", "--preset", "smoke", "--steps", "2048", "--out", str(tmp_path), "--resume")
    assert done.code == 2 and f"training.steps was {STEPS}, is 2048" in done.complaint
    assert {path.name for path in tmp_path.iterdir()} == {"config.json"}


def test_a_folder_with_another_program_s_configuration_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text('{"editor": "dark"}')
    (tmp_path / "thesis.txt").write_text("all of it")
    done = call("train", "hrl_dcs", "--preset", "smoke", "--out", ".", "--as-needed", cwd=tmp_path)
    assert done.code == 2 and "configuration of a training" in done.complaint
    assert {path.name for path in tmp_path.iterdir()} == {"config.json", "thesis.txt"}


def test_configuration_survives_json_and_refuses_strangers() -> None:
    for method in METHODS.values():
        for preset in PRESETS:
            config = method.config(preset)
            assert from_dict(method.kind, json.loads(json.dumps(to_dict(config))), "config.") == config
    kind = METHODS["hrl_dcs"].kind
    raw = to_dict(METHODS["hrl_dcs"].config("smoke"))
    for part, field, value, words in (
        ("low", "learning_rat", 1.0, "config.low.learning_rat: unknown field"),
        ("low", "gamma", 1.5, "config.low.gamma: expected less than or equal to 1, got 1.5"),
        ("low", "n_steps", True, "config.low.n_steps: expected a valid integer, got True"),
        ("goals", "reach", "far", "config.goals.reach: expected a valid number, got 'far'"),
        ("priors", "mirror", None, "config.priors.mirror: missing"),
    ):
        changed = {name: value for name, value in {**raw[part], field: value}.items() if value is not None}
        with pytest.raises(UserError) as error:
            from_dict(kind, {**raw, part: changed}, "config.")
        assert str(error.value) == words


# -- notebooks ---------------------------------------------------------------------------------------------------------
def _notebook(folder: Path, source: str, parameters: str = "steps = 3\nname = 'a'\nrate = 0.5") -> Path:
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    document = nbformat.v4.new_notebook(metadata={"kernelspec": kernel})
    first = nbformat.v4.new_code_cell(parameters)
    first.metadata["tags"] = ["parameters"]
    document.cells = [first, nbformat.v4.new_code_cell(source), nbformat.v4.new_code_cell("print('last')")]
    folder.mkdir(exist_ok=True)
    path = folder / "01_try.ipynb"
    nbformat.write(document, path)
    return path


def test_every_notebook_has_a_parameters_cell_and_no_outputs() -> None:
    notebooks = find_notebooks()
    assert [n.path.stem[:2] for n in notebooks] == ["01", "02", "03", "04", "05", "06", "07", "08", "09", "10"]
    for notebook in notebooks:
        assert "preset" in notebook.defaults
        document = nbformat.read(notebook.path, as_version=4)
        code = [cell for cell in document.cells if cell.cell_type == "code"]
        assert "parameters" in code[0].metadata.tags
        assert not any(cell.outputs for cell in code)
        headings = [cell.source for cell in document.cells if cell.source.startswith("## ")]
        assert headings[-1].startswith(("## Summary", "## Conclusion", "## Appendix")), notebook.path


def test_parameters_are_checked_before_anything_runs(tmp_path: Path) -> None:
    _notebook(tmp_path / "notebooks", "print(steps)")
    notebooks = find_notebooks(sources=tmp_path / "notebooks")
    chosen = check_parameters(notebooks, "smoke", parse_assignments(["steps=5", "name=b", "rate=1"]))
    assert chosen == {"01_try": {"steps": 5, "name": "b", "rate": 1}}
    for bad in ("step=5", "steps=1.5", "steps='x'", "name=3", "steps=True"):
        with pytest.raises(UserError, match=bad.split("=")[0]):
            check_parameters(notebooks, "smoke", parse_assignments([bad]))


@pytest.mark.process
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


@pytest.mark.process
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
