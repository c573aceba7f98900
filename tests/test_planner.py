from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lunar_rescue import LunarRescueEnv, sample_scene
from lunar_rescue.physics.kinematics import arm_pose, solve_arm
from lunar_rescue.physics.robot import ARMS, WAIST
from reproduce.baselines.planner.batch_ik import plate_tips, solve_arms
from reproduce.baselines.planner.collision import CollisionChecker
from reproduce.baselines.planner.planner import RescuePlanner
from reproduce.baselines.planner.policy import PlannerPolicy
from reproduce.baselines.planner.rrt import connect, length, path_is_free, resample, shortcut
from reproduce.baselines.planner.variants import load_variants
from reproduce.experiments.evaluate import run_episode
from reproduce.experiments.solvability import measure_solvability, solve_scene, summarise_solvability
from reproduce.storage.errors import UserError

TRAIN_SEEDS = range(3_200_000, 3_200_006)


@pytest.fixture(scope="module")
def planner() -> Iterator[RescuePlanner]:
    made = RescuePlanner()
    yield made
    made.close()


@pytest.fixture(scope="module")
def checker() -> Iterator[CollisionChecker]:
    made = CollisionChecker()
    yield made
    made.close()


# -- RRT-Connect in a toy space ------------------------------------------------------------------------------------
LOW, HIGH = np.full(2, -1.0), np.full(2, 1.0)


def wall(gap: float) -> Any:
    """A wall at x = 0 with a gap at the top."""
    return lambda q: bool(np.all(np.abs(q) <= 1.0) and (abs(q[0]) > 0.1 or q[1] > 1.0 - gap))


def test_rrt_finds_a_way_round_a_wall_and_repeats_it() -> None:
    free, start, goal = wall(0.3), np.array([-0.8, -0.8]), np.array([0.8, -0.8])
    ways = [connect(start, goal, free, LOW, HIGH, np.random.default_rng(3), resolution=0.02) for _ in range(2)]
    assert ways[0] is not None and ways[1] is not None
    np.testing.assert_array_equal(ways[0], ways[1])
    np.testing.assert_array_equal(ways[0][[0, -1]], [start, goal])
    assert path_is_free(ways[0], free, 0.01)
    short = shortcut(ways[0], free, np.random.default_rng(0), resolution=0.02)
    assert length(short) <= length(ways[0]) + 1e-9
    assert path_is_free(short, free, 0.01)


def test_rrt_reports_none_when_enclosed() -> None:
    start, goal = np.array([-0.8, 0.0]), np.array([0.8, 0.0])
    assert connect(start, goal, wall(0.0), LOW, HIGH, np.random.default_rng(0), iterations=100) is None
    blocked = np.array([0.0, 0.0])
    assert connect(start, blocked, wall(0.3), LOW, HIGH, np.random.default_rng(0)) is None


def test_resampled_paths_keep_corners_and_spacing() -> None:
    path = np.array([[0.0, 0.0], [0.5, 0.0], [0.5, 0.3]])
    points = resample(path, 0.04)
    assert np.abs(np.diff(points, axis=0)).max() <= 0.04 + 1e-12
    for corner in path:
        assert np.abs(points - corner).sum(axis=1).min() < 1e-12


# -- kinematics and collision check ----------------------------------------------------------------------------------
def test_batch_inverse_kinematics_agrees_with_the_single_one() -> None:
    rng = np.random.default_rng(0)
    lower, upper = np.radians([-60.0, -25.0, -60.0, 80.0, -60.0]), np.radians([60.0, 68.0, 60.0, 160.0, 60.0])
    start = np.radians([0.0, 8.0, 0.0, 140.0, 0.0])
    targets = rng.uniform([0.5, 0.3, 0.03], [0.9, 0.5, 0.3], (20, 3))
    waists, slopes = rng.uniform(0.0, 0.8, 20), rng.uniform(-0.1, 0.2, 20)
    for side in (1, -1):
        wanted = targets * [1, side, 1]
        angles, misses = solve_arms(wanted, slopes, waists, side, np.tile(start, (20, 1)), lower, upper)
        tips = plate_tips(waists, angles, side)
        for i in range(20):
            pose = arm_pose(waists[i], angles[i], side)
            assert np.linalg.norm(pose.points[-1] - wanted[i]) == pytest.approx(misses[i], abs=1e-9)
            np.testing.assert_allclose(tips[i], pose.points[-1] + 0.12 * pose.direction, atol=1e-9)
            _, single = solve_arm(wanted[i], slopes[i], waists[i], side, start, lower, upper)
            assert misses[i] <= single + 0.005


def test_collision_check_sees_known_overlaps(checker: CollisionChecker, env: LunarRescueEnv) -> None:
    scene = sample_scene(3_200_000, posture="supine_straight", task="lift")
    checker.set_scene(scene)
    start = env.robot.initial
    assert checker.free(start)
    down = start.copy()
    down[3] = down[8] = np.radians(5.0)  # both forearms straight down, into the ground
    assert not checker.free(down)
    over = start.copy()
    over[WAIST] = np.radians(60.0)
    over[[0, 5]] = np.radians(60.0)  # upper arms ahead, forearms down into the body
    over[[3, 8]] = np.radians(80.0)
    assert not checker.free(over)
    assert checker.free(start)  # nothing is left behind by what was asked before


def test_collision_check_sees_rocks_and_keeps_away_from_them(checker: CollisionChecker, env: LunarRescueEnv) -> None:
    scene = next(s for s in map(sample_scene, range(3_200_000, 3_200_100)) if len(s.rocks) > 3)
    rng = np.random.default_rng(0)
    samples = rng.uniform(env.robot.lower, env.robot.upper, (1500, 11))
    found = {}
    for margin in (0.0, 0.05):
        checker.set_scene(scene, margin)
        found[margin] = np.array([checker.free(q) for q in samples])
    assert not np.any(found[0.05] & ~found[0.0])
    assert np.any(found[0.0] & ~found[0.05])


# -- whole plans -------------------------------------------------------------------------------------------------------
def test_same_scene_same_plan(planner: RescuePlanner) -> None:
    scene = sample_scene(TRAIN_SEEDS[0])
    first = planner.plan(scene)
    planner.plan(sample_scene(TRAIN_SEEDS[1]))
    np.testing.assert_array_equal(first.actions, planner.plan(scene).actions)


@pytest.mark.parametrize("seed", TRAIN_SEEDS)
def test_planner_gets_both_arms_under_without_touching_a_rock(
    seed: int, planner: RescuePlanner, env: LunarRescueEnv
) -> None:
    scene, policy = sample_scene(seed), PlannerPolicy(planner)
    ended = run_episode(env, policy, scene)
    assert policy.plan is not None
    assert ended["both_arms_under"]
    assert ended["failure"] != "obstacle_contact"
    assert (ended["is_success"], ended["both_arms_under"]) == (policy.plan.rescued, policy.plan.under)
    # Once more, looking at every contact with a rock on the way in.
    env.reset_flat(options={"scene": scene})
    for action in policy.plan.actions:
        _, _, terminated, truncated, info = env.step_flat(action)
        if info["both_arms_under"] or terminated or truncated:
            break
        assert not any(env.simulation.touching(env.robot.handle, rock) for rock in env.episode.rocks)
    assert info["both_arms_under"]


def test_solvability_writes_rows_summary_and_origin(tmp_path: Path) -> None:
    summary = measure_solvability(2, TRAIN_SEEDS[0], variants=3, folder=tmp_path, json=tmp_path / "x.json", quiet=True)
    assert (
        json.loads((tmp_path / "summary.json").read_text()) == summary == json.loads((tmp_path / "x.json").read_text())
    )
    rows = (tmp_path / "scenes.csv").read_text().splitlines()
    assert len(rows) == 3 and rows[0].startswith("seed,task,posture,terrain")
    assert "scenes.csv" in json.loads((tmp_path / "origins.json").read_text())
    assert summary["tests"] == summary["as_planned"] == 2
    assert summary["origin"]["commit"]


def test_shares_count_scenes(planner: RescuePlanner) -> None:
    row = solve_scene(TRAIN_SEEDS[0], planner)
    lost = {**row, "rescued": 0, "first_try_rescued": 0, "failure": "timeout"}
    shares = summarise_solvability([row, lost])["shares"]
    assert shares["process1"]["scenes"] == 2 and shares["rescued"]["scenes"] == 1
    assert shares["rescued"]["wilson_low"] < 0.5 < shares["rescued"]["wilson_high"]


@pytest.mark.parametrize("bad", [0, -1, True, 2.5])
def test_bad_caps_are_the_users_to_mend(bad: Any) -> None:
    with pytest.raises(UserError, match="variants: expected an integer >= 1"):
        RescuePlanner(variants=bad)
    with pytest.raises(UserError, match="approaches: expected an integer >= 1"):
        RescuePlanner(approaches=bad)


def test_bad_measurements_are_refused() -> None:
    with pytest.raises(UserError, match="tests: expected at least 1"):
        measure_solvability(0)
    with pytest.raises(UserError, match="first seed: expected at least 0"):
        measure_solvability(1, -1)


def test_policy_needs_the_scene_and_one_environment(planner: RescuePlanner) -> None:
    policy = PlannerPolicy(planner)
    with pytest.raises(UserError, match="needs the scene"):
        policy.act(np.zeros((1, 4), dtype=np.float32), np.array([True]))
    policy.prepare(sample_scene(TRAIN_SEEDS[0]))
    with pytest.raises(UserError, match="one environment at a time"):
        policy.act(np.zeros((2, 4), dtype=np.float32), np.array([True, True]))


def test_variants_file_is_read_and_checked(tmp_path: Path) -> None:
    assert set(load_variants()) == {"lift supine", "lift prone", "turn_over prone", "turn_over side"}
    assert all(variants for variants in load_variants().values())
    for text in ('{"kinds": 3}', '{"kinds": {"lift prone": [[{"ahead": 1}]]}}', "{}", "no"):
        path = tmp_path / f"{abs(hash(text))}.json"
        path.write_text(text)
        with pytest.raises(UserError, match=str(path)):
            load_variants(path)


def test_a_plan_moves_both_arms(planner: RescuePlanner) -> None:
    plan = planner.plan(sample_scene(TRAIN_SEEDS[2]))
    assert plan.actions.dtype == np.float32 and np.abs(plan.actions).max() <= 1.0
    for arm in ARMS:
        assert np.ptp(plan.actions[:, arm.joints], axis=0).max() > 0.1
