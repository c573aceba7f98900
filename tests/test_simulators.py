"""Two engines behind one interface: MuJoCo does what is asked of PyBullet, and both do what hand calculation says."""

from __future__ import annotations

import hashlib
import subprocess
import sys
import warnings
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check
from stable_baselines3.common.env_checker import check_env as sb3_check

import lunar_rescue
from lunar_rescue import LunarRescueEnv, Scene, sample_scene
from lunar_rescue.physics import engines
from lunar_rescue.physics.engines import SIMULATORS, make_simulation
from lunar_rescue.physics.robot import JOINTS
from lunar_rescue.physics.simulation import LUNAR_GRAVITY, Simulation
from lunar_rescue.physics.solver import POSITION_GAIN_PER_SECOND, SETTINGS
from lunar_rescue.scenes.postures import postures
from lunar_rescue.scenes.splits import TEST, TRAIN
from reproduce.baselines.planner.approach import CollisionChecker
from reproduce.baselines.scripted import ScriptedPolicy
from reproduce.experiments.hand_calculation import Measured, carry, slide, tip

SCENES = [TEST.start, TEST.start + 3, TEST.start + 5]
#: By how much of a closed solution an engine may be off. PyBullet's torques jitter; what slides in MuJoCo is lifted a
#: little by the contact model's convex form and hops, so that it meets a few per cent less friction.
SLIDING, TIPPING = {"pybullet": 0.01, "mujoco": 0.06}, {"pybullet": 0.01, "mujoco": 0.03}
CARRYING = {"pybullet": 0.005, "mujoco": 0.001}


@pytest.fixture(scope="module", params=list(SIMULATORS))
def simulator(request: Any) -> str:
    pytest.importorskip(request.param)
    return str(request.param)


@pytest.fixture
def simulation(simulator: str) -> Iterator[Simulation]:
    made = make_simulation(simulator)
    yield made
    made.close()


@pytest.fixture(scope="module")
def mujoco_env() -> Iterator[LunarRescueEnv]:
    pytest.importorskip("mujoco")
    made = LunarRescueEnv(simulator="mujoco")
    yield made
    made.close()


# -- closed solutions --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("friction", "slope"), [(0.7, 45.0), (0.9, 45.0), (0.7, 40.0)])
def test_who_slides_meets_coulombs_friction(
    simulation: Simulation, simulator: str, friction: float, slope: float
) -> None:
    measured = slide(simulation, friction, slope)
    assert measured.expected == friction
    assert abs(measured.error) < SLIDING[simulator]


@pytest.mark.parametrize("slope", [30.0, 34.0])
def test_nobody_slides_on_less_than_the_friction_angle(simulation: Simulation, slope: float) -> None:
    """The friction angle of 0.7 is 35 degrees: at rest, the slope's tangent is all the friction that shows."""
    assert slide(simulation, 0.7, slope).value == pytest.approx(np.tan(np.radians(slope)), abs=1e-3)


def test_who_tips_does_so_where_the_weight_leaves_the_edge(simulation: Simulation, simulator: str) -> None:
    measured = tip(simulation, 0.9)
    assert measured.expected == pytest.approx(23.5, abs=0.1)  # atan of (0.110 + 0.005) m over 0.264 m
    assert abs(measured.error) < TIPPING[simulator]


@pytest.mark.process
def test_the_waist_bears_the_moment_of_all_weights(simulator: str) -> None:
    env, found = LunarRescueEnv(simulator=simulator), list[Measured]()
    for seed in range(13):
        if rescue(env, sample_scene(seed, task="lift")):
            found += filter(None, [carry(env)])
    env.close()
    assert len(found) >= 3
    assert all(abs(measured.expected) > 100.0 for measured in found)  # N m: the body is on the arms
    assert max(abs(measured.error) for measured in found) < CARRYING[simulator]


def rescue(env: LunarRescueEnv, scene: Scene) -> bool:
    """Let the script try a scene; tell whether it succeeded."""
    observation, _ = env.reset_flat(options={"scene": scene})
    policy, start, done, info = ScriptedPolicy(), np.array([True]), False, dict[str, Any]()
    while not done:
        observation, _, terminated, truncated, info = env.step_flat(policy.act(observation[None], start)[0])
        start, done = np.array([False]), terminated or truncated
    return bool(info["is_success"])


# -- motors --------------------------------------------------------------------------------------------------------
def test_a_motor_makes_good_the_same_share_of_an_error_in_either_engine(simulator: str) -> None:
    """The error falls by exp(-10 t), in as many steps as there are substeps."""
    env = LunarRescueEnv(simulator=simulator)
    env.reset_flat(options={"scene": replace(sample_scene(1), rocks=())})
    action = np.zeros(JOINTS)
    action[0], action[10] = -0.05, 0.05  # 3 degrees of A's shoulder and the waist
    wanted = env.robot.joint_targets(action)
    before = wanted - env.episode.robot.angles
    env.step_flat(action)
    left = (wanted - env.episode.robot.angles)[[0, 10]] / before[[0, 10]]
    substep = env.simulation.pace.substep
    assert left == pytest.approx((1.0 - POSITION_GAIN_PER_SECOND * substep) ** round(0.1 / substep), abs=0.03)
    env.close()


def test_mujocos_motors_exert_what_they_say_and_never_more_than_their_limits(mujoco_env: LunarRescueEnv) -> None:
    """Torques that are told are those of the equations of motion, M a + bias = torques + contacts, in each substep."""
    import mujoco

    env, rng = mujoco_env, np.random.default_rng(0)
    env.reset_flat(options={"scene": sample_scene(1)})
    world: Any = env.simulation._compiled()  # type: ignore[attr-defined]
    model, data, limits = world.model, world.data, env.robot.torque_limits
    places = [world.speeds[i] for i in env.robot._joints]
    at_limit, total, step = 0, np.zeros(model.nv), model.opt.timestep
    for _ in range(40):
        env.robot.drive(rng.uniform(-1, 1, JOINTS), env.robot.state().angles)
        for _ in range(10):
            before = data.qvel.copy()
            env.simulation.advance(1)
            if np.abs(data.qvel[places]).max() >= 1.5 - 1e-9:
                continue  # the speed limit took something away besides
            mujoco.mj_mulM(model, data, total, (data.qvel - before) / step)
            exerted = total + data.qfrc_bias - data.qfrc_constraint + model.dof_damping * data.qvel
            torques = env.robot.state().torques
            assert exerted[places] == pytest.approx(torques, abs=1.0)  # N m
            assert np.all(np.abs(torques) <= limits * (1 + 1e-9))
            at_limit += int(np.sum(np.abs(torques) > 0.999 * limits))
    assert at_limit > 50


# -- geometry ------------------------------------------------------------------------------------------------------
def test_both_engines_build_the_same_scene() -> None:
    pytest.importorskip("mujoco")
    both = [LunarRescueEnv(simulator=name) for name in SIMULATORS]
    for seed in range(8):
        scene = sample_scene(seed)
        first, second = (env.reset_flat(options={"scene": scene})[0] for env in both)
        assert first == pytest.approx(second, abs=1e-5)
    for env in both:
        env.close()


def test_both_engines_find_the_same_collisions() -> None:
    """Random arms against body, rocks and ground: as free, but for touches of a few millimetres."""
    pytest.importorskip("mujoco")
    rng, agree, hits = np.random.default_rng(0), 0, 0
    checkers = [CollisionChecker(LunarRescueEnv(simulator=name)) for name in SIMULATORS]
    for seed in (1, 7):
        for checker in checkers:
            checker.set_scene(sample_scene(seed))
        robot = checkers[0]._env.robot
        for _ in range(100):
            angles = rng.uniform(np.maximum(robot.lower, -1.5), np.minimum(robot.upper, 1.5))
            first, second = (checker.free(angles) for checker in checkers)
            agree, hits = agree + (first == second), hits + (not first)
    for checker in checkers:
        checker.close()
    assert 40 < hits < 180
    assert agree >= 195


def test_friction_between_all_surfaces_is_that_of_the_scene(mujoco_env: LunarRescueEnv) -> None:
    """MuJoCo takes the larger of two coefficients, so each surface has the scene's; the base has one of its own."""
    scene = next(s for s in map(sample_scene, range(50)) if s.terrain.rough and s.rocks)
    mujoco_env.reset_flat(options={"scene": scene})
    world: Any = mujoco_env.simulation._compiled()  # type: ignore[attr-defined]
    base = (world.owners[:, 0] == mujoco_env.robot.handle) & (world.owners[:, 1] == -1)
    assert base.sum() == 1 and world.model.geom_priority[base] == [1]
    assert world.model.geom_friction[~base, 0] == pytest.approx(scene.friction)
    assert world.model.geom_friction[base, 0] == pytest.approx(0.5 * scene.friction**0.5)
    suit = world.owners[:, 0] == mujoco_env.episode.astronaut.handle
    assert suit.sum() == 15 and set(world.model.geom_condim[suit]) == {6}


# -- repetition ----------------------------------------------------------------------------------------------------
def digests() -> list[str]:
    """Of everything that whole rescues by the script show in MuJoCo."""
    env, found = LunarRescueEnv(simulator="mujoco"), []
    for seed in SCENES:
        hashed, policy, start, done = hashlib.sha256(), ScriptedPolicy(), np.array([True]), False
        observation, _ = env.reset_flat(options={"scene": sample_scene(seed)})
        while not done:
            action = policy.act(observation[None], start)[0]
            observation, reward, terminated, truncated, _ = env.step_flat(action)
            hashed.update(observation.tobytes() + np.float64(reward).tobytes())
            start, done = np.array([False]), terminated or truncated
        found.append(hashed.hexdigest())
    env.close()
    return found


@pytest.mark.process
def test_mujoco_repeats_after_other_episodes(mujoco_env: LunarRescueEnv) -> None:
    def flail(env: LunarRescueEnv, seed: int) -> list[bytes]:
        rng, seen, done = np.random.default_rng(seed), [env.reset_flat(TRAIN.start + seed)[0].tobytes()], False
        while not done:
            observation, _, terminated, truncated, _ = env.step_flat(rng.uniform(-1, 1, JOINTS))
            seen.append(observation.tobytes())
            done = terminated or truncated
        return seen

    first = flail(mujoco_env, 3)
    flail(mujoco_env, 4)
    assert flail(mujoco_env, 3) == first
    fresh = LunarRescueEnv(simulator="mujoco")
    assert flail(fresh, 3) == first
    fresh.close()


@pytest.mark.process
def test_mujoco_repeats_in_another_process() -> None:
    pytest.importorskip("mujoco")
    code = "import sys; sys.path.insert(0, 'tests'); from test_simulators import digests; print(*digests())"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.split()[-len(SCENES) :] == digests()


# -- the environment -----------------------------------------------------------------------------------------------
@pytest.mark.process
def test_checkers_pass_in_mujoco_without_warnings() -> None:
    pytest.importorskip("mujoco")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make(lunar_rescue.MUJOCO_ENV_ID, render_mode="rgb_array")
        assert type(env.unwrapped.simulation).__name__ == "MujocoSimulation"  # type: ignore[attr-defined]
        gymnasium_check(env.unwrapped, skip_render_check=False)
        sb3_check(env.unwrapped, warn=True)
        env.close()


def test_without_mujoco_one_line_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engines, "find_spec", lambda name: None if name == "mujoco" else object())
    with pytest.raises(gymnasium.error.DependencyNotInstalled, match="pip install mujoco"):
        LunarRescueEnv(simulator="mujoco")
    LunarRescueEnv().close()


def test_an_unknown_simulator_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match=r"simulator: expected one of pybullet, mujoco; got 'bullet'"):
        LunarRescueEnv(simulator="bullet")


def test_nothing_imports_mujoco_unless_it_is_asked_for() -> None:
    code = "import sys, lunar_rescue; lunar_rescue.LunarRescueEnv().close(); print('mujoco' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "False"


def test_bodies_weigh_what_the_scene_says_in_either_engine(simulation: Simulation) -> None:
    """A dropped body has half m v^2 of what it lost, and the energy that is told is that of its mass."""
    body = simulation.add_suit(postures()["prone_crawl"].limbs, 200.0)
    simulation.place(body.handle, np.array([0.0, 0.0, 5.0]), np.array([0.0, 0.0, 0.0, 1.0]))
    up = np.array([0.0, 0.0, 1.0])
    assert simulation.energy([body.handle], up) == pytest.approx(200.0 * LUNAR_GRAVITY * 5.0)
    simulation.advance_by(1.0)
    assert simulation.energy([body.handle], up) == pytest.approx(200.0 * LUNAR_GRAVITY * 5.0, rel=0.01)
    assert simulation.velocity(body)[0][2] == pytest.approx(-LUNAR_GRAVITY, rel=1e-3)


def test_the_first_simulator_is_the_one_that_everything_else_was_made_with() -> None:
    assert next(iter(SIMULATORS)) == engines.DEFAULT == "pybullet"
    assert SIMULATORS["pybullet"] == SETTINGS
