"""Where a second goes: nested calls count once, and a real training's shares add up."""

from __future__ import annotations

import time
from dataclasses import replace

import pytest

from reproduce.bench.profiling import SHARES, Clock, learning_meanwhile, rates_of_methods, where_a_second_goes
from reproduce.learning.config import PRESETS


class _Work:
    def outer(self) -> str:
        time.sleep(0.02)
        self.inner()
        return "done"

    def inner(self) -> None:
        time.sleep(0.05)


def test_a_nested_call_counts_for_itself_alone() -> None:
    work, clock = _Work(), Clock()
    clock.time(work, "outer", "outer")
    clock.time(work, "inner", "inner")
    begun = time.perf_counter()
    assert work.outer() == "done"
    whole = time.perf_counter() - begun
    assert clock.seconds["inner"] >= 0.05 and clock.seconds["outer"] >= 0.02
    assert clock.seconds["inner"] + clock.seconds["outer"] == pytest.approx(whole, abs=0.01)


def test_shares_of_a_training_add_up_to_one() -> None:
    smoke = PRESETS["smoke"]
    found = where_a_second_goes(2, replace(smoke, n_envs=4, low=replace(smoke.low, n_steps=32, batch_size=64)))
    shares = found["shares"]
    assert set(shares) == {*SHARES, "other"}
    assert sum(shares.values()) == pytest.approx(1.0, abs=1e-3)
    assert all(shares[name] > 0 for name in SHARES)
    assert shares["other"] < 0.2 and found["steps_per_s"] > 0


def test_sac_is_timed_learning_meanwhile_and_afterwards() -> None:
    smoke = PRESETS["smoke"]
    small = replace(smoke, n_envs=4, sac=replace(smoke.sac, n_steps=32, learning_starts=300))
    assert 0.1 < learning_meanwhile(1, 1, small) < 10.0


def test_methods_are_timed_in_turn_and_once_they_learn() -> None:
    smoke = PRESETS["smoke"]
    small = replace(smoke, n_envs=4, low=replace(smoke.low, n_steps=32, batch_size=64))
    small = replace(small, sac=replace(small.sac, n_steps=32, learning_starts=300))
    rates = rates_of_methods(2, 1, {"sac": small, "ppo_lstm": small})
    assert list(rates) == ["sac", "ppo_lstm"]
    assert all(len(found) == 2 and min(found) > 0 for found in rates.values())
