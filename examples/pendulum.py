"""Two layers and FeUdal Networks on an environment that is not ours: Gymnasium's Pendulum-v1.

    python examples/pendulum.py [--method two_layers|fun] [--steps STEPS]

Nothing of the rescue is used. The goal space is the motion of the pendulum, (cos, sin, speed); SGN says every N steps
how it should move, LLN makes it. FeUdal Networks learn their goal space by themselves.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import torch as th
import typer
from gymnasium.wrappers import TransformReward
from numpy.typing import NDArray
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

from reproduce.baselines.feudal.network import FunConfig
from reproduce.baselines.feudal.training import make_fun_learner
from reproduce.hrl_dcs.config import HierarchicalConfig, HierarchyConfig
from reproduce.hrl_dcs.goals import PlainGoals
from reproduce.hrl_dcs.training import TwoLayerTraining
from reproduce.learning.config import LearnerConfig
from reproduce.learning.training import start_collecting

ENVS = 8
REWARD_UNIT = 100.0  # Pendulum's reward is up to 16 a step
SPEED_UNIT = 8.0  # rad/s, its highest speed


def motion(observations: NDArray[np.float32]) -> NDArray[np.float32]:
    """Where the pendulum points and how fast it turns, (n, 3): Pendulum-v1's observation is cos, sin and speed."""
    return observations / np.array([1.0, 1.0, SPEED_UNIT], np.float32)


def make_environments() -> DummyVecEnv:
    """Eight pendulums; their rewards are divided by ``REWARD_UNIT``."""

    def one() -> gymnasium.Env[Any, Any]:
        return TransformReward(gymnasium.make("Pendulum-v1"), lambda reward: float(reward) / REWARD_UNIT)

    return DummyVecEnv([one] * ENVS)


def configuration(steps: int) -> HierarchicalConfig:
    """Return a configuration of small networks and short rollouts for ``steps`` environment steps."""
    small = LearnerConfig(n_steps=200, batch_size=400, n_epochs=8, hidden_units=32)
    low = replace(small, learning_rate=1e-3, gamma=0.95, gae_lambda=0.9, log_std_init=-0.5)
    high = replace(low, batch_size=80, sequence_length=16)
    return HierarchicalConfig(steps, ENVS, low=low, high=high, hierarchy=HierarchyConfig(interval=5, sgn_every=1))


def two_layers(steps: int, seed: int = 0) -> list[float]:
    """Train SGN and LLN; return the mean return of the episodes of each update, in Pendulum's own units."""
    set_random_seed(seed)
    venv, config = make_environments(), configuration(steps)
    config = replace(config, low=replace(config.low, n_steps=100, gamma=0.9))
    venv.seed(seed)
    goals = PlainGoals(venv.observation_space, venv.action_space, motion, reach=1.0)
    training = TwoLayerTraining(venv, goals, config, seed)
    return _train(lambda done: float(training.update(done)["return_high"]), steps, training.steps_per_update)


def feudal(steps: int, seed: int = 0) -> list[float]:
    """Train Manager and Worker; see ``two_layers``."""
    set_random_seed(seed)
    venv, config = VecMonitor(make_environments()), configuration(steps)
    venv.seed(seed)
    fun = FunConfig(goal_size=32, embedding_size=8, horizon=5, intrinsic_weight=0.02, manager_gamma=0.95)
    learner = make_fun_learner(venv, config.low, fun, seed)
    callback = start_collecting(learner, steps)

    def update(done: int) -> float:
        learner._current_progress_remaining = 1.0 - done / steps
        learner.collect_rollouts(venv, callback, learner.rollout_buffer, config.low.n_steps)
        learner.train()
        # Every episode of Pendulum is 200 steps, as a rollout is, so each environment ended one.
        assert learner.ep_info_buffer is not None
        return float(np.mean([episode["r"] for episode in list(learner.ep_info_buffer)[-ENVS:]]))

    return _train(update, steps, config.low.n_steps * ENVS)


def _train(update: Callable[[int], float], steps: int, each: int) -> list[float]:
    th.set_num_threads(1)
    return [REWARD_UNIT * update(done) for done in range(0, steps, each)]


def main(method: str = "two_layers", steps: int = 100_000) -> None:
    """Train ``two_layers`` or ``fun`` and print the mean returns of every ten updates."""
    trainings = {"two_layers": two_layers, "fun": feudal}
    if method not in trainings:
        raise typer.BadParameter(f"expected one of {', '.join(trainings)}; got {method!r}")
    returns = trainings[method](steps)
    for row in range(0, len(returns), 10):
        print(f"update {row}: mean return {np.nanmean(returns[row : row + 10]):.0f}")


if __name__ == "__main__":
    typer.run(main)
