from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from lunar_rescue import LunarRescueEnv, sample_scene
from lunar_rescue.physics.kinematics import END, ArmChain, solve_arm, solve_arms
from lunar_rescue.physics.robot import ARMS, WAIST
from reproduce.baselines.planner.approach import CollisionChecker
from reproduce.baselines.planner.planner import PlannerPolicy, RescuePlanner
from reproduce.baselines.planner.rrt import connect, length, path_is_free, resample, shortcut
from reproduce.baselines.scripted import SCRIPT, VARIANTS, WayPoint, load_way_points
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
BOUNDS = np.full(2, -1.0), np.full(2, 1.0)


def wall(gap: float) -> Any:
    """A wall at x = 0 with a gap at the top."""
    return lambda q: bool(np.all(np.abs(q) <= 1.0) and (abs(q[0]) > 0.1 or q[1] > 1.0 - gap))


def test_rrt_finds_a_way_round_a_wall_and_repeats_it() -> None:
    free, start, goal = wall(0.3), np.array([-0.8, -0.8]), np.array([0.8, -0.8])
    ways = [connect(start, goal, free, BOUNDS, np.random.default_rng(3), resolution=0.02) for _ in range(2)]
    assert ways[0] is not None and ways[1] is not None
    np.testing.assert_array_equal(ways[0], ways[1])
    np.testing.assert_array_equal(ways[0][[0, -1]], [start, goal])
    assert path_is_free(ways[0], free, 0.01)
    short = shortcut(ways[0], free, np.random.default_rng(0), resolution=0.02)
    assert length(short) <= length(ways[0]) + 1e-9
    assert path_is_free(short, free, 0.01)


def test_rrt_reports_none_when_enclosed() -> None:
    start, goal = np.array([-0.8, 0.0]), np.array([0.8, 0.0])
    assert connect(start, goal, wall(0.0), BOUNDS, np.random.default_rng(0), draws=100) is None
    blocked = np.array([0.0, 0.0])
    assert connect(start, blocked, wall(0.3), BOUNDS, np.random.default_rng(0)) is None


def test_resampled_paths_keep_corners_and_spacing() -> None:
    path = np.array([[0.0, 0.0], [0.5, 0.0], [0.5, 0.3]])
    points = resample(path, 0.04)
    assert np.abs(np.diff(points, axis=0)).max() <= 0.04 + 1e-12
    for corner in path:
        assert np.abs(points - corner).sum(axis=1).min() < 1e-12


# -- kinematics and collision check ----------------------------------------------------------------------------------
def test_batch_inverse_kinematics_agrees_with_scipy_and_repeats_alone() -> None:
    rng = np.random.default_rng(0)
    lower, upper = np.radians([-60.0, -25.0, -60.0, 80.0, -60.0]), np.radians([60.0, 68.0, 60.0, 160.0, 60.0])
    start = np.radians([0.0, 8.0, 0.0, 140.0, 0.0])
    targets = rng.uniform([0.5, 0.3, 0.03], [0.9, 0.5, 0.3], (20, 3))
    waists, slopes = rng.uniform(0.0, 0.8, 20), rng.uniform(-0.1, 0.2, 20)
    solved = {}
    for side in (1, -1):
        wanted = targets * [1, side, 1]
        angles, misses = solve_arms(wanted, slopes, waists, side, np.tile(start, (20, 1)), lower, upper)
        solved[side] = angles
        ends = ArmChain(waists, angles).points[:, END] * [1, side, 1]
        assert np.linalg.norm(ends - wanted, axis=1) == pytest.approx(misses, abs=1e-9)
        for i in range(20):
            single = solve_arm(wanted[i], slopes[i], waists[i], side, start, lower, upper)
            end = ArmChain(waists[[i]], single[None]).points[0, END] * [1, side, 1]
            assert misses[i] <= np.linalg.norm(end - wanted[i]) + 0.005
        for i in (3, 17):
            alone = solve_arms(wanted[[i]], slopes[[i]], waists[[i]], side, start[None], lower, upper)
            assert alone[0][0] == pytest.approx(angles[i], abs=1e-9)
    assert np.array_equal(solved[1], solved[-1])  # joints are counted alike for both arms


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
@pytest.mark.process
def test_same_scene_same_plan(planner: RescuePlanner) -> None:
    scene = sample_scene(TRAIN_SEEDS[0])
    first = planner.plan(scene)
    planner.plan(sample_scene(TRAIN_SEEDS[1]))
    np.testing.assert_array_equal(first.actions, planner.plan(scene).actions)


@pytest.mark.process
@pytest.mark.parametrize("seed", TRAIN_SEEDS)
def test_planner_gets_both_arms_under_without_touching_a_rock(
    seed: int, planner: RescuePlanner, env: LunarRescueEnv
) -> None:
    scene, policy = sample_scene(seed), PlannerPolicy(planner)
    ended = run_episode(env, policy, scene)
    assert policy.plan is not None
    assert ended["both_arms_under"]
    assert ended["failure"] != "obstacle_contact"
    assert (ended["success"], ended["both_arms_under"]) == (policy.plan.rescued, policy.plan.under)
    # Once more, looking at every contact with a rock on the way in.
    env.reset_flat(options={"scene": scene})
    for action in policy.plan.actions:
        _, _, terminated, truncated, info = env.step_flat(action)
        if info["both_arms_under"] or terminated or truncated:
            break
        assert not any(env.simulation.touching(env.robot.handle, rock) for rock in env.episode.rocks)
    assert info["both_arms_under"]


@pytest.mark.process
def test_solvability_writes_rows_summary_and_origin(tmp_path: Path) -> None:
    summary = measure_solvability(2, TRAIN_SEEDS[0], variants=3, folder=tmp_path, json=tmp_path / "x.json", quiet=True)
    assert (
        json.loads((tmp_path / "summary.json").read_text()) == summary == json.loads((tmp_path / "x.json").read_text())
    )
    rows = (tmp_path / "scenes.csv").read_text().splitlines()
    assert len(rows) == 3 and rows[0].startswith("seed,task,posture,terrain")
    assert summarise_solvability(pd.read_csv(tmp_path / "scenes.csv")).items() <= summary.items()
    assert "scenes.csv" in json.loads((tmp_path / "origins.json").read_text())
    assert summary["tests"] == summary["as_planned"] == 2
    assert summary["origin"]["commit"]


@pytest.mark.process
def test_shares_count_scenes(planner: RescuePlanner) -> None:
    row = solve_scene(TRAIN_SEEDS[0], planner)
    lost = {**row, "rescued": 0, "first_try_rescued": 0, "failure": "timeout"}
    summary = summarise_solvability(pd.DataFrame([row, lost]))
    shares = summary["shares"]
    assert shares["process1"]["scenes"] == 2 and shares["rescued"]["scenes"] == 1
    # Wilson by hand for 1 of 2: (0.5 + z^2/4) / (1 + z^2/2) -+ z sqrt(1/8 + z^2/16) / (1 + z^2/2), z = 1.96.
    assert shares["rescued"]["wilson_low"] == pytest.approx(0.0945, abs=1e-4)
    assert shares["rescued"]["wilson_high"] == pytest.approx(0.9055, abs=1e-4)
    assert summary["by_group"]["rescued"]["task"] == {row["task"]: {"tests": 2, "successes": 1}}
    assert summary["failures"] == {"timeout": 1}


@pytest.mark.parametrize("bad", [0, -1, True, 2.5])
def test_bad_caps_are_the_users_to_mend(bad: Any) -> None:
    with pytest.raises(UserError, match="variants: expected an integer >= 1"):
        RescuePlanner(variants=bad)
    with pytest.raises(UserError, match="approaches: expected an integer >= 1"):
        RescuePlanner(approaches=bad)


def test_bad_measurements_are_refused_before_any_work(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="tests: expected at least 1"):
        measure_solvability(0)
    with pytest.raises(UserError, match="first seed: expected at least 0"):
        measure_solvability(1, -1)
    with pytest.raises(UserError, match="choose seeds of one split"):
        measure_solvability(2, 1_999_999_999)
    (tmp_path / "file").write_text("")
    for json_file in (tmp_path / "file" / "x.json", tmp_path):
        with pytest.raises(UserError, match=str(json_file)):
            measure_solvability(10_000, folder=tmp_path / "out", json=json_file)
    assert not (tmp_path / "out").exists()


@pytest.mark.process
def test_policy_needs_the_scene_and_one_environment(planner: RescuePlanner) -> None:
    policy = PlannerPolicy(planner)
    with pytest.raises(UserError, match="needs the scene"):
        policy.act(np.zeros((1, 4), dtype=np.float32), np.array([True]))
    policy.prepare(sample_scene(TRAIN_SEEDS[0]))
    with pytest.raises(UserError, match="one environment at a time"):
        policy.act(np.zeros((2, 4), dtype=np.float32), np.array([True, True]))


KINDS = {"lift supine", "lift prone", "turn_over prone", "turn_over side"}
POINT = {"ahead": 0.1, "aside": 0.0, "up": 0.2, "slope": 5, "waist": 30, "patience": 12}


def test_way_points_are_those_of_the_files() -> None:
    assert set(load_way_points(VARIANTS)) == KINDS
    assert {len(variants) for variants in load_way_points(VARIANTS).values()} == {15}
    script = load_way_points(SCRIPT)
    assert set(script) == KINDS | {"get under"}
    assert script["lift prone"][0][1] == WayPoint(0.01, 0.0, 0.42, 32.0, 35.0, 14)
    assert load_way_points(SCRIPT) is script  # read once


@pytest.mark.parametrize(
    ("content", "where"),
    [
        ("no", "not readable as JSON"),
        ("{}", "kinds: Field required"),
        ('{"kinds": 3}', "kinds: Input should be"),
        ('{"kinds": {"lift prone": [[{"ahead": 1}]]}}', "kinds.lift prone.0.0.aside: Field required"),
        ({"ahead": "0.1"}, "ahead: Input should be a valid number, got '0.1'"),
        ({"up": 1e999}, "up: .*finite.*, got inf"),
        ({"up": float("nan")}, "up: .*finite.*, got nan"),
        ({"aside": 3.0}, "aside: .*less than or equal to 2, got 3.0"),
        ({"slope": 10**400}, "slope: "),
        ({"waist": -100}, "waist: .*greater than or equal to -90, got -100"),
        ({"patience": 2.5}, "patience: .*integer, got 2.5"),
        ({"patience": 0}, "patience: .*greater than or equal to 1, got 0"),
        ({"patience": True}, "patience: .*integer, got True"),
        ({"hurry": 1}, "hurry: .*got 1"),
    ],
)
def test_odd_numbers_in_a_file_are_one_clear_error(content: Any, where: str, tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    path.write_text(content if isinstance(content, str) else json.dumps({"kinds": {"a": [[{**POINT, **content}]]}}))
    with pytest.raises(UserError, match=f"^{path}: file of way-points.*{where}") as raised:
        load_way_points(path)
    assert "\n" not in str(raised.value) and len(str(raised.value)) < len(str(path)) + 200


def test_a_plan_moves_both_arms(planner: RescuePlanner) -> None:
    plan = planner.plan(sample_scene(TRAIN_SEEDS[2]))
    assert plan.actions.dtype == np.float32 and np.abs(plan.actions).max() <= 1.0
    for arm in ARMS:
        assert np.ptp(plan.actions[:, arm.joints], axis=0).max() > 0.1
