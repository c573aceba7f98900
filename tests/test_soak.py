"""The soak run: what it sees in a short form, and that each of its checks can fail."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lunar_rescue import LunarRescueEnv
from lunar_rescue.observation import BOUND, SIZE
from lunar_rescue.scenes.scene import task_distribution
from lunar_rescue.scenes.splits import TRAIN
from reproduce.experiments.soak import (
    FIRST_SEED,
    SETTLED,
    Record,
    judge,
    memory_growth,
    observation_fault,
    random_actions,
    run_share,
    run_soak,
    scenes_of,
    soak,
    summary,
)
from reproduce.storage.errors import RunFailedError, UserError

MEBIBYTE = 2**20


def series(last_half: float, steps: int = SETTLED) -> Record:
    """A process whose memory fills at first, then grows by a share over the last half."""
    record = Record(steps=steps)
    for number in range(1, 201):
        size = min(100.0, 50 + number) + 100 * last_half * max(0.0, number / 200 - 0.5) / 0.5
        record.samples.append((steps * number // 200, number, int(size * MEBIBYTE)))
    return record


def test_a_short_run_passes_and_says_what_it_met(tmp_path: Path) -> None:
    target = tmp_path / "soak.json"
    run_soak(3000, target, quiet=True)
    result = json.loads(target.read_text())
    assert result["passed"] and not result["faults"] and not result["memory_judged"]
    assert result["steps"] == 3000 == sum(p["steps"] for p in result["processes"])
    assert result["episodes"] == sum(result["ends"].values()) > 10
    assert result["postures"] > 10 and result["tasks"] == ["lift", "turn_over"]
    assert all(30 <= len(p["samples"]) <= 50 for p in result["processes"])
    assert result["steps_per_s"] > 0 and "commit" in result["origin"]


def test_every_process_meets_all_postures_and_tasks_and_no_seed_twice() -> None:
    pairs = task_distribution()
    seeds: list[int] = []
    for index in range(2):
        scenes = list(islice(scenes_of(index, 2), len(pairs)))
        assert {(s.posture, s.task) for s in scenes} == set(pairs)
        seeds += [s.seed for s in scenes]
    assert len(set(seeds)) == len(seeds) and min(seeds) == FIRST_SEED
    assert all(seed in TRAIN for seed in seeds)


def test_actions_are_held_at_times_and_noise_at_others() -> None:
    actions = np.array(list(islice(random_actions(np.random.default_rng(0)), 1000)))
    held = (actions[1:] == actions[:-1]).all(axis=1).mean()
    assert 0.5 < held < 0.9 and np.abs(actions).max() <= 1


@pytest.mark.parametrize("growth", [-0.02, 0.0, 0.005])
def test_memory_that_stands_still_passes(growth: float) -> None:
    assert not judge([series(growth)])


@pytest.mark.parametrize("growth", [0.02, 0.5])
def test_memory_that_grows_fails(growth: float) -> None:
    faults = judge([series(0.0), series(growth)])
    assert len(faults) == 1 and faults[0].startswith("process 1: memory grew")
    assert not judge([series(growth, steps=SETTLED - 1)])


def test_growth_is_that_of_the_medians() -> None:
    assert memory_growth([1] * 50 + [100] * 10 + [7] * 30 + [103] * 9 + [10**9]) == pytest.approx(0.03)
    assert memory_growth([1, 2, 3]) == 0.0


def test_kinds_of_scene_that_are_never_met_fail() -> None:
    record = Record(steps=10, episodes=10**6)
    record.scenes["supine", "lift", "smooth"] = 10**6
    assert "never met" in judge([record])[0]
    assert not judge([Record(steps=10, episodes=3)])


@pytest.mark.parametrize(
    ("vector", "word"),
    [
        (np.zeros(SIZE, np.float32), ""),
        (np.full(SIZE, np.nan, np.float32), "not finite"),
        (np.full(SIZE, 1.01 * BOUND, np.float32), "beyond"),
        (np.zeros(SIZE), "float32"),
        (np.zeros(SIZE + 1, np.float32), "float32"),
        ([0.0] * SIZE, "float32"),
    ],
)
def test_observations_are_checked(vector: Any, word: str) -> None:
    fault = observation_fault(vector)
    assert word in fault and bool(fault) == bool(word)


def _spoil(env: LunarRescueEnv, monkeypatch: pytest.MonkeyPatch, how: str) -> None:
    step: Callable[..., Any] = env.step_flat
    calls = 0

    def spoilt(action: Any) -> Any:
        nonlocal calls
        calls += 1
        vector, reward, *rest = step(action)
        if calls == 30:
            if how == "raise":
                raise ArithmeticError("spoilt")
            if how == "observation":
                vector[3] = np.nan
            if how == "reward":
                reward = float("inf")
            if how == "body":
                env.episode.body.centre[2] = np.nan
        return vector, reward, *rest

    monkeypatch.setattr(env, "step_flat", spoilt)


@pytest.mark.parametrize(
    ("how", "word"),
    [("raise", "spoilt"), ("observation", "not finite at [3]"), ("reward", "inf"), ("body", "centre")],
)
def test_the_run_stops_at_the_first_fault(
    env: LunarRescueEnv, monkeypatch: pytest.MonkeyPatch, how: str, word: str
) -> None:
    _spoil(env, monkeypatch, how)
    record = run_share(env, 100, 0, 1, lambda _: None)
    assert word in record.fault and f"scene {FIRST_SEED}" in record.fault
    assert record.steps <= 30
    assert not summary([record], judge([record]))["passed"]


def test_a_failed_run_writes_its_file_and_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("reproduce.experiments.soak.soak", lambda steps, quiet: [series(0.3)])
    with pytest.raises(RunFailedError, match="memory grew"):
        run_soak(100, tmp_path / "soak.json", quiet=True)
    assert not json.loads((tmp_path / "soak.json").read_text())["passed"]


@pytest.mark.parametrize("steps", [0, -5, True, 1.5])
def test_bad_numbers_of_steps_are_refused(steps: Any) -> None:
    with pytest.raises(UserError, match="steps"):
        soak(steps)


def _alive(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


def test_ctrl_c_leaves_no_process_behind(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "reproduce", "soak", "--steps", "200000"]
    told = tmp_path / "stderr"
    with told.open("w") as stream:
        run = subprocess.Popen(command, stderr=stream, start_new_session=True)
    try:
        deadline = time.monotonic() + 60
        while not re.search(r"\| [1-9]", told.read_text()) and time.monotonic() < deadline:  # until they step
            time.sleep(0.1)
        assert run.poll() is None
        os.killpg(run.pid, signal.SIGINT)  # a terminal's Ctrl-C goes to the whole group
        assert run.wait(timeout=20) == 130
        assert "Traceback" not in told.read_text()
        deadline = time.monotonic() + 10
        while _alive(run.pid) and time.monotonic() < deadline:
            time.sleep(0.1)
        assert not _alive(run.pid)
    finally:
        if _alive(run.pid):
            os.killpg(run.pid, signal.SIGKILL)


@pytest.mark.parametrize(
    ("arguments", "word"),
    [(["soak", "--steps", "-5"], "steps"), (["bench", "--part", "physics"], "--part")],
)
def test_bad_calls_end_with_one_line_and_code_2(arguments: list[str], word: str, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "reproduce", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=120, check=False)
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1 and word in done.stderr
    assert not list(tmp_path.iterdir())
