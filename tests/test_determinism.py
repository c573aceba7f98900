"""The same seed gives the same trajectory bit for bit, wherever and after whatever it is played."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from lunar_rescue import LunarRescueEnv, Scene, sample_scene
from lunar_rescue.physics import bodies
from lunar_rescue.physics.robot import JOINTS
from lunar_rescue.scenes.splits import HELDOUT, TEST, TRAIN
from reproduce.baselines.scripted import ScriptedPolicy
from reproduce.learning.worker_process import train_seed
from reproduce.learning.workers import WorkerVecEnv

SCENES = [*range(TEST.start, TEST.start + 8), HELDOUT.start, HELDOUT.start + 1]

#: Episodes that were not the same after the one before them, when robot links that had met stayed in Bullet's cache.
SELF_TOUCHING = (39, 138, 183)


def digest(env: LunarRescueEnv, scene: Scene) -> str:
    """Of everything that a whole scripted rescue shows: contacts with body, ground and rocks included."""
    hashed, policy = hashlib.sha256(), ScriptedPolicy()
    observation, _ = env.reset_flat(options={"scene": scene})
    start, done = np.array([True]), False
    while not done:
        hashed.update(observation.tobytes())
        observation, reward, terminated, truncated, info = env.step_flat(policy.act(observation[None], start)[0])
        hashed.update(np.float64(reward).tobytes() + repr(info["reward_terms"]).encode())
        start, done = np.array([False]), terminated or truncated
    return hashed.hexdigest()


def digests() -> list[str]:
    env = LunarRescueEnv()
    try:
        return [digest(env, sample_scene(seed)) for seed in SCENES]
    finally:
        env.close()


@pytest.fixture(scope="module")
def reference() -> list[str]:
    return digests()


def test_scenes_cover_both_grounds_tasks_and_splits() -> None:
    scenes = [sample_scene(seed) for seed in SCENES]
    assert {s.terrain.kind for s in scenes} == {"smooth", "rough"} and {s.task for s in scenes} == {"lift", "turn_over"}


@pytest.mark.process
def test_again_and_after_other_episodes(reference: list[str], env: LunarRescueEnv) -> None:
    assert [digest(env, sample_scene(seed)) for seed in reversed(SCENES)][::-1] == reference


def flailing(env: LunarRescueEnv, seed: int) -> list[bytes]:
    """All observations of an episode with arms that swing at random, into each other and the robot too."""
    rng, action = np.random.default_rng(seed), np.zeros(JOINTS)
    seen, done = [env.reset_flat(TRAIN.start + seed)[0].tobytes()], False
    while not done:
        action = np.clip(action + 0.2 * rng.standard_normal(JOINTS), -1.0, 1.0)
        observation, _, terminated, truncated, _ = env.step_flat(action.astype(np.float32))
        seen.append(observation.tobytes())
        done = terminated or truncated
    return seen


@pytest.mark.process
@pytest.mark.parametrize("seed", SELF_TOUCHING)
def test_arms_that_touched_each_other_leave_nothing_behind(seed: int, env: LunarRescueEnv) -> None:
    flailing(env, seed - 1)
    after = flailing(env, seed)
    fresh = LunarRescueEnv()
    try:
        assert after == flailing(fresh, seed)
    finally:
        fresh.close()


@pytest.mark.process
def test_in_another_process(reference: list[str]) -> None:
    code = "import sys; sys.path.insert(0, 'tests'); from test_determinism import digests; print(*digests())"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.split()[-len(SCENES) :] == reference


@pytest.mark.process
def test_from_json(reference: list[str], env: LunarRescueEnv) -> None:
    assert [digest(env, Scene.from_json(sample_scene(seed).to_json())) for seed in SCENES] == reference


@pytest.mark.process
def test_in_a_renewed_world(reference: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bodies, "WORLD_LIFE", 3)
    assert digests() == reference


@pytest.mark.process
def test_sixteen_environments_step_as_one_does() -> None:
    count, steps, run_seed = 16, 12, 5
    actions = np.random.default_rng(1).uniform(-1, 1, (steps, count, JOINTS)).astype(np.float32)
    venv = WorkerVecEnv(count, seed=run_seed)
    try:
        together: list[Any] = [venv.reset()]
        rewards = []
        for batch in actions:
            observations, reward, dones, _ = venv.step(batch)
            assert not dones.any()
            together.append(observations)
            rewards.append(reward)
    finally:
        venv.close()
    env = LunarRescueEnv()
    for index in range(count):
        vector, _ = env.reset_flat(train_seed(run_seed, index, 0, 0))
        assert np.array_equal(vector, together[0][index])
        for step in range(steps):
            vector, alone, *_ = env.step_flat(actions[step, index])
            assert np.array_equal(vector, together[step + 1][index])
            assert np.float32(alone) == rewards[step][index]
    env.close()
