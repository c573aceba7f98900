"""The batch: its plan, what it does again and what not, and what it says when something fails."""

from __future__ import annotations

import fcntl
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import pytest
from command_line import call  # type: ignore[import-not-found]  # pytest puts this folder on the path
from sessions import alive  # type: ignore[import-not-found]

from reproduce.experiments.evaluations import evaluations_of
from reproduce.experiments.methods import METHODS
from reproduce.experiments.train import train_as_needed
from reproduce.experiments.workflow.batch import LOCK, run_batch
from reproduce.experiments.workflow.plan import Plan, parse_seeds
from reproduce.storage.errors import UserError
from reproduce.storage.files import read_json, write_json
from reproduce.storage.paths import ROOT


def plan(*methods: str, seeds: tuple[int, ...] = (0,)) -> Plan:
    return Plan.make("smoke", list(methods), list(seeds), threads=1)


def test_seeds_are_read_as_written() -> None:
    assert parse_seeds("0-2, 7") == [0, 1, 2, 7] and parse_seeds("3") == [3]
    for bad in ("", "a", "-1", "3-1", "0-", "1.5", "0-99999"):
        with pytest.raises(UserError, match="--seeds"):
            parse_seeds(bad)


def test_a_plan_has_a_step_for_each_file_and_round_trips(tmp_path: Path) -> None:
    made = plan("random", "hrl_dcs", "fun", seeds=(0, 3))
    jobs = made.jobs()
    assert len({job.output for job in jobs}) == len(jobs)
    outputs = {str(job.output) for job in jobs}
    assert {f"reference/hrl_dcs/seed3/{check}.json" for check in evaluations_of("hrl_dcs")} <= outputs
    assert "reference/fun/seed0/run.json" in outputs and "reference/random/seed0/evaluation.json" in outputs
    assert "reference/random/seed0/run.json" not in outputs and "reference/random/seed3/evaluation.json" not in outputs
    assert [job.rule for job in made.jobs("tables")][-1] == "tables" and jobs[-1].rule == "report"
    write_json(tmp_path / "batch.json", asdict(made))
    assert Plan.read(tmp_path / "batch.json") == made
    write_json(tmp_path / "batch.json", {"preset": "smoke"})
    with pytest.raises(UserError, match="plan of a batch"):
        Plan.read(tmp_path / "batch.json")
    with pytest.raises(UserError, match="method"):
        plan("nonsense")


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the Python of an environment in a folder with a space in its name; the packages lie there, too."""
    folder = tmp_path_factory.mktemp("a folder") / "a checkout"
    for name in ("envs", "reproduce", "notebooks"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", folder)
    (folder / ".venv" / "bin").mkdir(parents=True)
    shutil.copy(Path(sys.prefix) / "pyvenv.cfg", folder / ".venv")
    (folder / ".venv" / "lib").symlink_to(Path(sys.prefix) / "lib")
    executable = folder / ".venv" / "bin" / "python"
    executable.symlink_to(Path(sys.executable).resolve())
    return executable


def of_random(out: Path) -> list[str]:
    """Return the arguments for the smoke batch of ``random`` up to its tables."""
    limits = ["--threads", "1", "--slots", "1", "--until", "tables"]
    return ["batch", "--preset", "smoke", "--methods", "random", *limits, "--out", str(out)]


@pytest.fixture(scope="module")
def failed_and_done(python: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """Return what a batch said that failed, and its folder after the same command went on from there."""
    out = tmp_path_factory.mktemp("batch") / "an out"
    (out / "reference" / "random").mkdir(parents=True)
    (out / "reference" / "random" / "seed0").write_text("in the way")
    failed = call(*of_random(out))
    assert failed.code == 1, failed.err
    (out / "reference" / "random" / "seed0").unlink()
    checkout = python.parents[2]
    environment = {**os.environ, "PYTHONPATH": f"{checkout / 'envs'}:{checkout}"}
    command = [str(python), "-m", "reproduce", *of_random(out)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "3 of 4 steps" in done.stdout and f"{out}/tables: done" in done.stdout
    return failed.err, out


@pytest.fixture(scope="module")
def done(failed_and_done: tuple[str, Path]) -> Path:
    return failed_and_done[1]


def _quiet(words: str) -> None:
    del words


@pytest.mark.process
def test_a_batch_writes_evaluations_tables_and_claims(done: Path) -> None:
    assert read_json(done / "reference/random/seed0/evaluation.json", "evaluation")["tests"] == 8
    for name in ("table1.csv", "claims.json", "tables/success.csv", "tables/paired_test.csv"):
        assert (done / name).is_file(), name
    assert "random,0,evaluation" in (done / "tables" / "success.csv").read_text()
    timings = (done / "timings.csv").read_text().splitlines()
    assert timings[0] == "rule,step,output,seconds" and len(timings) == 4
    assert all(float(line.rsplit(",", 1)[1]) > 0 for line in timings[1:])


def left(chosen: Plan, out: Path) -> list[str]:
    """Return what a dry run says."""
    lines: list[str] = []
    run_batch(chosen, out, until="tables", dry_run=True, echo=lines.append)
    return lines


@pytest.mark.process
def test_a_batch_does_again_only_what_changed(done: Path) -> None:
    evaluation = done / "reference/random/seed0/evaluation.json"
    before = evaluation.stat().st_mtime_ns
    another = replace(plan("random"), environment="another")
    assert left(plan("random"), done)[-1] == "0 steps left"
    run_batch(plan("random"), done, until="tables", echo=_quiet)
    assert evaluation.stat().st_mtime_ns == before
    assert "reference/random/seed0/evaluation.json" in left(another, done)
    run_batch(another, done, until="tables", echo=_quiet)
    assert evaluation.stat().st_mtime_ns != before
    assert left(another, done)[-1] == "0 steps left" and left(plan("random"), done)[-1] == "3 steps left"


@pytest.mark.process
def test_a_dry_run_names_what_is_left_and_leaves_no_trace(tmp_path: Path) -> None:
    lines = left(plan("random"), tmp_path / "new")
    assert {"reference/random/seed0/evaluation.json", "reference/random/seed0/evaluation.csv"} <= set(lines)
    assert lines[-1] == "3 steps left"
    assert any("reason: Missing output files" in line for line in lines)
    assert not list(tmp_path.iterdir())


@pytest.mark.process
def test_a_failed_step_is_named_and_the_same_command_goes_on(failed_and_done: tuple[str, Path]) -> None:
    told, out = failed_and_done
    assert len(told.splitlines()) == 1
    assert "batch failed: " in told and ("evaluation of random seed 0" in told or "Snakemake" in told)
    assert (out / "tables" / "success.csv").is_file()


def test_a_second_batch_in_one_folder_is_told_so(tmp_path: Path) -> None:
    with (tmp_path / LOCK).open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        lock.write("process 7")
        lock.flush()
        with pytest.raises(UserError, match=r"the batch is in use by another process \(process 7\)"):
            run_batch(plan("random"), tmp_path, echo=_quiet)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (lambda: run_batch(plan("random"), Path("x"), profile="nowhere"), "--profile"),
        (lambda: run_batch(plan("random"), Path("x"), slots=0), "--slots"),
        (lambda: run_batch(plan("random"), Path("x"), until="noon"), "--until"),
    ],
)
def test_bad_options_are_named(change: Callable[[], None], word: str, tmp_path: Path) -> None:
    os.chdir(tmp_path)
    with pytest.raises(UserError, match=word):
        change()
    assert not (tmp_path / "x").exists()


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match=r"file/out.*cannot be written"):
        run_batch(plan("random"), tmp_path / "file" / "out", echo=_quiet)


@pytest.mark.process
@pytest.mark.parametrize("whom", ["batch", "snakemake"])
def test_no_step_outlives_its_batch_or_snakemake(tmp_path: Path, whom: str) -> None:
    out = tmp_path / "out"
    command = [
        sys.executable,
        "-m",
        "reproduce",
        "batch",
        "--preset",
        "laptop",
        "--methods",
        "planner",
        "--out",
        str(out),
    ]
    process = subprocess.Popen(
        [*command, "--until", "tables"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    )
    end = time.monotonic() + 60
    # The tests of either evaluation have begun, whichever comes first.
    while not any(log.stat().st_size for log in out.glob("logs/evaluate_planner_*.log")) and time.monotonic() < end:
        time.sleep(0.1)
    assert len(alive(process.pid)) > 2
    (snakemake,) = map(int, Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split())
    os.kill(process.pid if whom == "batch" else snakemake, signal.SIGKILL)
    process.wait()
    while alive(process.pid) and time.monotonic() < end + 30:
        time.sleep(0.1)
    assert not alive(process.pid)
    with (out / LOCK).open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)


@pytest.mark.process
def test_training_as_needed_begins_goes_on_ends_and_sets_aside(tmp_path: Path) -> None:
    method, folder = METHODS["ppo_lstm"], tmp_path / "reference" / "ppo_lstm" / "seed0"
    config = replace(method.config("smoke"), steps=512, n_envs=2)

    def go(steps: int) -> int:
        train_as_needed(method, replace(config, steps=steps), 0, folder, "smoke", quiet=True)
        return (folder / "run.json").stat().st_mtime_ns

    first = go(512)
    assert go(512) == first
    assert go(640) != first
    old = folder / "superseded" / "1"
    assert read_json(old / "run.json", "run")["steps"] == 512
    assert read_json(folder / "config.json", "configuration")["training"]["steps"] == 640
