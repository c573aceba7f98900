from __future__ import annotations

import math

import numpy as np
import pytest

from lunar_rescue import rewards
from lunar_rescue.rewards import RewardWeights


def test_approach_by_hand() -> None:
    assert rewards.approach(0.5, 0.3, beta=2.0, form="literal") == pytest.approx(2.0 * math.exp(0.2))
    assert rewards.approach(0.5, 0.3, beta=2.0, form="signed") == pytest.approx(2.0 * (math.exp(0.2) - 1.0))
    assert rewards.approach(0.3, 0.5, beta=1.0, form="signed") == pytest.approx(math.exp(-0.2) - 1.0)


def test_approach_is_the_mean_over_two_arms() -> None:
    value = rewards.approach([0.5, 0.4], [0.3, 0.5], beta=3.0, form="literal")
    assert value == pytest.approx(3.0 * (math.exp(0.2) + math.exp(-0.1)) / 2)


def test_obstacle_avoidance_by_hand() -> None:
    value = rewards.obstacle_avoidance([[0.5, 0.25], [1.0, 2.0]], rho=0.3, xi=0.1)
    assert value == pytest.approx(-0.3 * math.log(0.2 + 0.4 + 0.1 + 0.05 + 1.0))


def test_obstacle_avoidance_without_rocks_is_zero() -> None:
    assert rewards.obstacle_avoidance(np.zeros((12, 0)), rho=0.3, xi=0.1) == 0.0


def test_joint_motion_counts_absolute_changes() -> None:
    assert rewards.joint_motion([0.1, -0.2, 0.3], varphi=0.5) == pytest.approx(-0.3)


def test_time_bonus_by_hand() -> None:
    assert rewards.time_bonus(0, 100) == 1.0
    assert rewards.time_bonus(40, 100) == pytest.approx(0.64)
    assert rewards.time_bonus(100, 100) == pytest.approx(0.1)


def test_contact() -> None:
    assert rewards.contact(True) == -0.5
    assert rewards.contact(False) == 0.5


@pytest.mark.parametrize("bad", [0.0, -0.1, math.nan, math.inf])
def test_bad_distances_are_refused(bad: float) -> None:
    with pytest.raises(ValueError, match="distance"):
        rewards.approach(1.0, bad, beta=1.0, form="signed")
    with pytest.raises(ValueError, match="distance"):
        rewards.approach(bad, 1.0, beta=1.0, form="literal")
    with pytest.raises(ValueError, match="distances"):
        rewards.obstacle_avoidance([0.5, bad], rho=1.0, xi=1.0)


def test_bad_arguments_are_refused() -> None:
    with pytest.raises(ValueError, match="form"):
        rewards.approach(1.0, 1.0, beta=1.0, form="other")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="shape"):
        rewards.approach([1.0, 1.0], [1.0], beta=1.0, form="signed")
    with pytest.raises(ValueError, match="delta"):
        rewards.joint_motion([math.nan], varphi=1.0)
    with pytest.raises(ValueError, match="steps"):
        rewards.time_bonus(101, 100)
    with pytest.raises(ValueError, match="beta"):
        RewardWeights(beta=-1.0)
    with pytest.raises(ValueError, match="memory"):
        RewardWeights(memory=0)
