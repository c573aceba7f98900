"""Recoveries: a demonstrator goes on from where a student has led, and follows paths without a clock."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from lunar_rescue import LunarRescueEnv, sample_scene
from lunar_rescue.observation import SIZE
from lunar_rescue.physics.robot import JOINTS
from reproduce.baselines.planner.planner import RescuePlanner
from reproduce.baselines.planner.rollout import Rollout, Track
from reproduce.experiments.demonstrate import demonstrate_scene
from reproduce.experiments.methods import get_method
from reproduce.experiments.presets import changed
from reproduce.experiments.recover import Demonstrator, recoveries
from reproduce.experiments.train import train
from reproduce.learning.config import PolicyConfig
from reproduce.learning.demonstrations import Demonstration
from reproduce.learning.networks import NetworkSpec
from reproduce.storage.policies import save_policy

SEED = 1_500_000_003


def _joints(first: float, second: float = 0.0) -> np.ndarray:
    return np.array([first, second, *[0.0] * (JOINTS - 2)])


def test_a_track_aims_ahead_of_the_nearest_point_whenever_it_is_asked() -> None:
    track = Track(np.array([_joints(0.0), _joints(1.0)]))
    for _ in range(3):  # no clock: arms that stay get the same answer
        assert track.aim(_joints(0.0))[0] == pytest.approx(0.16)
    assert track.aim(_joints(0.1))[0] == pytest.approx(0.26)
    assert not track.at_end
    for angle in (0.3, 0.5, 0.7, 0.9):
        aim = track.aim(_joints(angle))
    assert aim[0] == pytest.approx(1.0) and track.at_end
    assert track.aim(_joints(0.2))[0] == pytest.approx(1.0)  # what is passed is not gone back to


def test_a_track_can_begin_anywhere() -> None:
    path = np.array([_joints(0.0), _joints(1.0), _joints(1.0, 1.0)])
    assert Track(path).aim(_joints(0.9, 0.5)) == pytest.approx(_joints(0.38))  # looks 0.24 rad ahead, aims 0.16 further
    assert Track(path, _joints(1.0, 0.5)).aim(_joints(1.0, 0.5)) == pytest.approx(_joints(1.0, 0.66))


@pytest.fixture(scope="module")
def rescue() -> Demonstration:
    planner = RescuePlanner()
    (made,) = demonstrate_scene(SEED, planner, ())
    planner.close()
    return made


@pytest.mark.process
@pytest.mark.parametrize("steps", [6, 30])
def test_a_recovery_begins_where_somebody_else_has_led(steps: int, rescue: Demonstration, env: LunarRescueEnv) -> None:
    away = np.random.default_rng(1).normal(0.0, 0.05, (steps, JOINTS))
    astray = np.clip(rescue.actions[:steps] + np.cumsum(away, axis=0) * 0.3, -1.0, 1.0).astype(np.float32)
    made = Demonstrator(env, rescue).recover(astray)
    assert made is not None
    assert made.begin == steps and made.seed == SEED
    np.testing.assert_array_equal(made.actions[:steps], astray)
    assert len(made.actions) > steps
    trial = Rollout(env, sample_scene(SEED), list(made.actions)).so_far()
    assert trial.rescued and len(trial.actions) == len(made.actions)


def test_what_cannot_be_mended_is_no_recovery(rescue: Demonstration, env: LunarRescueEnv) -> None:
    still = np.repeat(rescue.actions[:1], 118, axis=0)  # two steps are left
    assert Demonstrator(env, rescue).recover(still) is None


@pytest.mark.process
def test_a_student_that_knows_nothing_is_taken_over(rescue: Demonstration, tmp_path: Path) -> None:
    spec = NetworkSpec(SIZE, JOINTS, 8, False)
    seen = PolicyConfig(mirror=True, set_point_changes=True, places=None)
    save_policy(tmp_path, "ppo_lstm", {"policy": (spec, spec.build())}, seen)
    noisy = Demonstration(SEED, rescue.actions, -rescue.actions)
    made, share = recoveries(tmp_path, [noisy, rescue], quiet=True)
    assert share == 0.0
    assert 1 <= len(made) <= 4
    assert all(one.begin > 0 and one.seed == SEED for one in made)
    assert [len(one.actions) for one in recoveries(tmp_path, [rescue], quiet=True)[0]] == [
        len(one.actions) for one in made
    ]


@pytest.mark.process
@pytest.mark.parametrize("name", ["ppo_lstm_demos", "hrl_dcs_demos"])
def test_a_training_goes_through_rounds_of_recoveries(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("reproduce.experiments.train.RESULTS", tmp_path / "results")
    method = get_method(name)
    config = changed(method.config("smoke"), {"imitation.recoveries": 1, "imitation.scenes": 1})
    train(method, config, 0, tmp_path / "run", "smoke", quiet=True)
    account = json.loads((tmp_path / "run" / "run.json").read_text())["demonstrations"]
    assert account["scenes"] == 1 and account["student_rescues"] == 0.0
    assert account["recoveries"] >= 1
    rows = pd.read_csv(tmp_path / "run" / "imitation.csv")
    assert rows["round"].unique().tolist() == [0, 1]
    assert rows.groupby("round").size().nunique() == 1
    assert rows["seconds"].is_monotonic_increasing
