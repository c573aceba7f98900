from __future__ import annotations

import math
from dataclasses import replace

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


STEP = rewards.Transition(
    best=np.array([0.5, 0.4]),
    distance=np.array([0.3, 0.5]),
    clearance=np.array([[0.5, 0.25], [1.0, 2.0]]),
    moved=np.array([0.1, -0.2, 0.3]),
    touches_rock=True,
    contact_reward=False,
    steps=40,
    max_steps=100,
    both_arms_under=False,
    success=False,
    failed=False,
)
WEIGHTS = RewardWeights(
    beta=3.0, rho=0.3, xi=0.1, influence=0.9, varphi=0.5, time_bonus=2.0, rescued=7.0, both_arms_under=5.0, failure=6.0,
    contact=0.2,
)  # fmt: skip


def test_every_term_of_a_step_by_hand() -> None:
    terms = rewards.reward_terms(STEP, WEIGHTS)
    assert list(terms) == [
        "approach", "obstacle_avoidance", "joint_motion", "time_bonus", "rescued", "both_arms_under", "failure",
    ]  # fmt: skip
    assert terms["approach"] == pytest.approx(3.0 * ((math.exp(0.2) - 1.0) + (math.exp(-0.1) - 1.0)) / 2)
    assert terms["obstacle_avoidance"] == pytest.approx(
        -0.3 * math.log(0.1 / 0.25 + 1.0)
    )  # the other joint is beyond 0.9 m
    assert terms["joint_motion"] == pytest.approx(-0.3)
    assert [terms[name] for name in ("time_bonus", "rescued", "both_arms_under", "failure")] == [0.0] * 4


def test_milestones_come_with_what_they_are_for() -> None:
    done = rewards.reward_terms(replace(STEP, both_arms_under=True, success=True), WEIGHTS)
    assert done["both_arms_under"] == 5.0 and done["rescued"] == 7.0 and done["failure"] == 0.0
    assert done["time_bonus"] == pytest.approx(2.0 * 0.64)
    assert rewards.reward_terms(replace(STEP, failed=True), WEIGHTS)["failure"] == -6.0


def test_the_contact_reward_takes_the_place_of_the_aapf_term() -> None:
    ablated = replace(STEP, contact_reward=True)
    free = replace(ablated, touches_rock=False)

    def term(step: rewards.Transition, weights: RewardWeights) -> float:
        return rewards.reward_terms(step, weights)["obstacle_avoidance"]

    assert term(ablated, WEIGHTS) == pytest.approx(-0.2) and term(free, WEIGHTS) == 0.0
    literal = replace(WEIGHTS, contact_form="literal")
    assert term(ablated, literal) == pytest.approx(-0.1) and term(free, literal) == pytest.approx(0.1)
    assert rewards.aapf(ablated, WEIGHTS) == pytest.approx(-0.3 * math.log(1.4))


def test_the_aapf_counts_each_joint_once_and_nothing_far_away() -> None:
    near, far = np.array([[0.05, 0.06], [0.1, 0.3], [0.4, 0.5]]), np.full((12, 35), 0.16)
    weights = RewardWeights()
    assert rewards.aapf(replace(STEP, clearance=near), weights) == pytest.approx(-0.04 * math.log(1 + 0.4 + 0.2))
    assert rewards.aapf(replace(STEP, clearance=far), weights) == 0.0
    assert rewards.aapf(replace(STEP, clearance=np.zeros((12, 0))), weights) == 0.0


def test_the_table_of_terms_names_weights_that_exist_and_says_what_comes_once() -> None:
    for term in rewards.TERMS:
        assert term.formula and all(isinstance(getattr(WEIGHTS, name), int | float) for name in term.weight)
    assert [term.name for term in rewards.TERMS if term.once] == [
        "time_bonus", "rescued", "both_arms_under", "failure",
    ]  # fmt: skip


def test_the_default_weights_are_those_that_everything_trains_with() -> None:
    weights = RewardWeights()
    assert (weights.time_bonus, weights.rescued, weights.both_arms_under, weights.failure) == (1.5, 4.0, 2.0, 1.0)
