"""Measure training: HRL-DCS with our parts beside HRL-DCS with stock ones, in turn, so that both share the noise."""

import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from statistics import median
from typing import Any

import torch as th
from sb3_contrib import RecurrentPPO

from reproduce.bench.stock import StockTraining, copy_rollout
from reproduce.experiments.methods import METHODS
from reproduce.experiments.train import THREADS
from reproduce.hrl_dcs.training import HierarchicalTraining
from reproduce.learning.config import LearnerConfig
from reproduce.learning.training import OnlySpaces, make_learner

FIRST_UPDATES = 2  # fill caches; not counted
ROUNDS = 3
#: Transitions a minibatch at which learners are compared; the stock one loops over time for each minibatch, so the
#: smaller they are the slower it is. The headline figure is at the default of ``LearnerConfig``.
BATCHES, BATCH = (128, 512, 1024), LearnerConfig().batch_size


def seconds_of(run: Callable[..., object], *arguments: Any) -> float:
    """Return the time that a call takes [s]."""
    start = time.perf_counter()
    run(*arguments)
    return time.perf_counter() - start


def measure_training(rounds: int, steps: int) -> dict[str, Any]:
    """Measure a training with our parts beside one with stock parts, and the two learners alone."""
    th.set_num_threads(THREADS)
    config = METHODS["hrl_dcs"].config("laptop")
    size = config.low.n_steps * config.n_envs
    with closing(HierarchicalTraining(config, 0)) as ours, closing(StockTraining(config, 0)) as stock:
        for _ in range(FIRST_UPDATES):
            ours.update(0)
        stock.update()
        pairs = [(seconds_of(ours.update, 0), seconds_of(stock.update)) for _ in range(ROUNDS)]
        stock.collect()
        ratios = {batch: learner_ratio(stock, replace(config.low, batch_size=batch)) for batch in BATCHES}
    return {
        "training_steps_per_s": round(median(size / our for our, _ in pairs), 1),
        "stock_training_steps_per_s": round(median(size / their for _, their in pairs), 1),
        "training_ratio": round(median(their / our for our, their in pairs), 2),
        "learner_ratio": round(ratios[BATCH], 2),
        **{f"learner_ratio_{batch}": round(ratio, 2) for batch, ratio in ratios.items()},
    }


def learner_ratio(stock: StockTraining, config: LearnerConfig) -> float:
    """Return the stock learner's time over ours, on the same rollout, weights, batch and epochs, in alternation."""
    spaces = OnlySpaces(stock.config.n_envs, stock.env.observation_space, stock.env.action_space)
    theirs, ours = make_learner(spaces, config, 0, False, RecurrentPPO), make_learner(spaces, config, 0, False)
    for learner in (theirs, ours):
        learner.policy.load_state_dict(stock.lln.policy.state_dict())
        # Each its own copy: the stock learner flattens its buffer for good when it reads it.
        copy_rollout(stock.lln.rollout_buffer, learner.rollout_buffer)
    return median(seconds_of(theirs.train) / seconds_of(ours.train) for _ in range(ROUNDS))
