"""The stock parts that bench compares with do the same work."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from reproduce.bench.stock import StockTraining, copy_rollout
from reproduce.experiments.methods import METHODS
from reproduce.learning.training import OnlySpaces, make_learner


@pytest.mark.process
def test_stock_training_updates_both_layers_and_hands_its_rollout_over() -> None:
    smoke = METHODS["hrl_dcs"].config("smoke")
    config = replace(smoke, steps=10_000, n_envs=2, low=replace(smoke.low, n_steps=24, batch_size=32, n_epochs=1))
    stock = StockTraining(config, 0)
    try:
        before = [next(iter(learner.policy.parameters())).detach().clone() for learner in (stock.sgn, stock.lln)]
        stock.update()
        after = [next(iter(learner.policy.parameters())).detach() for learner in (stock.sgn, stock.lln)]
        assert all(not np.array_equal(a, b) for a, b in zip(before, after, strict=True))
        assert stock.sgn.rollout_buffer.full and stock.sgn.rollout_buffer.buffer_size == stock.rows
        stock.collect()
        env = OnlySpaces(config.n_envs, stock.env.observation_space, stock.env.action_space)
        ours = make_learner(env, config.low, 0, False)
        ours.policy.load_state_dict(stock.lln.policy.state_dict())
        copy_rollout(stock.lln.rollout_buffer, ours.rollout_buffer)
        rollout = ours.rollout()
        assert len(rollout) == 48
        assert np.array_equal(rollout.observations[:24], stock.lln.rollout_buffer.observations[:, 0])
        ours.train()
        stock.lln.train()
    finally:
        stock.close()
