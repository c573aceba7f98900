"""Rollouts of a single transition train as any other, and a loss that is not finite stops a training by name."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import DummyVecEnv

from reproduce.baselines.feudal.network import FunConfig
from reproduce.baselines.feudal.training import make_fun_learner
from reproduce.baselines.sac import SacConfig, make_sac
from reproduce.experiments.methods import METHODS
from reproduce.learning.config import LearnerConfig
from reproduce.learning.training import Training, make_learner, start_collecting
from reproduce.storage.errors import RunFailedError

LOW: LearnerConfig = replace(METHODS["hrl_dcs"].config("smoke").low, hidden_units=8, n_epochs=2, sequence_length=32)
FUN = FunConfig(horizon=3, goal_size=8, embedding_size=2)


class Rewarded(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """Random observations in endless episodes, all with the same reward."""

    def __init__(self, reward: float) -> None:
        self.observation_space = spaces.Box(-1.0, 1.0, (3,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self._reward = reward

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        return self._observation(), {}

    def step(self, action: NDArray[np.float32]) -> Any:
        return self._observation(), self._reward, False, False, {}

    def _observation(self) -> NDArray[np.float32]:
        return self.np_random.uniform(-1.0, 1.0, 3).astype(np.float32)


def collected(kind: str, config: LearnerConfig, reward: float = 1.0) -> Any:
    """Make a learner that has collected a rollout of one environment."""
    env = DummyVecEnv([lambda: Rewarded(reward)])
    env.seed(0)
    if kind == "fun":
        learner: Any = make_fun_learner(env, config, FUN, 0)
    else:
        learner = make_learner(env, config, 0, bounded_mean=False)
    learner.where = f"{kind}, update 7"
    callback = start_collecting(learner, 1000)
    learner.collect_rollouts(env, callback, learner.rollout_buffer, config.n_steps)
    return learner


def weights(learner: Any) -> th.Tensor:
    return th.cat([parameter.detach().flatten() for parameter in learner.policy.parameters()])


@pytest.mark.parametrize("kind", ["ppo", "fun"])
@pytest.mark.parametrize(("steps", "batch"), [(1, 32), (65, 32)])
def test_a_single_transition_in_a_rollout_or_minibatch_leaves_weights_finite(kind: str, steps: int, batch: int) -> None:
    learner = collected(kind, replace(LOW, n_steps=steps, batch_size=batch))
    before = weights(learner)
    learner.train()
    if steps == 65:  # 32, 32 and the one whose advantage has no deviation
        assert (np.diff(learner.rollout().bounds, axis=1) == 1).any()
    assert bool(th.isfinite(weights(learner)).all()) and not th.equal(weights(learner), before)


@pytest.mark.parametrize("kind", ["ppo", "fun"])
@pytest.mark.parametrize("reward", [np.nan, np.inf])
def test_a_loss_that_is_not_finite_stops_by_name_before_weights_change(kind: str, reward: float) -> None:
    learner = collected(kind, replace(LOW, n_steps=8, batch_size=8), reward)
    before = weights(learner)
    with pytest.raises(RunFailedError, match=rf"{kind}, update 7: policy_gradient_loss: expected a finite number, got"):
        learner.train()
    assert th.equal(weights(learner), before)


@pytest.mark.parametrize("gradient_steps", [1, 3])
def test_sac_stops_at_a_loss_that_is_not_finite(gradient_steps: int) -> None:
    env = DummyVecEnv([lambda: Rewarded(np.nan)])
    learner = make_sac(env, SacConfig(hidden_units=8, batch_size=8, buffer_size=20), 0)
    learner.where = "actor, update 7"
    callback = start_collecting(learner, 1000)
    for _ in range(9):
        learner.collect(env, callback)
    with pytest.raises(RunFailedError, match=r"actor, update 7: train/(actor|critic)_loss: .* got nan"):
        learner.train(gradient_steps, 8)


def test_learners_are_told_their_level_and_update() -> None:
    """Steps of an update are n_steps times n_envs, so 3 x 4 x 10 steps were three updates."""
    config = replace(METHODS["hrl_dcs"].config("smoke"), n_envs=4, steps=480, low=replace(LOW, n_steps=10))
    training: Any = SimpleNamespace(config=config, steps_per_update=40, learners={"sgn": SimpleNamespace()})
    Training.follow_schedule(training, 120)
    assert training.learners["sgn"].where == "sgn, update 4"
    assert training.learners["sgn"]._current_progress_remaining == 0.75
