"""Disturbances: each does what its table says, all repeat from the scene's seed, and none changes nothing."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from command_line import call  # type: ignore[import-not-found]  # pytest puts this folder on the path

from lunar_rescue import LunarRescueEnv, Scene, sample_scene
from lunar_rescue.arrays import Array, Floats
from lunar_rescue.disturbances import KINDS, NOTHING, SEVERITIES, Disturbance, disturbance, randomised
from lunar_rescue.disturbed import DisturbedEnv
from lunar_rescue.observation import SLICES
from lunar_rescue.physics.engines import SIMULATORS
from lunar_rescue.scenes.scene import MASS_RANGE
from lunar_rescue.scenes.splits import VALIDATION
from reproduce.experiments.methods import METHODS
from reproduce.experiments.presets import PRESETS
from reproduce.learning.workers import EnvOptions, WorkerVecEnv

SEED = VALIDATION.start


@pytest.fixture(scope="module")
def env() -> Iterator[DisturbedEnv]:
    made = DisturbedEnv()
    yield made
    made.close()


def actions(scene: Scene, count: int = 12) -> Floats:
    return np.random.default_rng(scene.seed).uniform(-0.6, 0.6, (count, 11)).astype(np.float32)


def play(env: LunarRescueEnv, scene: Scene, what: Disturbance | None = None, count: int = 12) -> tuple[Array, Array]:
    """Return observations (count + 1, SIZE) and rewards (count,) of random actions."""
    options = {"scene": scene} if what is None else {"scene": scene, "disturbance": what}
    seen, rewards = [env.reset_flat(options=options)[0]], []
    for action in actions(scene, count):
        observation, reward, *_ = env.step_flat(action)
        seen.append(observation)
        rewards.append(reward)
    return np.array(seen), np.array(rewards)


# -- nothing is nothing ------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("simulator", list(SIMULATORS))
def test_without_a_disturbance_episodes_are_the_same_bit_for_bit(simulator: str) -> None:
    pytest.importorskip(simulator)
    plain, disturbed = LunarRescueEnv(simulator=simulator), DisturbedEnv(simulator=simulator)
    for seed in (SEED, SEED + 3):
        scene = sample_scene(seed)
        expected = play(plain, scene)
        play(disturbed, scene, disturbance(scene, "payload", "high"))
        play(disturbed, scene, replace(randomised(scene), position=0.05))
        for what in (None, NOTHING, Disturbance(seed=7)):
            for found, wanted in zip(play(disturbed, scene, what), expected, strict=True):
                assert np.array_equal(found, wanted)
    plain.close()
    disturbed.close()


# -- tables ------------------------------------------------------------------------------------------------------------
def test_levels_are_what_was_asked_for_and_grow() -> None:
    levels = {name: kind.levels for name, kind in KINDS.items()}
    assert levels["position"] == (1.0, 2.0, 5.0) and levels["attitude"][:2] == (2.0, 5.0)
    assert levels["delay"][:2] == (1.0, 2.0) and levels["payload"][1:] == (5.0, 10.0)
    assert len(levels) == 10 and SEVERITIES == ("low", "middle", "high")
    assert all(low < middle < high for low, middle, high in levels.values())


@pytest.mark.process
@pytest.mark.parametrize("kind", list(KINDS))
def test_they_repeat_from_the_seed_and_differ_between_scenes_and_severities(env: DisturbedEnv, kind: str) -> None:
    scene = sample_scene(SEED + 1)
    low, middle, high = (disturbance(scene, kind, severity) for severity in SEVERITIES)
    assert high == disturbance(scene, kind, "high") and len({low, middle, high}) == 3
    assert low.seed == high.seed != disturbance(sample_scene(SEED + 2), kind, "low").seed
    first = play(env, scene, high, 40)
    play(env, sample_scene(SEED + 2), low)
    assert all(np.array_equal(a, b) for a, b in zip(first, play(env, scene, high, 40), strict=True))
    there = env.episode.marks
    pairs = zip((*first, there), (*play(env, scene, NOTHING, 40), env.episode.marks), strict=True)
    assert not all(np.array_equal(a, b) for a, b in pairs), f"{kind} changes nothing"


def test_what_does_not_exist_is_refused(env: DisturbedEnv) -> None:
    scene = sample_scene(SEED)
    with pytest.raises(ValueError, match=r"kind: expected one of position, .*; got 'wind'"):
        disturbance(scene, "wind", "low")
    with pytest.raises(ValueError, match="severity: expected one of low, middle, high; got 'none'"):
        disturbance(scene, "delay", "none")
    with pytest.raises(ValueError, match=r"options\['disturbance'\]: expected a Disturbance, got str"):
        env.reset(options={"scene": scene, "disturbance": "delay"})


# -- what is seen ------------------------------------------------------------------------------------------------------
@pytest.mark.process
def test_noise_has_its_size_and_moves_all_that_hangs_on_the_body(env: DisturbedEnv) -> None:
    errors, turns = [], []
    for seed in range(SEED, SEED + 40):
        scene = sample_scene(seed)
        true, _ = play(env, scene, NOTHING, 6)
        moved, _ = play(env, scene, Disturbance(seed=seed, position=0.02), 6)
        turned, _ = play(env, scene, Disturbance(seed=seed, attitude=np.radians(5.0)), 6)
        body = moved[:, SLICES["P_P"]] - true[:, SLICES["P_P"]]
        error = body[:, :3]
        goals = (moved - true)[:, SLICES["P_G"]].reshape(len(true), 6, 3)
        # Along the ground: targets are never lower than 3 cm above it.
        assert goals[..., :2] == pytest.approx(np.repeat(error[:, None, :2], 6, axis=1), abs=1e-5)
        assert body[:, 15:] == pytest.approx(np.tile(error, 13), abs=1e-5) and not body[:, 3:15].any()
        errors.append(error)
        front = np.einsum("ij,ij->i", turned[:, SLICES["P_P"]][:, 3:6], true[:, SLICES["P_P"]][:, 3:6])
        turns.append(np.arccos(np.clip(front, -1, 1)))
        assert np.array_equal(moved[:, SLICES["P_A"]], true[:, SLICES["P_A"]]), "the robot's own sensors are right"
    assert np.std(errors) == pytest.approx(0.02, rel=0.12)
    between, within = np.mean(errors, axis=1), np.array(errors) - np.mean(errors, axis=1, keepdims=True)
    assert between.var() == pytest.approx(within.var(), rel=0.6), "half of it stays, half is drawn in each step"
    # An axis turns about the two others, so that its mean square is twice that about one of them.
    assert np.degrees(np.sqrt(np.mean(np.square(turns)) / 2)) == pytest.approx(5.0, rel=0.15)


def test_rocks_are_off_by_what_stays(env: DisturbedEnv) -> None:
    scene = next(s for s in map(sample_scene, range(SEED, SEED + 50)) if 2 <= len(s.rocks) <= 5)
    true, _ = play(env, scene, NOTHING, 3)
    seen, _ = play(env, scene, Disturbance(seed=1, position=0.05), 3)
    rocks = (seen - true)[:, SLICES["P_E"]].reshape(4, 7, 5)
    there = len(scene.rocks)
    assert rocks[:, :there, :3] == pytest.approx(np.broadcast_to(rocks[0, 0, :3], (4, there, 3)), abs=1e-6)
    assert np.linalg.norm(rocks[0, 0, :3]) > 0.01 and not rocks[:, there:].any() and not rocks[..., 3:].any()


def test_stale_poses_are_so_old_and_dropped_ones_stay(env: DisturbedEnv) -> None:
    scene = sample_scene(SEED + 4)
    true, _ = play(env, scene, NOTHING, 40)
    old, _ = play(env, scene, Disturbance(age=3), 40)
    where = SLICES["P_P"]
    assert np.array_equal(old[3:, where], true[:-3, where]) and np.array_equal(old[:3, where], true[[0] * 3, where])
    dropped, _ = play(env, scene, Disturbance(seed=3, dropped=0.6), 40)
    moves = [i for i in range(1, 41) if not np.array_equal(true[i, where], true[i - 1, where])]
    kept = [np.array_equal(dropped[i, where], dropped[i - 1, where]) for i in moves]
    assert len(moves) > 20 and 0.3 < np.mean(kept) < 0.9
    assert all(any(np.array_equal(row[where], now) for now in true[:, where]) for row in dropped)


# -- what is done ------------------------------------------------------------------------------------------------------
def test_actions_come_late_and_the_robot_knows_what_it_asked_for(env: DisturbedEnv) -> None:
    scene = sample_scene(SEED)
    late, _ = play(env, scene, Disturbance(delay=2), 10)
    env.reset_flat(options={"scene": scene, "disturbance": NOTHING})
    asked = [*np.zeros((2, 11), np.float32), *actions(scene, 10)]
    for step in range(10):
        seen, *_ = env.step_flat(asked[step])
        assert np.array_equal(seen[SLICES["P_A"]], late[step + 1, SLICES["P_A"]])
        assert np.allclose(late[step + 1, SLICES["a_prev"]], asked[step + 2])


def test_a_joint_sticks_for_its_time_and_no_other_does(env: DisturbedEnv) -> None:
    scene = sample_scene(SEED)
    env.reset_flat(options={"scene": scene, "disturbance": Disturbance(stuck=(2, 5, 20))})
    angles = []
    for step in range(40):
        env.step_flat(np.full(11, 0.5 if step % 20 < 10 else -0.5, np.float32))
        angles.append(env.episode.robot.angles)
    changes = np.abs(np.diff(np.degrees(angles), axis=0))
    assert changes[6:23, 2].max() < 1.0 < 3.0 < min(changes[:4, 2].max(), changes[26:, 2].max())
    assert changes[6:23, 7].max() > 3.0, "the same joint of the other arm moves"


@pytest.mark.parametrize("simulator", list(SIMULATORS))
def test_gains_and_torques_reach_the_motors(simulator: str) -> None:
    pytest.importorskip(simulator)
    scene, env = sample_scene(SEED), DisturbedEnv(simulator=simulator)
    moved, torques = {}, {}
    cases = {"right": NOTHING, "slow": Disturbance(gains=(0.5,) * 11), "weak": Disturbance(torque=(0.01,) * 11)}
    for name, what in cases.items():
        env.reset_flat(options={"scene": scene, "disturbance": what})
        before = env.episode.robot.angles
        env.step_flat(np.full(11, 0.3, np.float32))
        moved[name] = np.degrees(np.abs(env.episode.robot.angles - before))[2]
        torques[name] = np.abs(env.episode.robot.torques / env.robot.torque_limits).max()
    # A gain of 10 /s makes good 1 - exp(-1) of a set-point in 0.1 s, half of it 1 - exp(-0.5): 0.63 and 0.39.
    assert moved["slow"] / moved["right"] == pytest.approx(0.62, abs=0.05)
    assert torques["weak"] < 0.0101 < 0.011 < torques["right"]
    env.close()


# -- what is there -----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("simulator", list(SIMULATORS))
def test_a_payload_moves_the_weight_and_nothing_that_is_seen(simulator: str) -> None:
    """Potential energy along any direction tells where a body's centre of gravity is: m g times its shift."""
    pytest.importorskip(simulator)
    env, scene = DisturbedEnv(simulator=simulator), sample_scene(SEED + 2)
    energies, seen = [], []
    for shift in (None, (0.0, 0.0, 0.1), (0.03, 0.0, 0.0)):
        seen.append(env.reset_flat(options={"scene": scene, "disturbance": Disturbance(offset=shift)})[0])
        body = env.episode.body
        energies.append([env.simulation.energy([env.episode.astronaut.handle], body.rotation[:, i]) for i in (0, 2)])
    gained = np.array(energies[1:]) - energies[0]
    weight = scene.mass * 1.62
    assert gained == pytest.approx(np.array([[0.0, 0.1 * weight], [0.03 * weight, 0.0]]), abs=0.01)
    assert seen[1] == pytest.approx(seen[0], abs=1e-5) and seen[2] == pytest.approx(seen[0], abs=1e-5)
    env.close()


def test_a_payload_rolls_nobody_over(env: DisturbedEnv) -> None:
    for seed in range(SEED, SEED + 12):
        scene = sample_scene(seed)
        env.reset_flat(options={"scene": scene, "disturbance": disturbance(scene, "payload", "high")})
        before = env.episode.body.rotation
        for _ in range(15):
            env.step_flat(np.zeros(11, np.float32))
        turned = np.degrees(np.arccos(np.clip((np.trace(before.T @ env.episode.body.rotation) - 1) / 2, -1, 1)))
        assert turned < 10.0, scene.posture


def test_an_unseen_rock_is_in_the_world_alone(env: DisturbedEnv) -> None:
    found = 0
    for seed in range(SEED, SEED + 30):
        scene = sample_scene(seed)
        what = disturbance(scene, "unseen_rock", "middle")
        true, _ = play(env, scene, NOTHING, 1)
        seen, _ = play(env, scene, what, 1)
        world = env.episode.scene
        if what.unseen is None:
            assert np.array_equal(seen, true)
            continue
        found += 1
        assert what.unseen in world.rocks and len(env.episode.rocks) == len(world.rocks)
        if len(scene.rocks) < 7:
            assert np.array_equal(seen[0], true[0]) and what.unseen.diameter == 0.15
            assert set(world.rocks) - set(scene.rocks) == {what.unseen}
        else:
            rows = seen[0, SLICES["P_E"]].reshape(7, 5)
            assert world == scene and rows[:, 4].sum() == 6
    assert found >= 25


def test_randomised_episodes_stay_within_their_ranges(env: DisturbedEnv) -> None:
    drawn = [randomised(sample_scene(seed)) for seed in range(300)]
    assert len(set(drawn)) == 300 and drawn[7] == randomised(sample_scene(7))
    for low, high, values in (
        (0.8, 1.2, [d.friction for d in drawn]),
        (0.85, 1.15, [d.mass for d in drawn]),
        (-0.05, 0.05, [d.offset[2] for d in drawn if d.offset]),
        (0.8, 1.2, [gain for d in drawn for gain in d.gains]),
        (20, 100, [d.solver.iterations for d in drawn if d.solver]),
    ):
        assert low <= min(values) < low + 0.05 * (high - low) and high - 0.05 * (high - low) < max(values) <= high
    assert {d.delay for d in drawn} == {0, 1}
    assert {d.solver.substep for d in drawn if d.solver} == {0.005, 0.01}
    for seed in range(20):
        scene = sample_scene(seed)
        env.reset_flat(options={"scene": scene, "disturbance": randomised(scene)})
        assert MASS_RANGE[0] <= env.episode.scene.mass <= MASS_RANGE[1]
        assert env.simulation.friction == scene.friction * randomised(scene).friction
        assert env.simulation.settings == randomised(scene).solver
    env.reset_flat(options={"scene": scene})
    assert env.simulation.settings == SIMULATORS["pybullet"], "the next episode is as usual again"


def test_errors_grow_with_severity() -> None:
    for seed in range(SEED, SEED + 5):
        scene = sample_scene(seed)
        torques = [disturbance(scene, "torque", s).torque for s in SEVERITIES]
        assert all(a >= b for first, second in pairwise(torques) for a, b in zip(first, second, strict=True))
        offsets = [disturbance(scene, "payload", s).offset for s in SEVERITIES]
        assert [abs(o[2]) for o in offsets if o] == pytest.approx([0.02, 0.05, 0.10])
        assert len({np.sign(o[2]) for o in offsets if o}) == 1


# -- trainings ---------------------------------------------------------------------------------------------------------
def rollout(randomise: bool) -> Array:
    """Return the rewards (30, 2) of two training environments that hold a fixed action, two thirds of them moving."""
    venv = WorkerVecEnv(2, 0, EnvOptions({"max_steps": 15}, randomise=randomise), workers=1)
    try:
        venv.reset()
        action = np.tile(np.linspace(-0.5, 0.5, 11, dtype=np.float32), (2, 1))
        return np.array([venv.step(action)[1] for _ in range(30)])
    finally:
        venv.close()


@pytest.mark.process
def test_training_episodes_are_randomised_where_asked_for_and_repeat() -> None:
    plain, randomised_once, again = rollout(False), rollout(True), rollout(True)
    assert np.array_equal(randomised_once, again)
    assert (plain[:15] != randomised_once[:15]).any(axis=0).all(), "the first episode of each"
    assert (plain[15:] != randomised_once[15:]).any(axis=0).all(), "and the second"


def test_randomising_is_a_prior_that_is_off_and_needs_episodes(tmp_path: Path) -> None:
    for name, method in METHODS.items():
        if method.learns:
            assert all(method.config(preset).priors.randomise is False for preset in PRESETS), name
    refused = call("train", "ppo_lstm_demos", "--preset", "smoke", "--randomise", "--out", str(tmp_path / "run"))
    assert refused.code == 2 and "priors.randomise" in refused.complaint and not (tmp_path / "run").exists()
