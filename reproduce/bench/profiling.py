"""Where a second of HRL-DCS's training goes, how many threads its learners want, and how fast each method trains.

A training runs as it always does; the calls that make up a second are timed from outside, a nested call is taken off
the one around it, so the shares add up to one. Methods are timed in turn, round by round, so that all share a
machine's noise; how long a committed run took depends on what else the machine did.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from statistics import median
from typing import Any
from unittest.mock import patch

import torch as th
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from reproduce.baselines.sac import BusyEpisodeLog, SacTraining
from reproduce.experiments.methods import METHODS, Training
from reproduce.experiments.train import THREADS
from reproduce.hrl_dcs.training import HierarchicalTraining
from reproduce.learning.config import PRESETS, TrainingConfig
from reproduce.learning.episodes import EpisodeLog

FIRST_UPDATES = 2  # fill caches; not counted
THREADS_TRIED = (1, 2)
METHOD_ROUNDS = 3
METHOD_UPDATES = 6  # of a method in a round, after the first ones

#: What a second is made of, in the order of a table: key and what it is.
SHARES = {
    "environments": "waiting for the workers, which step and reset the environments",
    "lln_acts": "LLN chooses actions and values them",
    "sgn_acts": "SGN chooses sub-goals and values them",
    "hierarchy": "INR, sub-goals, mirrored views, SGN's transitions",
    "collecting": "the rest of SB3's collection: buffers, copies, advantages",
    "lln_learns": "LLN's epochs",
    "sgn_learns": "SGN's epochs",
}


class Clock:
    """Times calls by name; time inside a nested timed call counts for that one alone."""

    def __init__(self) -> None:
        """Start with nothing."""
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self._inner: list[float] = []

    def time(self, owner: Any, method: str, name: str) -> None:
        """Time every call of a method of one object from now on."""
        called: Callable[..., Any] = getattr(owner, method)

        def timed(*args: Any, **kwargs: Any) -> Any:
            self._inner.append(0.0)
            begun = time.perf_counter()
            try:
                return called(*args, **kwargs)
            finally:
                whole = time.perf_counter() - begun
                self.seconds[name] += whole - self._inner.pop()
                if self._inner:
                    self._inner[-1] += whole

        setattr(owner, method, timed)


def where_a_second_goes(updates: int, config: TrainingConfig | None = None) -> dict[str, Any]:
    """Run some updates of a training.

    Args:
        updates: How many are counted; two more come before.
        config: Of the training; the laptop preset's by default.

    Returns:
        Share of the time of each of ``SHARES``, and steps a second.
    """
    config = config or PRESETS["laptop"]
    clock = Clock()
    with closing(HierarchicalTraining(config, 0)) as training:
        workers = getattr(training.venv, "venv", training.venv)
        clock.time(workers, "step_async", "environments")
        clock.time(workers, "step_wait", "environments")
        clock.time(training.lln.policy, "forward", "lln_acts")
        clock.time(training.sgn.policy, "forward", "sgn_acts")
        clock.time(training.sgn.policy, "predict_values", "sgn_acts")
        clock.time(training.env, "step", "hierarchy")
        clock.time(training.lln, "collect_rollouts", "collecting")
        clock.time(training.lln, "train", "lln_learns")
        clock.time(training.sgn, "train", "sgn_learns")
        for update in range(FIRST_UPDATES):
            training.update(update * training.steps_per_update)
        clock.seconds.clear()
        begun = time.perf_counter()
        for update in range(updates):
            training.update((FIRST_UPDATES + update) * training.steps_per_update)
        whole = time.perf_counter() - begun
        rate = updates * training.steps_per_update / whole
    named = sum(clock.seconds.values())
    shares = {key: round(clock.seconds[key] / whole, 4) for key in SHARES}
    return {"steps_per_s": round(rate, 1), "shares": {**shares, "other": round(1.0 - named / whole, 4)}}


def threads_for_learners(rounds: int, config: TrainingConfig | None = None) -> dict[str, float]:
    """Steps a second of the whole training with so many threads for PyTorch, one update each in turn; medians."""
    config = replace(config or PRESETS["laptop"], steps=10**9)
    rates: dict[int, list[float]] = {threads: [] for threads in THREADS_TRIED}
    with closing(HierarchicalTraining(config, 0)) as training:
        for update in range(FIRST_UPDATES):
            training.update(update * training.steps_per_update)
        try:
            for _ in range(rounds):
                for threads in THREADS_TRIED:
                    th.set_num_threads(threads)
                    begun = time.perf_counter()
                    training.update(0)
                    rates[threads].append(training.steps_per_update / (time.perf_counter() - begun))
        finally:
            th.set_num_threads(THREADS)
    return {f"threads_{threads}": round(median(found), 1) for threads, found in rates.items()}


def measure_profile(rounds: int, steps: int) -> dict[str, Any]:
    """What ``bench --part profile`` measures; ``rounds`` updates of each kind."""
    th.set_num_threads(THREADS)
    found = where_a_second_goes(rounds)
    shares = {f"share_{name}": share for name, share in found.pop("shares").items()}
    return {f"profile_{name}": value for name, value in {**found, **shares, **threads_for_learners(rounds)}.items()}


def rates_of_methods(
    rounds: int, updates: int, configs: dict[str, TrainingConfig] | None = None
) -> dict[str, list[float]]:
    """Steps a second of each method's training, a figure a round.

    Args:
        rounds: In each, all methods in turn.
        updates: Of a method in a round that are counted; before them come those in which it only collects.
        configs: By method; the laptop preset's of all that learn by default.
    """
    if configs is None:
        configs = {name: method.config("laptop") for name, method in METHODS.items() if method.train is not None}
    rates: dict[str, list[float]] = {name: [] for name in configs}
    for _ in range(rounds):
        for name, config in configs.items():
            make = METHODS[name].train
            assert make is not None
            with closing(make(config, 0)) as training:
                rates[name].append(_rate(training, updates))
    return rates


def _rate(training: Training, updates: int, done: int = 0) -> float:
    """Steps a second of some updates, once the learner learns; ``done`` steps were taken before."""
    size = training.steps_per_update
    first = max(FIRST_UPDATES * size, training.config.sac.learning_starts)
    while done < first:
        training.update(done)
        done += size
    begun = time.perf_counter()
    for _ in range(updates):
        training.update(done)
        done += size
    return updates * size / (time.perf_counter() - begun)


def learning_meanwhile(rounds: int, updates: int, config: TrainingConfig | None = None) -> float:
    """SAC's steps a second when it learns while the workers step, over those when it learns afterwards.

    Args:
        rounds: Of one and then the other, with one training; the median of their ratios is returned.
        updates: Of each in a round.
        config: Of the training; the laptop preset's by default.
    """
    config, ratios = config or METHODS["sac"].config("laptop"), []
    with closing(SacTraining(config, 0)) as training:
        _rate(training, 0)
        for _ in range(rounds):
            meanwhile = _rate(training, updates, config.sac.learning_starts)
            with patch.object(BusyEpisodeLog, "step_wait", _wait_and_learn):
                ratios.append(meanwhile / _rate(training, updates, config.sac.learning_starts))
    return median(ratios)


def _wait_and_learn(env: BusyEpisodeLog) -> VecEnvStepReturn:
    """Let the workers step, with the learner waiting for them."""
    stepped = EpisodeLog.step_wait(env)
    if env.meanwhile is not None:
        env.meanwhile()
    return stepped


def measure_methods(rounds: int, steps: int) -> dict[str, Any]:
    """What ``bench --part methods`` measures: rates, and how many minutes the laptop preset's steps would take so."""
    th.set_num_threads(THREADS)
    rates = rates_of_methods(METHOD_ROUNDS, METHOD_UPDATES)
    wanted = PRESETS["laptop"].steps
    found: dict[str, Any] = {
        "methods_env_steps": wanted,
        "methods_sac_meanwhile_over_afterwards": round(learning_meanwhile(METHOD_ROUNDS, METHOD_UPDATES), 3),
    }
    for name, each in rates.items():
        ratios = [rate / ours for rate, ours in zip(each, rates["hrl_dcs"], strict=True)]
        found |= {
            f"methods_{name}_steps_per_s": round(median(each), 1),
            f"methods_{name}_minutes": round(wanted / median(each) / 60.0, 1),
            f"methods_{name}_over_hrl_dcs": round(median(ratios), 3),
        }
    return found
