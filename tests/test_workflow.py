"""The batch: its plan, what it does again and what not, and what it says when something fails."""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from reproduce.experiments.evaluations import EVALUATIONS
from reproduce.experiments.methods import METHODS
from reproduce.experiments.train import train_as_needed
from reproduce.experiments.workflow.batch import LOCK, remaining, run_batch
from reproduce.experiments.workflow.plan import Job, Plan, parse_seeds
from reproduce.storage.errors import RunFailedError, UserError
from reproduce.storage.files import read_json, write_json


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
    assert {f"reference/hrl_dcs/seed3/{check}.json" for check in EVALUATIONS} <= outputs
    assert "reference/fun/seed0/run.json" in outputs and "reference/random/seed0/evaluation.json" in outputs
    assert "reference/random/seed0/run.json" not in outputs and "reference/random/seed3/evaluation.json" not in outputs
    assert [job.rule for job in made.jobs("tables")][-1] == "tables" and jobs[-1].rule == "report"
    write_json(tmp_path / "batch.json", made.as_data())
    assert Plan.read(tmp_path / "batch.json") == made
    write_json(tmp_path / "batch.json", {"preset": "smoke"})
    with pytest.raises(UserError, match="plan of a batch"):
        Plan.read(tmp_path / "batch.json")
    with pytest.raises(UserError, match="method"):
        plan("nonsense")


def test_what_is_left_is_estimated_from_what_was_measured(tmp_path: Path) -> None:
    def job(name: str, guess: float) -> Job:
        return Job("train", name, Path(name), Path(name), Path(f"{name}.tsv"), guess)

    jobs = [job("a", 10.0), job("b", 20.0), job("c", 30.0)]
    assert remaining(jobs, set(), tmp_path, 1) == 60.0
    assert remaining(jobs, set(), tmp_path, 3) == 30.0  # no shorter than its longest step
    (tmp_path / "a.tsv").write_text("s\th:m:s\n5.0\t0:00:05\n")
    assert remaining(jobs, {jobs[0]}, tmp_path, 1) == 25.0  # half as long as guessed


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("batch") / "out"
    run_batch(plan("random"), out, until="tables", echo=_quiet)
    return out


def _quiet(words: str) -> None:
    del words


def test_a_batch_writes_evaluations_tables_and_claims(done: Path) -> None:
    assert read_json(done / "reference/random/seed0/evaluation.json", "evaluation")["tests"] == 8
    for name in ("table1.csv", "claims.json", "tables/success.csv", "tables/paired_test.csv"):
        assert (done / name).is_file(), name
    assert "random,0,evaluation" in (done / "tables" / "success.csv").read_text()


def test_a_batch_does_again_only_what_changed(done: Path) -> None:
    evaluation = done / "reference/random/seed0/evaluation.json"

    def again(chosen: Plan) -> bool:
        before = evaluation.stat().st_mtime_ns
        run_batch(chosen, done, until="tables", echo=_quiet)
        return evaluation.stat().st_mtime_ns != before

    assert not again(plan("random"))
    assert again(replace(plan("random"), environment="another"))
    assert again(plan("random")) and not again(plan("random"))


def test_a_failed_step_is_named_and_the_same_command_goes_on(tmp_path: Path) -> None:
    bad = tmp_path / "reference" / "random"
    bad.mkdir(parents=True)
    (bad / "seed0").write_text("in the way")
    with pytest.raises(RunFailedError, match=r"evaluation of random seed 0|Snakemake"):
        run_batch(plan("random"), tmp_path, until="tables", echo=_quiet)
    (bad / "seed0").unlink()
    run_batch(plan("random"), tmp_path, until="tables", echo=_quiet)
    assert (tmp_path / "tables" / "success.csv").is_file()


def test_a_second_batch_in_one_folder_is_told_so(tmp_path: Path) -> None:
    with (tmp_path / LOCK).open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        lock.write("process 7")
        lock.flush()
        with pytest.raises(UserError, match=r"another batch.*process 7"):
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
    with pytest.raises(UserError, match=r"file/out.*cannot write"):
        run_batch(plan("random"), tmp_path / "file" / "out", echo=_quiet)


def test_snakemake_ends_when_its_batch_is_killed(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "reproduce", "batch", "--methods", "planner", "--out", str(tmp_path / "out")]
    process = subprocess.Popen([*command, "--until", "tables"], stdout=subprocess.DEVNULL, start_new_session=True)
    log = tmp_path / "out" / "logs" / "evaluate_planner_seed0_evaluation.log"
    end = time.monotonic() + 60
    while not log.is_file() and time.monotonic() < end:
        time.sleep(0.1)
    process.kill()
    process.wait()
    while time.monotonic() < end + 60:
        with (tmp_path / "out" / LOCK).open("r+") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return  # Snakemake held it too, and is gone
            except OSError:
                time.sleep(0.2)
    pytest.fail("Snakemake went on without its batch")


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
