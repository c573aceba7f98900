"""Every method that learns trains, is interrupted, goes on, is exported, evaluated and replayed by the same code."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch as th
from safetensors.torch import load_file

from lunar_rescue import LunarRescueEnv, RewardWeights
from lunar_rescue.observation import SIZE
from lunar_rescue.physics.robot import JOINTS
from reproduce.baselines.sac import SacTraining
from reproduce.experiments import evaluate as acting
from reproduce.experiments import train as training
from reproduce.experiments.evaluate import evaluate
from reproduce.experiments.methods import METHODS, load_policy
from reproduce.experiments.presets import PRESETS, changed
from reproduce.experiments.train import train
from reproduce.learning.worker_process import RETURN, EnvOptions
from reproduce.learning.workers import WorkerVecEnv
from reproduce.report.film import film
from reproduce.storage.errors import UserError
from reproduce.storage.paths import CHECKPOINT
from reproduce.storage.records import to_dict

LEARNING = [name for name, method in METHODS.items() if method.train is not None]


class Stop(Exception):
    """Raised in place of a kill."""


#: What makes a training of a second of the smoke preset, by part of the configuration.
SMALL: dict[str, dict[str, Any]] = {
    "sac": {"learning_starts": 128, "batch_size": 16, "hidden_units": 16, "buffer_size": 300},
    "off_policy": {"batch_size": 16, "hidden_units": 16, "buffer_size": 300},
    "fun": {"goal_size": 16, "embedding_size": 4, "horizon": 5},
    "low": {"n_epochs": 1, "batch_size": 128},
}


def _small(name: str, n_envs: int = 2) -> Any:
    """Three updates of 64 steps of each environment, a checkpoint after the second; buffers hold less than that."""
    config = replace(METHODS[name].config("smoke"), steps=192 * n_envs, n_envs=n_envs, checkpoint_every=2)
    parts = {part: changes for part, changes in SMALL.items() if hasattr(config, part)}
    return changed(config, {f"{part}.{key}": value for part, own in parts.items() for key, value in own.items()})


@pytest.mark.process
@pytest.mark.parametrize("name", LEARNING)
def test_an_interrupted_training_ends_in_the_same_weights_and_acts(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config, method, parts = _small(name), METHODS[name], tmp_path / "parts"
    curve = train(method, config, 3, tmp_path / "whole", "smoke", quiet=True)
    assert curve["env_steps"].iloc[-1] == 384 and np.isfinite(curve["seconds"]).all()
    save = training.save_checkpoint

    def save_and_stop(*args: object) -> None:
        save(*args)  # type: ignore[arg-type]
        raise Stop

    monkeypatch.setattr(training, "save_checkpoint", save_and_stop)
    with pytest.raises(Stop):
        train(method, config, 3, parts, "smoke", quiet=True)
    with pytest.raises(UserError, match="resume"):
        train(method, config, 3, parts, "smoke", quiet=True)
    monkeypatch.setattr(training, "save_checkpoint", save)
    train(method, config, 3, parts, "smoke", resume=True, quiet=True)
    assert not (parts / CHECKPOINT).exists()
    first, second = (load_file(folder / "policy.safetensors") for folder in (tmp_path / "whole", parts))
    assert first and all(th.equal(first[key], second[key]) for key in first)

    rows = tmp_path / "evaluation.json"
    assert evaluate(parts, 2, quiet=True, json=rows)["tests"] == 2
    assert list(pd.read_csv(rows.with_suffix(".csv"))["seed"]) == [0, 1]
    monkeypatch.setattr(acting, "LunarRescueEnv", partial(LunarRescueEnv, max_steps=8))  # pictures take time
    frames, row = film(parts, 0, size=(160, 112))
    assert len(frames) == 9 and row["posture"] and row["steps"] == 8
    loaded, policy = load_policy(parts)
    assert loaded.name == name
    seen, starts = np.zeros((3, SIZE), np.float32), np.ones(3, bool)
    actions = policy.act(seen, starts)
    assert actions.shape == (3, JOINTS) and np.abs(actions).max() <= 1.0
    _, fresh = load_policy(parts)
    assert np.array_equal(fresh.act(seen, np.zeros(3, bool)), actions)  # the first call begins an episode by itself


@pytest.mark.process
def test_sac_learns_while_its_environments_step(monkeypatch: pytest.MonkeyPatch) -> None:
    config = changed(_small("sac", n_envs=4), {"sac.learning_starts": 256, "sac.buffer_size": 2048})
    held: list[tuple[int, int]] = []
    sent: list[int] = []
    with closing(SacTraining(config, 3)) as sac:
        buffer = sac.learner.replay_buffer
        assert buffer is not None
        learn, send = sac.learner.train, sac.venv.step_async

        def noted_learn(gradient_steps: int, batch_size: int = 64) -> None:
            held.append((buffer.pos, len(sent)))
            learn(gradient_steps, batch_size)

        def noted_send(actions: np.ndarray) -> None:
            sent.append(1)
            send(actions)

        monkeypatch.setattr(sac.learner, "train", noted_learn)
        monkeypatch.setattr(sac.venv, "step_async", noted_send)
        steps = sac.steps_per_update // 4
        for done in range(0, 1536, sac.steps_per_update):
            sac.update(done)
        # From 256 steps of all four on, every second time; one more step than the buffer holds is under way.
        assert held == [(taken, taken + 1) for taken in range(64, 1536 // sac.steps_per_update * steps, 2)]
        assert sac.learner._n_updates == len(held) and buffer.pos == len(sent)


def test_the_ablation_changes_the_obstacle_reward_and_nothing_else() -> None:
    for preset in PRESETS:
        full, without = (to_dict(METHODS[name].config(preset)) for name in ("hrl_dcs", "hrl_dcs_no_aapf"))
        assert full.pop("obstacle_reward") == "aapf" and without.pop("obstacle_reward") == "contact"
        assert full == without
    assert METHODS["hrl_dcs"].train is METHODS["hrl_dcs_no_aapf"].train
    assert METHODS["hrl_dcs"].act is METHODS["hrl_dcs_no_aapf"].act


@pytest.mark.process
def test_returns_are_by_the_same_reward_with_either_obstacle_reward() -> None:
    found, literal = {}, RewardWeights(contact_form="literal")  # which pays for every step without a contact
    for kind in ("aapf", "contact"):
        venv = WorkerVecEnv(2, 0, EnvOptions({"obstacle_reward": kind, "max_steps": 6, "weights": literal}), workers=1)
        try:
            venv.reset()
            rewards = []
            for step in range(6):
                venv.step_async(np.full((2, JOINTS), 0.1 * step, np.float32))
                _, reward, dones, infos = venv.step_wait()
                rewards.append(reward)
            assert dones.all()
            found[kind] = (np.sum(rewards, axis=0), np.array([info[RETURN] for info in infos]))
        finally:
            venv.close()
    assert found["aapf"][1] == pytest.approx(found["aapf"][0], abs=1e-5)
    assert found["contact"][1] == pytest.approx(found["aapf"][1], abs=1e-9)
    assert np.abs(found["contact"][0] - found["contact"][1]).min() > 1e-3


def test_all_methods_meet_the_same_terms() -> None:
    """Steps, agents, scenes, view and reward weights are one preset's; only what is a method's own differs."""
    own = {"low", "high", "hierarchy", "goals", "imitation", "fun", "sac", "off_policy", "obstacle_reward"}
    for preset in PRESETS:
        common = {key: value for key, value in to_dict(METHODS["hrl_dcs"].config(preset)).items() if key not in own}
        assert {"steps", "n_envs", "reward", "priors", "scenes"} <= set(common)
        for name in LEARNING:
            config = METHODS[name].config(preset)
            assert config.priors.demonstrations == name.endswith("_demos")
            shared = {key: value for key, value in to_dict(config).items() if key not in own}
            # What begins from demonstrations says so, may have more priors, and has steps of its own.
            more = {"demonstrations", "joint_step", "way_in"} if name.endswith("_demos") else set()
            priors = {**shared["priors"], **dict.fromkeys(more, False)}
            steps = common["steps"] if config.priors.demonstrations else shared["steps"]
            assert {**shared, "priors": priors, "steps": steps} == common
        assert set(common["priors"].values()) == ({False, 1} if preset == "paper" else {True, False})
