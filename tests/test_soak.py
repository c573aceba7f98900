"""Random actions over all scenes: nothing raises, every number stays finite, memory stands still.

``results/soak.json`` is such a run of a million steps by an earlier command of this project.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields
from itertools import count, islice
from statistics import median
from typing import Any

import numpy as np
import psutil
import pytest
from numpy.typing import NDArray

from lunar_rescue import LunarRescueEnv, Scene, sample_scene
from lunar_rescue.observation import BOUND, SIZE, as_dict
from lunar_rescue.physics.robot import JOINTS
from lunar_rescue.scenes.scene import task_distribution
from lunar_rescue.scenes.splits import TRAIN
from lunar_rescue.scenes.terrain import KINDS

FIRST_SEED = 1_000_000_000  # of the scenes; the training split, where nothing is tested
STEPS = 150_000  # of the long run, some 1,370 scenes: the world is made anew twice, first before the middle
LONGEST_HOLD = 40  # steps for which an action may be held
LARGEST_GROWTH = 0.01  # of memory over the last half of the long run


def observation_fault(vector: Any) -> str:
    """Return what is wrong with a flat observation, or nothing."""
    if not isinstance(vector, np.ndarray) or vector.shape != (SIZE,) or vector.dtype != np.float32:
        return f"observation: expected float32 ({SIZE},), got {type(vector).__name__}"
    if not np.isfinite(vector).all():
        return f"observation: not finite at {np.flatnonzero(~np.isfinite(vector)).tolist()[:5]}"
    if np.abs(vector).max() > BOUND:
        return f"observation: beyond {BOUND:g} at {np.flatnonzero(np.abs(vector) > BOUND).tolist()[:5]}"
    return ""


def step_fault(env: LunarRescueEnv, vector: Any, reward: float) -> str:
    """Return what is wrong with reward, observation or the state of body or robot, or nothing."""
    if not math.isfinite(reward):
        return f"reward: {reward!r}"
    for name, state in (("body", env.episode.body), ("robot", env.episode.robot)):
        for part in fields(state):
            if not np.isfinite(getattr(state, part.name)).all():
                return f"{name} {part.name}: not finite"
    return observation_fault(vector)


def memory_growth(samples: Sequence[int]) -> float:
    """Return the median of the last tenth of the samples over that of those from 50 to 60 %, minus 1."""
    n = len(samples)
    return median(samples[n * 9 // 10 :]) / median(samples[n // 2 : n * 6 // 10]) - 1.0 if n >= 10 else 0.0


def random_actions(rng: np.random.Generator) -> Iterator[NDArray[np.float64]]:
    """Yield actions held for a while, so that the arms get somewhere; one stretch in four is noise."""
    while True:
        stretch, noise = int(rng.integers(1, LONGEST_HOLD + 1)), rng.random() < 0.25
        action = rng.uniform(-1, 1, JOINTS)
        for _ in range(stretch):
            yield action
            if noise:
                action = rng.uniform(-1, 1, JOINTS)


def all_scenes() -> Iterator[Scene]:
    """Yield scenes of all postures and tasks in turn."""
    pairs = task_distribution()
    for turn in count():
        posture, task = pairs[turn % len(pairs)]
        yield sample_scene(FIRST_SEED + turn, posture=posture, task=task)


def soak(env: LunarRescueEnv, steps: int, every: int = 0) -> tuple[Counter[tuple[str, str, str]], list[int]]:
    """Step through scenes; return how often each kind of scene was met, and memory each so many steps [bytes]."""
    actions, scenes = random_actions(np.random.default_rng(FIRST_SEED)), all_scenes()
    kinds: Counter[tuple[str, str, str]] = Counter()
    memory: list[int] = []
    done = True
    for step in range(steps):
        if done:
            scene = next(scenes)
            kinds[scene.posture, scene.task, scene.terrain.kind] += 1
            vector, _ = env.reset_flat(options={"scene": scene})
            assert env.observation_space.contains(as_dict(vector)), f"scene {scene.seed}: outside observation_space"
        vector, reward, terminated, truncated, _ = env.step_flat(next(actions))
        done = terminated or truncated
        fault = step_fault(env, vector, reward)
        assert not fault, f"step {step}, scene {scene.seed}: {fault}"
        if every and step % every == 0:
            memory.append(psutil.Process().memory_info().rss)
    return kinds, memory


@pytest.mark.process
def test_a_short_run_meets_many_scenes_and_no_fault(env: LunarRescueEnv) -> None:
    kinds, _ = soak(env, 3000)
    assert sum(kinds.values()) > 10
    assert len({posture for posture, _, _ in kinds}) > 10 and {task for _, task, _ in kinds} == {"lift", "turn_over"}


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_a_long_run_meets_every_kind_of_scene_and_memory_stands_still(env: LunarRescueEnv) -> None:
    """Kept shapes add memory until the world is first made anew; from then on it stands still."""
    kinds, memory = soak(env, STEPS, every=STEPS // 200)
    wanted = {(posture, task, terrain) for posture, task in task_distribution() for terrain in KINDS}
    assert sum(kinds.values()) >= 8 * len(wanted) and not wanted - set(kinds)
    assert memory_growth(memory) < LARGEST_GROWTH


def test_scenes_take_all_postures_and_tasks_and_no_seed_twice() -> None:
    pairs = task_distribution()
    scenes = list(islice(all_scenes(), len(pairs)))
    assert {(s.posture, s.task) for s in scenes} == set(pairs)
    seeds = [s.seed for s in scenes]
    assert len(set(seeds)) == len(seeds) and min(seeds) == FIRST_SEED
    assert all(seed in TRAIN for seed in seeds)


def test_actions_are_held_at_times_and_noise_at_others() -> None:
    actions = np.array(list(islice(random_actions(np.random.default_rng(0)), 1000)))
    held = (actions[1:] == actions[:-1]).all(axis=1).mean()
    assert 0.5 < held < 0.9 and np.abs(actions).max() <= 1


def test_growth_is_that_of_the_medians() -> None:
    assert memory_growth([1] * 50 + [100] * 10 + [7] * 30 + [103] * 9 + [10**9]) == pytest.approx(0.03)
    assert memory_growth([1, 2, 3]) == 0.0


@pytest.mark.parametrize(
    ("vector", "word"),
    [
        (np.zeros(SIZE, np.float32), ""),
        (np.full(SIZE, np.nan, np.float32), "not finite"),
        (np.full(SIZE, 1.01 * BOUND, np.float32), "beyond"),
        (np.zeros(SIZE), "float32"),
        (np.zeros(SIZE + 1, np.float32), "float32"),
        ([0.0] * SIZE, "float32"),
    ],
)
def test_observations_are_checked(vector: Any, word: str) -> None:
    fault = observation_fault(vector)
    assert word in fault and bool(fault) == bool(word)


def _spoil(env: LunarRescueEnv, monkeypatch: pytest.MonkeyPatch, how: str) -> None:
    step: Callable[..., Any] = env.step_flat
    calls = 0

    def spoilt(action: Any) -> Any:
        nonlocal calls
        calls += 1
        vector, reward, *rest = step(action)
        if calls == 30:
            if how == "raise":
                raise ArithmeticError("spoilt")
            if how == "observation":
                vector[3] = np.nan
            if how == "reward":
                reward = float("inf")
            if how == "body":
                env.episode.body.centre[2] = np.nan
        return vector, reward, *rest

    monkeypatch.setattr(env, "step_flat", spoilt)


@pytest.mark.parametrize(
    ("how", "word"),
    [("raise", "spoilt"), ("observation", "not finite at \\[3\\]"), ("reward", "inf"), ("body", "centre")],
)
def test_the_run_stops_at_the_first_fault(
    env: LunarRescueEnv, monkeypatch: pytest.MonkeyPatch, how: str, word: str
) -> None:
    _spoil(env, monkeypatch, how)
    with pytest.raises((AssertionError, ArithmeticError), match=word):
        soak(env, 100)
