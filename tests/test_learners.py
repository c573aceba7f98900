from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from sb3_contrib import RecurrentPPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import DummyVecEnv

from reproduce.learning.networks import RecurrentNetwork, Standardiser
from reproduce.learning.sequence_ppo import SequencePPO
from reproduce.learning.sequences import Rollout, advantages_and_returns, minibatches, sequence_bounds


class Recall(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """The first observation of an episode says which sign is right; only memory can tell at its end."""

    def __init__(self, length: int = 6) -> None:
        self.observation_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self._length, self._sign, self._step = length, 1.0, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self._sign, self._step = float(self.np_random.choice([-1.0, 1.0])), 0
        return np.array([self._sign, 0.0], np.float32), {}

    def step(self, action: NDArray[np.float32]) -> Any:
        self._step += 1
        last = self._step == self._length
        reward = float(np.clip(action[0], -1, 1)) * self._sign if last else 0.0
        return np.array([0.0, self._step / self._length], np.float32), reward, last, False, {}


def make(kind: type[RecurrentPPO], **kwargs: Any) -> RecurrentPPO:
    env = DummyVecEnv([Recall for _ in range(8)])
    learner = kind(
        RecurrentNetwork,
        env,
        n_steps=24,
        batch_size=96,
        seed=1,
        device="cpu",
        policy_kwargs={"hidden_units": 32},
        **kwargs,
    )
    learner.set_logger(Logger(folder=None, output_formats=[]))
    return learner


def collect(learner: RecurrentPPO) -> None:
    _, callback = learner._setup_learn(10_000, None)
    env: Any = learner.env
    learner.collect_rollouts(env, callback, learner.rollout_buffer, learner.n_steps)


def test_losses_and_gradients_equal_the_stock_learners() -> None:
    """On the same rollout and weights, whole sequences give the loss and gradients of RecurrentPPO."""
    ours = make(SequencePPO, sequence_length=10_000)
    assert isinstance(ours, SequencePPO)
    collect(ours)
    rollout = ours.rollout()
    (batch,) = minibatches(rollout, len(rollout), np.random.default_rng(0))
    names = ("actions", "log_probs", "values", "advantages", "returns")
    data = {name: th.from_numpy(getattr(rollout, name))[batch.rows] for name in names}
    loss, _ = ours.losses(batch, data)
    loss.backward()
    mine = {n: p.grad.clone() for n, p in ours.policy.named_parameters() if p.grad is not None}
    ours.policy.zero_grad()
    buffer: Any = ours.rollout_buffer
    policy: Any = ours.policy
    (stock,) = buffer.get(None)
    mask = stock.mask > 1e-8
    values, log_prob, entropy = policy.evaluate_actions(
        stock.observations, stock.actions, stock.lstm_states, stock.episode_starts
    )
    advantages = (stock.advantages - stock.advantages[mask].mean()) / (stock.advantages[mask].std() + 1e-8)
    ratio = th.exp(log_prob - stock.old_log_prob)
    surrogate = th.min(advantages * ratio, advantages * th.clamp(ratio, 0.8, 1.2))
    value_loss = ((stock.returns - values.flatten()) ** 2)[mask].mean()
    reference = -surrogate[mask].mean() - ours.ent_coef * entropy[mask].mean() + ours.vf_coef * value_loss
    reference.backward()
    assert float(loss.detach()) == pytest.approx(float(reference.detach()), abs=1e-5)
    for name, parameter in ours.policy.named_parameters():
        if parameter.grad is not None:
            assert th.allclose(mine[name], parameter.grad, atol=1e-5), name


@pytest.mark.process
def test_a_memory_task_is_solved() -> None:
    learner = make(SequencePPO, sequence_length=6, learning_rate=3e-3, n_epochs=8)
    learner.learn(8_000)
    collect(learner)
    rewards = learner.rollout_buffer.rewards
    # Without memory the best is 0 an episode, with it 1; guesses spread by 1 / sqrt(32) around 0.
    assert rewards.sum() / (rewards.size / 6) > 0.7


def test_sequences_are_cut_at_starts_and_length() -> None:
    starts = np.array([False, False, True, False, False, False, False, True])
    assert sequence_bounds(starts, 100, 3) == [(100, 102), (102, 105), (105, 107), (107, 108)]


def test_minibatches_hold_every_transition_once() -> None:
    size = 50
    bounds = np.array(sequence_bounds(np.arange(size) % 7 == 0, 0, 4), np.int64)
    column = np.arange(size, dtype=np.float32)
    rollout = Rollout(
        column[:, None], column[:, None], column, column, column, column, np.zeros((size, 2, 3), np.float32), bounds
    )
    rows = [int(r) for b in minibatches(rollout, 16, np.random.default_rng(0)) for r in b.rows]
    assert sorted(rows) == list(range(size))
    for batch in minibatches(rollout, 16, np.random.default_rng(1)):
        assert th.equal(batch.observations[batch.mask][:, 0].long(), batch.rows)


def test_advantages_by_hand() -> None:
    rewards, values = np.array([1.0, 2.0, 3.0], np.float32), np.array([0.5, 0.4, 0.3], np.float32)
    ends = np.array([False, True, False])
    advantages, returns = advantages_and_returns(rewards, values, 2.0, ends, gamma=0.9, lam=0.8)
    # Third: 3 + 0.9 x 2 - 0.3. Second, whose episode ended: 2 - 0.4. First: 1 + 0.9 x 0.4 - 0.5 + 0.72 x 1.6.
    assert advantages == pytest.approx([2.012, 1.6, 4.5], abs=1e-6)
    assert returns == pytest.approx([2.512, 2.0, 4.8], abs=1e-6)
    assert advantages.dtype == returns.dtype == np.float32


def test_advantages_of_several_environments_are_those_of_sb3() -> None:
    steps, envs, rng = 26, 3, np.random.default_rng(0)
    box = spaces.Box(-1.0, 1.0, (1,), np.float32)
    stock = RolloutBuffer(steps, box, box, "cpu", gae_lambda=0.8, gamma=0.9, n_envs=envs)
    over = rng.random((steps, envs)) < 0.2
    stock.rewards, stock.values = (rng.normal(size=(2, steps, envs))).astype(np.float32)
    stock.episode_starts = np.concatenate([np.ones((1, envs)), over[:-1]]).astype(np.float32)
    after = th.randn(envs)
    stock.compute_returns_and_advantage(after, over[-1])
    advantages, returns = advantages_and_returns(stock.rewards, stock.values, after, over, 0.9, 0.8)
    assert advantages == pytest.approx(stock.advantages, abs=1e-5)
    assert returns == pytest.approx(stock.returns, abs=1e-5)


def test_cut_returns_end_with_the_sub_goal() -> None:
    learner = make(SequencePPO)
    assert isinstance(learner, SequencePPO)
    collect(learner)
    buffer: Any = learner.rollout_buffer
    cuts = np.ones((learner.n_steps, 8), bool)
    learner.return_cuts = cuts
    learner.rollout()
    assert buffer.returns == pytest.approx(buffer.rewards, abs=1e-6)  # each step stands alone


def test_standardiser_follows_mean_and_spread() -> None:
    rng = np.random.default_rng(0)
    data = th.from_numpy(rng.normal([3.0, -1.0], [0.5, 2.0], (4000, 2)).astype(np.float32))
    standardiser = Standardiser(2)
    for part in data.split(1000):
        standardiser.observe(part)
    assert th.allclose(standardiser.mean, data.mean(0), atol=1e-4)
    assert th.allclose(standardiser.variance, data.var(0, unbiased=False), atol=1e-3)
    scaled = standardiser(data)
    assert float(scaled.std()) == pytest.approx(1.0, abs=0.05)
