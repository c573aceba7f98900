"""The two layers and the sampling under them."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch as th

from lunar_rescue import LunarRescueEnv, sample_scene
from lunar_rescue.observation import SIZE, SLICES
from lunar_rescue.physics.robot import JOINTS
from reproduce.experiments.evaluate import rescue_scenes
from reproduce.experiments.methods import METHODS
from reproduce.experiments.train import train
from reproduce.hrl_dcs.ablation import ABLATIONS, ablated
from reproduce.hrl_dcs.config import AnchorConfig, HierarchicalPolicyConfig
from reproduce.hrl_dcs.joint_step import joint_step, sideways_tilt
from reproduce.hrl_dcs.policy import SIZES, HierarchicalPolicy
from reproduce.hrl_dcs.subgoals import (
    SUBGOAL_SIZE,
    RescueGoals,
    achieved,
    arm_ends,
    entries,
    next_points,
    slipped,
    targets,
)
from reproduce.hrl_dcs.training import HierarchicalTraining
from reproduce.learning.actions import LARGEST_CHANGE, to_environment
from reproduce.learning.networks import NetworkSpec, RecurrentNetwork
from reproduce.learning.workers import TERMS, WorkerError, WorkerVecEnv
from reproduce.storage.errors import UserError

ANCHORS = AnchorConfig()
#: Those of a policy that acts once it is trained.
ACTING = METHODS["hrl_dcs"].config("laptop").policy.anchors


@pytest.fixture(scope="module")
def training() -> Iterator[HierarchicalTraining]:
    made = HierarchicalTraining(replace(METHODS["hrl_dcs"].config("smoke"), n_envs=4, steps=100_000), seed=0)
    yield made
    made.close()


def test_sub_goal_points_agree_with_the_environment(env: LunarRescueEnv) -> None:
    observation, _ = env.reset_flat(options={"scene": sample_scene(0)})
    e = env.episode
    row = observation[None]
    assert arm_ends(row)[0] == pytest.approx(e.observer.to_base(e.robot.ends).ravel(), abs=1e-5)
    assert targets(row)[0] == pytest.approx(e.observer.to_base(e.targets()).ravel(), abs=1e-5)
    assert entries(row)[0] == pytest.approx(e.observer.to_base(e.entries()).ravel(), abs=1e-5)
    assert next_points(row)[0] == pytest.approx(entries(row)[0])  # arms start raised


_ENDS = np.r_[SLICES["P_A"].start + 15 : SLICES["P_A"].start + 18, SLICES["P_B"].start + 15 : SLICES["P_B"].start + 18]


def test_sub_goals_stay_within_reach_of_their_anchor(env: LunarRescueEnv) -> None:
    observation, _ = env.reset_flat(options={"scene": sample_scene(1)})
    there = observation[None].copy()  # the arms' ends at their anchor
    there[0, _ENDS] = targets(there)[0]
    anchors = RescueGoals(1, ANCHORS)
    anchors.update(there, np.array([True]))
    near = anchors.subgoals(np.zeros((1, SUBGOAL_SIZE), np.float32))
    assert near[0] == pytest.approx([*there[0, _ENDS], -0.052, -0.052])
    far = anchors.subgoals(np.array([[9.0, 0.0, 0.0, 0.0, 0.0, 0.0, 9.0, 0.0]], np.float32))
    assert (far - near)[0] == pytest.approx([0.25, 0, 0, 0.25, 0, 0, 0.15, 0.15], abs=1e-6)
    moved = anchors.subgoals(np.array([[1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.5, 1.0]], np.float32)) - near
    rises = [0.075 + 0.05, 0.075 - 0.05]
    assert moved[0] == pytest.approx([0.25, 0.0, -0.12, 0.25, 0.0, 0.12, *rises], abs=1e-6)
    anchors.update(observation[None], np.array([True]))  # arms that are far away are led there step by step
    way = anchors.subgoals(np.zeros((1, SUBGOAL_SIZE), np.float32))[0, :6] - arm_ends(observation[None])[0]
    whole = (next_points(observation[None]) - arm_ends(observation[None]))[0]
    for one, all_of_it in zip(way.reshape(2, 3), whole.reshape(2, 3), strict=True):
        assert np.linalg.norm(all_of_it) > 0.3
        assert one == pytest.approx(0.3 * all_of_it / np.linalg.norm(all_of_it), abs=1e-5)
    view = anchors.view(observation[None], near, np.ones(1, np.float32))
    assert view[0, SIZE : SIZE + SUBGOAL_SIZE] == pytest.approx(near[0])
    way = near - achieved(observation[None], 0.15)
    assert view[0, SIZE + SUBGOAL_SIZE : SIZE + 2 * SUBGOAL_SIZE] == pytest.approx(way[0])
    assert view[0, -JOINTS - 1 : -1] == pytest.approx(joint_step(observation[None], way, ANCHORS)[0])
    parts = np.column_stack([way[0, :6].reshape(2, 3), way[0, 6:], sideways_tilt(observation[None], 0.15)[0]])
    both = np.linalg.norm(parts, axis=1)
    assert anchors.distances(observation[None], near)[0] == pytest.approx(both)


@pytest.mark.parametrize("acting", [False, True])
def test_anchors_of_process_2_are_raised_and_go_back_where_a_body_slid_off(env: LunarRescueEnv, acting: bool) -> None:
    first, _ = env.reset_flat(options={"scene": sample_scene(1, posture="supine_straight")})
    row, start, zero = first[None], np.array([True]), np.zeros((1, SUBGOAL_SIZE), np.float32)
    goals = targets(row)
    under = row.copy()
    under[0, SLICES["phase"].start], under[0, _ENDS] = 1.0, goals[0]
    anchors = RescueGoals(1, ACTING if acting else ANCHORS)
    lowered = 0.1 if acting else 0.0
    anchors.update(row, start)
    anchors.update(under, ~start)
    begun = anchors.subgoals(zero)  # a lift begins further under the body
    assert begun[0, :6] - goals[0] == pytest.approx([0.1, 0, 0] * 2, abs=1e-5)
    assert begun[0, 6:] == pytest.approx([0.015] * 2)
    assert (anchors.subgoals(-np.eye(1, SUBGOAL_SIZE, dtype=np.float32)) - begun)[0, 0] == pytest.approx(-0.3)
    further = under.copy()
    further[0, _ENDS[[0, 3]]] += 0.1
    anchors.update(further, ~start)
    raised = anchors.subgoals(zero)
    assert (raised - begun)[0] == pytest.approx([0, 0, 0.1] * 2 + [0, 0], abs=1e-5)
    lifted = further.copy()
    lifted[0, SLICES["P_G"].start : SLICES["P_G"].start + 6] += 0.1  # where the targets go does not matter
    lifted[0, _ENDS[2]] += 0.08  # the arms stand 0.04 m higher
    anchors.update(lifted, ~start)
    assert (anchors.subgoals(zero) - raised)[0] == pytest.approx([0, 0, 0.04, 0, 0, 0.04, 0, 0], abs=1e-5)
    centre = SLICES["P_P"].start + 2
    for risen, lead in ((-0.04, 0.04), (0.04, -min(0.04, lowered)), (0.2, -lowered)):
        lifted[0, centre] = further[0, centre] + 0.3 + risen
        anchors.update(lifted, ~start)
        heights = lifted[0, _ENDS[[2, 5]]]
        assert not slipped(lifted, ANCHORS)[0]
        assert anchors.subgoals(zero)[0, [2, 5]] - goals[0, [2, 5]] == pytest.approx(
            (heights - goals[0, [2, 5]]).mean() + lead, abs=1e-5
        )
    off = under.copy()
    off[0, _ENDS[2]] += 0.3 + 0.01  # arm A above its target area
    anchors.update(off, ~start)
    assert slipped(off, ANCHORS)[0] and not slipped(under, ANCHORS)[0]
    way, whole = (made[0, :3] - arm_ends(off)[0, :3] for made in (anchors.subgoals(zero), next_points(off)))
    assert way == pytest.approx(whole * min(1.0, (0.25 if acting else 0.3) / float(np.linalg.norm(whole))), abs=1e-5)
    assert anchors.subgoals(zero)[0, 6:] == pytest.approx([-0.052] * 2)
    turning = under.copy()
    turning[0, SLICES["I"]] = [0.0, 1.0]
    anchors.update(turning, ~start)
    assert (anchors.subgoals(zero)[0, :6] - goals[0]) == pytest.approx([0, 0, 0.1] * 2, abs=1e-5)
    high = turning.copy()
    high[0, _ENDS[[2, 5]]] = goals[0, [2, 5]] + 0.5 + 0.1
    anchors.update(high, ~start)
    assert anchors.subgoals(zero)[0, 2] == pytest.approx(goals[0, 2] + 0.5, abs=1e-5)
    turning[0, _ENDS[2]] = off[0, _ENDS[2]]
    assert not slipped(turning, ANCHORS)[0]


def test_zero_output_holds_the_arms_still(env: LunarRescueEnv) -> None:
    observation, _ = env.reset_flat(options={"scene": sample_scene(2)})
    for _ in range(5):
        observation, *_ = env.step_flat(to_environment(observation[None], np.zeros((1, 11), np.float32))[0])
    assert np.abs(env.episode.robot.angles - env.robot.initial).max() < 0.02
    action = to_environment(observation[None], np.ones((1, 11), np.float32))[0]
    before = env.robot.action_for(env.episode.robot.angles)
    assert action - before == pytest.approx(np.full(11, LARGEST_CHANGE), abs=1e-5)


@pytest.mark.process
def test_both_layers_learn_from_the_same_steps(training: HierarchicalTraining) -> None:
    before = {name: [p.detach().clone() for p in one.policy.parameters()] for name, one in training.learners.items()}
    for update in range(training.config.hierarchy.sgn_every):
        row = training.update(update * training.steps_per_update)
        learnt = not th.equal(before["sgn"][0], next(iter(training.sgn.policy.parameters())))
        assert learnt == (update + 1 == training.config.hierarchy.sgn_every)
    for name, learner in training.learners.items():
        changed = [not th.equal(a, b) for a, b in zip(before[name], learner.policy.parameters(), strict=True)]
        assert all(changed), name
        assert np.isfinite(row[f"{name}_approx_kl"])


def test_high_level_records_add_up(training: HierarchicalTraining) -> None:
    """EXR of SGN's decisions is the environment's reward, none lost and none counted twice."""
    env = training.env
    env.reset()
    total = np.zeros(training.config.n_envs)
    rng = np.random.default_rng(0)
    for _ in range(12):
        env.step(rng.uniform(-1, 1, (training.config.n_envs, 11)).astype(np.float32))
        total += training.venv.terms.sum(axis=1)
    recorded = [sum(d.reward for d in made) for made in env.high.decisions]
    assert recorded == pytest.approx(list(total), abs=1e-4)
    interval = training.config.hierarchy.interval
    assert all(len(made) == 1 + 12 // interval for made in env.high.decisions)  # t = 0, N, 2N
    rollout = env.high.rollout(0.99, 0.95, 16)
    assert rollout is not None and len(rollout) == training.config.n_envs * (12 // interval)
    assert all(len(made) == 1 for made in env.high.decisions)  # the one under way stays


def test_lln_returns_are_cut_where_a_sub_goal_ends(training: HierarchicalTraining) -> None:
    env = training.env
    env.reset()
    env.cuts.clear()
    for _ in range(2 * training.config.hierarchy.interval):
        env.step(np.zeros((training.config.n_envs, 11), np.float32))
    cuts = np.array(env.cuts)[:, 0]
    assert list(np.flatnonzero(cuts) + 1) == [training.config.hierarchy.interval * k for k in (1, 2)]


def test_sgn_s_mean_is_bounded_and_lln_s_is_not() -> None:
    sgn = NetworkSpec(SIZE, SUBGOAL_SIZE, 32, True).build()
    assert isinstance(sgn.action_net[-1], th.nn.Tanh)  # type: ignore[index]
    assert isinstance(NetworkSpec(SIZE, 11, 32, False).build().action_net, th.nn.Linear)


def _networks() -> tuple[RecurrentNetwork, RecurrentNetwork]:
    made = [
        NetworkSpec(seen, actions, hidden_units=32, bounded_mean=level == "sgn").build()
        for level, (seen, actions) in SIZES.items()
    ]
    for network in made:
        network.set_training_mode(False)
    return made[0], made[1]


def test_ablations_take_one_layer_away_and_leave_the_other(env: LunarRescueEnv) -> None:
    first, _ = env.reset_flat(options={"scene": sample_scene(1)})
    row, start = first[None], np.array([True])
    policy = HierarchicalPolicy(*_networks(), HierarchicalPolicyConfig(False, 5, ACTING))
    before = policy.act(row, start)
    seen = {}
    for name in ABLATIONS:
        made = ablated(policy, name, "hrl_dcs")
        action = made.act(row, start)
        assert not np.array_equal(action, before)
        seen[name] = made.overlay()["sub-goal"].reshape(1, 6)
        assert made.networks[0] is policy.networks[0]
        assert (made.networks[1] is policy.networks[1]) == (name != "untrained_lln")
    assert seen["fixed_target"] == pytest.approx(targets(row))
    anchors = RescueGoals(1, ACTING)
    anchors.update(row, start)
    assert seen["anchors_alone"] == pytest.approx(anchors.subgoals(np.zeros((1, SUBGOAL_SIZE), np.float32))[:, :6])
    assert seen["untrained_lln"] == pytest.approx(policy.overlay()["sub-goal"].reshape(1, 6))
    with pytest.raises(UserError, match=r"--ablation.*fixed_target"):
        ablated(policy, "no_arms", "hrl_dcs")
    with pytest.raises(UserError, match="random has no two layers"):
        ablated(METHODS["random"].act(0), "fixed_target", "random")


def test_acting_in_a_batch_keeps_memories_apart() -> None:
    networks = _networks()
    rng = np.random.default_rng(0)
    rows = rng.uniform(-1, 1, (7, 3, SIZE)).astype(np.float32)
    starts = np.zeros((7, 3), bool)
    starts[0], starts[4, 1] = True, True
    together = HierarchicalPolicy(*networks, HierarchicalPolicyConfig(True, 5, ACTING))
    batch = [together.act(rows[t], starts[t]) for t in range(7)]
    for env in range(3):
        alone = HierarchicalPolicy(*networks, HierarchicalPolicyConfig(True, 5, ACTING))
        for t in range(7):
            single = alone.act(rows[t, env : env + 1], starts[t, env : env + 1])[0]
            assert single == pytest.approx(batch[t][env], abs=1e-5)


@pytest.mark.process
def test_a_script_that_is_blind_to_rocks_rescues_some_and_runs_into_many() -> None:
    """It rescues about 40 % of validation scenes; at least 15 % of those with rocks it must fail by contact."""
    rows = rescue_scenes("scripted", 40, quiet=True)
    assert sum(row["success"] for row in rows) >= 8
    among_rocks = [row["failure"] == "obstacle_contact" for row in rows if row["rocks"]]
    assert np.mean(among_rocks) >= 0.15


@pytest.mark.process
def test_random_actions_rescue_nobody() -> None:
    assert not any(row["success"] for row in rescue_scenes("random", 10, quiet=True))


@pytest.mark.process
@pytest.mark.parametrize("workers", [1, 2, 3])
def test_workers_step_the_same_whatever_their_number(workers: int) -> None:
    venv = WorkerVecEnv(3, seed=5, workers=workers)
    rng = np.random.default_rng(1)
    try:
        seen: list[Any] = [venv.reset()]
        for _ in range(8):
            observations, rewards, _, _ = venv.step(rng.uniform(-1, 1, (3, 11)).astype(np.float32))
            assert venv.terms.sum(axis=1) == pytest.approx(rewards, abs=1e-5)
            seen.append(observations)
    finally:
        venv.close()
    assert len(TERMS) == 7
    total = float(np.sum(np.array(seen, np.float64) ** 2))
    reference = _REFERENCE.setdefault("total", total)
    assert total == reference


_REFERENCE: dict[str, float] = {}


@pytest.mark.process
def test_a_dead_worker_is_an_error_and_not_a_hang() -> None:
    venv = WorkerVecEnv(2, seed=0, workers=2)
    try:
        venv.reset()
        os.kill(venv._processes[1].pid, signal.SIGKILL)
        time.sleep(0.2)
        with pytest.raises(WorkerError, match="worker 1 of 2 died"):
            for _ in range(3):
                venv.step(np.zeros((2, 11), np.float32))
    finally:
        venv.close()


@pytest.mark.slow
def test_hrl_dcs_learns_to_get_both_arms_under(tmp_path: object) -> None:
    """Trials had 50 % of arms under by 250,000 steps; untrained networks and random actions stay at 0 %."""
    from pathlib import Path

    config = replace(METHODS["hrl_dcs"].config("laptop"), steps=250_000)
    curve = train(METHODS["hrl_dcs"], config, 1, Path(str(tmp_path)) / "run", "laptop", quiet=True)
    assert curve["both_arms_under"].tail(12).mean() > 0.3


def test_anchors_wait_no_longer_than_their_patience(env: LunarRescueEnv) -> None:
    first, _ = env.reset_flat(options={"scene": sample_scene(1, posture="supine_straight", task="lift")})
    under, start, zero = first[None].copy(), np.array([True]), np.zeros((1, SUBGOAL_SIZE), np.float32)
    under[0, SLICES["phase"].start], under[0, _ENDS] = 1.0, targets(under)[0]
    anchors = RescueGoals(1, ANCHORS)
    for step in range(15 + 1):
        anchors.update(under, start & (step == 0))
        up = anchors.subgoals(zero)[0, 2] - arm_ends(under)[0, 2]
        assert up == pytest.approx(0.1 if step == 15 else 0.0, abs=1e-5)


@pytest.mark.parametrize("task", ["lift", "turn_over"])
def test_anchors_of_a_body_face_down_slope_more_and_move_as_they_rise(env: LunarRescueEnv, task: str) -> None:
    first, _ = env.reset_flat(options={"scene": sample_scene(1, posture="prone_straight", task=task)})
    furthers, rises = {"lift": ((0.15, 0.0), (0.015, 0.105)), "turn_over": ((0.0, 0.3), (0.03, 0.03))}[task]
    under, start, zero = first[None].copy(), np.array([True]), np.zeros((1, SUBGOAL_SIZE), np.float32)
    goals = targets(under)[0].copy()
    under[0, SLICES["phase"].start], under[0, _ENDS] = 1.0, goals
    anchors = RescueGoals(1, ANCHORS)
    anchors.update(under, start)
    for share in (0.0, 0.5, 1.0):
        raised = 0.05 + share * 0.25
        row = under.copy()
        row[0, _ENDS[[2, 5]]] += raised
        further, tips = (pair[0] + share * (pair[1] - pair[0]) for pair in (furthers, rises))
        row[0, _ENDS[[0, 3]]] += further  # so that nothing is cut at the stride
        row[0, SLICES["P_G"].start + 2] += raised  # nor the body taken for slid off
        row[0, SLICES["P_G"].start + 5] += raised
        anchors.update(row, ~start)
        places = anchors.subgoals(zero)[0]
        assert places[[0, 3]] - goals[[0, 3]] == pytest.approx([further] * 2, abs=1e-5)
        assert places[6:] == pytest.approx([tips] * 2, abs=1e-6)
