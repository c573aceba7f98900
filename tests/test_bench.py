"""The speed figures: names, what they are made of, and what is left out. No test says how fast anything is."""

from __future__ import annotations

import json
import sys
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from reproduce.bench import speed as bench
from reproduce.bench import training
from reproduce.bench.speed import PEER, Tally, environment_figures, measure
from reproduce.experiments.presets import PRESETS
from reproduce.storage.errors import UserError


def tally(rate: float, inside: float = 0.5) -> Tally:
    """A round of 1000 steps and 10 resets that take 20 steps each."""
    return Tally(steps=1000, resets=10, stepping=1000 / rate, resetting=200 / rate, inside=inside * 1000 / rate)


@pytest.mark.process
def test_the_environment_part_measures_and_is_flat(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "MAX_STEPS", 5)
    monkeypatch.setitem(sys.modules, "panda_gym", None)  # as if it were not installed
    found = measure("env", rounds=2, steps=60)
    assert {
        "env_steps_per_s_1", "env_steps_per_s_1_with_resets", "env_steps_per_s_all", "share_in_physics",
        "reset_in_steps", "peer_published_steps_per_s", "rounds", "cores", "load_before", "origin",
    } <= set(found)  # fmt: skip
    assert not any(key.startswith("training") for key in found)
    assert 0 < found["share_in_physics"] < 1
    assert found["env_steps_per_s_1_with_resets"] < found["env_steps_per_s_1"]
    assert found["scenes_smooth"] >= 2
    if find_spec("mujoco"):
        assert found["env_steps_per_s_mujoco_1"] > 0 and len(found["mujoco_over_pybullet_rounds"]) == 2
    origin = found.pop("origin")
    assert not any(isinstance(value, dict) for value in found.values())
    json.dumps({**found, "origin": origin}, allow_nan=False)


def test_figures_are_medians_over_rounds_and_ratios_within_them() -> None:
    rounds = [
        {"smooth": tally(rate, 0.6), "rough": tally(rate / 2, 0.8), PEER: tally(rate / 4)} for rate in (100, 900, 200)
    ]
    found = environment_figures(rounds)
    assert found["env_steps_per_s_1"] == 200 and found["env_steps_per_s_rough_1"] == 100
    assert found["env_steps_per_s_1_with_resets"] == pytest.approx(200 / 1.2, abs=0.1)
    assert found["share_in_physics"] == 0.6 and found["share_in_physics_rough"] == 0.8
    assert found["reset_in_steps"] == found["reset_in_steps_rough"] == found["peer_reset_in_steps"] == 20
    assert found["peer"] == PEER and found["peer_steps_per_s_1"] == 50
    assert found["rough_over_smooth_rounds"] == [0.5] * 3 and found["env_over_peer_rounds"] == [4.0] * 3
    assert found["rough_over_peer"] == 2.0
    assert "peer_published_steps_per_s" not in found


def test_what_was_not_met_is_left_out() -> None:
    found = environment_figures([{"smooth": tally(100)}])
    assert not any("rough" in key or "over" in key for key in found)
    assert found["peer_published_steps_per_s"] == [330, 530]
    assert "peer" not in found


def test_parts_run_alone_or_together(monkeypatch: pytest.MonkeyPatch) -> None:
    parts = {name: (lambda rounds, steps, name=name: {name: rounds * steps}) for name in bench.PARTS}
    monkeypatch.setattr(bench, "PARTS", parts)
    assert {"env", "training"} <= set(measure("all", 2, 3))
    assert "training" not in measure("env", 2, 3) and measure("training", 2, 3)["training"] == 6
    with pytest.raises(UserError, match=r"--part.*env, training, tests, all.*physics"):
        measure("physics")


@pytest.mark.process
def test_the_training_part_measures_ours_beside_stock_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    small = {"steps": 10_000, "n_envs": 2, "low.n_steps": 24, "low.batch_size": 32, "low.n_epochs": 1}
    monkeypatch.setitem(PRESETS, "laptop", {**PRESETS["smoke"], **small, "high.n_epochs": 1})
    monkeypatch.setattr(training, "ROUNDS", 1)
    monkeypatch.setattr(training, "BATCHES", (24, training.BATCH))
    measured = training.measure_training(1, 1)
    assert set(measured) == {
        "training_steps_per_s", "stock_training_steps_per_s", "training_ratio",
        "learner_ratio", "learner_ratio_24", f"learner_ratio_{training.BATCH}",
    }  # fmt: skip
    assert all(value > 0 for value in measured.values())


def test_tests_are_timed_where_there_is_a_reference_policy(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def evaluate(run: str, tests: int) -> dict[str, float]:
        assert run.endswith("hrl_dcs/seed0")
        return {"seconds": tests / 10}

    monkeypatch.setattr(bench, "evaluate", evaluate)
    monkeypatch.setattr(bench, "COMMITTED", tmp_path / "committed")
    run = tmp_path / "committed" / "reference" / "hrl_dcs" / "seed0"
    run.mkdir(parents=True)
    (run / "policy.json").touch()
    assert bench.measure_tests(1, 1) == {"tests_1000_s": 100.0}
    monkeypatch.setattr(bench, "COMMITTED", tmp_path)
    assert bench.measure_tests(1, 1) == {}


class _Small(gymnasium.Env[Any, Any]):
    """Stands for the peer: ends by itself after 30 steps."""

    observation_space = spaces.Box(-1, 1, (1,))
    action_space = spaces.Box(-1, 1, (3,))
    steps = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self.steps = 0
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        return np.zeros(1, np.float32), 0.0, self.steps == 30, False, {}


@pytest.mark.parametrize(("longest", "steps"), [(20, 20), (50, 30)])
def test_the_peer_s_episodes_end_as_it_says_or_at_its_limit(longest: int, steps: int) -> None:
    counted = Tally()
    peer = bench.bare_episodes(_Small(), longest)
    peer.next(lambda info: counted)
    peer.next(lambda info: counted)
    assert counted.steps == 2 * steps and counted.resets == 2
    assert counted.stepping > 0 and counted.resetting > 0


def test_the_peer_keeps_up_with_our_steps() -> None:
    with ExitStack() as stack:
        tallies = bench.run_round(bench.our_episodes(stack), bench.bare_episodes(_Small(), 50), {"smooth"}, 150)
    assert tallies["smooth"].steps >= 150
    assert 0 <= tallies[PEER].steps - tallies["smooth"].steps < 30


def test_panda_gym_is_used_where_it_is_installed() -> None:
    pytest.importorskip("panda_gym")
    with ExitStack() as stack:
        peer = bench.peer_episodes(stack)
        assert peer is not None
        counted = Tally()
        peer.next(lambda info: counted)
    assert 0 < counted.steps <= 50
