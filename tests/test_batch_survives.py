"""Batches that are killed, run out of disk or may not write, and go on; and what the workflow itself costs."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from sessions import alive  # type: ignore[import-not-found]  # pytest puts this folder on the path

from reproduce.experiments.workflow.batch import run_batch
from reproduce.experiments.workflow.plan import Plan
from reproduce.storage.errors import RunFailedError, UserError

pytestmark = [pytest.mark.slow, pytest.mark.timeout(3600)]
KILLS = 30
METHODS = "random,ppo_lstm,hrl_dcs"


def start(out: Path, log: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "reproduce", "batch", "--preset", "smoke", "--methods", METHODS, "--slots", "2"]
    with log.open("ab") as sink:
        return subprocess.Popen([*command, "--out", str(out)], stdout=sink, stderr=sink, start_new_session=True)


def tables(out: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted((out / "tables").glob("*.csv"))}


def test_thirty_kills_change_no_table(tmp_path: Path) -> None:
    """The batch, Snakemake, trainings, their workers, evaluations and notebooks are killed, whichever is drawn."""
    log = tmp_path / "log"
    assert start(tmp_path / "whole", log).wait() == 0, log.read_text()[-2000:]
    expected = tables(tmp_path / "whole")
    assert {"success.csv", "conditions.csv"} <= set(expected)
    kill_and_go_on(tmp_path, log, expected)


def kill_and_go_on(folder: Path, log: Path, expected: dict[str, bytes]) -> None:
    """Kill whatever is drawn of a batch, again and again, and start it again whenever it has ended."""
    rng = np.random.default_rng(0)
    kills, starts, out = 0, 0, folder / "killed"
    while True:
        process = start(out, log)
        starts += 1
        while process.poll() is None:
            if kills == KILLS:
                process.wait()
                break
            end = time.monotonic() + float(rng.uniform(2.0, 10.0))
            while time.monotonic() < end and process.poll() is None:
                time.sleep(0.1)
            running = alive(process.pid) if process.poll() is None else []
            if running:
                os.kill(int(rng.choice(running)), signal.SIGKILL)
                kills += 1
        if process.returncode == 0 and kills == KILLS:
            break
        assert starts < 2 * KILLS, log.read_text()[-2000:]
        if process.returncode == 0:  # done before all kills: the next ones meet a fresh folder
            assert tables(out) == expected, f"after {kills} kills"
            out = folder / f"killed{kills}"
    assert tables(out) == expected
    print(f"{kills} kills, {starts} starts")


def test_the_workflow_costs_little(tmp_path: Path) -> None:
    """8 jobs in two slots take at most 1.15 times half the sum of their times."""
    plan = Plan.make("smoke", ["ppo_lstm"], list(range(8)), threads=1)
    begun = time.monotonic()
    run_batch(plan, tmp_path, slots=2, until="policies", echo=lambda words: None)
    took = time.monotonic() - begun
    jobs = plan.jobs("policies")
    alone = [float(pd.read_csv(tmp_path / f"timings/{job.label}.tsv", sep="\t")["s"].iloc[0]) for job in jobs]
    assert len(alone) == 8
    print(f"8 jobs: {took:.1f} s, half the sum {sum(alone) / 2:.1f} s, ratio {took / (sum(alone) / 2):.3f}")
    assert took <= 1.15 * sum(alone) / 2


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    disk = tmp_path / "disk"
    disk.mkdir()
    done = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=400k", "tmpfs", str(disk)], capture_output=True)
    if done.returncode != 0:
        pytest.skip("mounting a small file system wants root")
    yield disk
    subprocess.run(["umount", "-l", str(disk)], check=True)


def test_a_full_disk_and_a_read_only_folder_are_named_and_lose_nothing(small_disk: Path, tmp_path: Path) -> None:
    def go(out: Path) -> None:
        plan = Plan.make("smoke", ["random", "ppo_lstm"], [0], threads=1)
        run_batch(plan, out, slots=2, until="tables", echo=lambda words: None)

    def remount(options: str) -> None:
        subprocess.run(["mount", "-o", f"remount,{options}", str(small_disk)], check=True)

    with pytest.raises((RunFailedError, UserError), match=r"No space left|cannot write"):
        go(small_disk / "out")
    assert not (small_disk / "out" / "tables").exists()
    remount("size=100m,ro")
    with pytest.raises(UserError, match="cannot write"):
        go(small_disk / "out")
    remount("size=100m,rw")
    go(small_disk / "out")
    go(tmp_path / "elsewhere")
    assert tables(small_disk / "out") == tables(tmp_path / "elsewhere")
