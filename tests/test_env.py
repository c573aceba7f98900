from __future__ import annotations

import copy
import math
import pickle
import warnings
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check
from gymnasium.wrappers import FlattenObservation
from numpy.typing import NDArray
from stable_baselines3.common.env_checker import check_env as sb3_check

import lunar_rescue
from lunar_rescue import LunarRescueEnv, Scene, rewards, sample_scene
from lunar_rescue.observation import ENTRIES, SIZE, SLICES
from lunar_rescue.pictures.rendering import Studio
from lunar_rescue.scenes.rocks import MAX_ROCKS
from lunar_rescue.scenes.scene import MASS_RANGE, task_distribution
from lunar_rescue.scenes.splits import SPLITS, TRAIN
from reproduce.baselines.scripted import ScriptedPolicy

Step = tuple[NDArray[np.float32], float]


def play(env: LunarRescueEnv, scene: Scene, steps: int = 60, seed: int = 5) -> list[Step]:
    rng = np.random.default_rng(seed)
    observation, _ = env.reset_flat(options={"scene": scene})
    history: list[Step] = [(observation, 0.0)]
    for _ in range(steps):
        observation, reward, terminated, truncated, _ = env.step_flat(rng.uniform(-1, 1, 11))
        history.append((observation, reward))
        if terminated or truncated:
            break
    return history


def same(first: list[Step], second: list[Step]) -> bool:
    return len(first) == len(second) and all(
        np.array_equal(a[0], b[0]) and a[1] == b[1] for a, b in zip(first, second, strict=True)
    )


def test_checkers_pass_without_warnings() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make("LunarRescue-v0", render_mode="rgb_array")
        gymnasium_check(env.unwrapped, skip_render_check=False)
        sb3_check(env.unwrapped, warn=True)
        env.close()


def test_render_returns_a_picture() -> None:
    env = gymnasium.make("LunarRescue-v0", render_mode="rgb_array")
    env.reset(seed=0)
    picture: Any = env.render()
    assert picture.ndim == 3 and picture.shape[2] == 3 and picture.dtype == np.uint8
    assert picture.std() > 10  # not one colour
    env.close()


@pytest.mark.process
@pytest.mark.parametrize(("posture", "task"), task_distribution())
def test_every_posture_and_task_steps(env: LunarRescueEnv, posture: str, task: str) -> None:
    rng = np.random.default_rng(1)
    space = env.observation_space
    observation, _ = env.reset(seed=3, options={"posture": posture, "task": task})
    for _ in range(200):
        assert space.contains(observation)
        observation, reward, terminated, truncated, info = env.step(rng.uniform(-1, 1, 11).astype(np.float32))
        assert math.isfinite(reward)
        assert sum(info["reward_terms"].values()) == pytest.approx(reward)
        if terminated or truncated:
            assert info["is_success"] or isinstance(info["failure"], str)
            observation, _ = env.reset(options={"posture": posture, "task": task})


@pytest.mark.process
def test_no_constant_observation() -> None:
    env = LunarRescueEnv()
    crowded = [s for s in map(sample_scene, range(1000)) if len(s.rocks) == MAX_ROCKS][:3]
    scenes = [sample_scene(s) for s in range(150)] + crowded
    seen = np.concatenate([[o for o, _ in play(env, scene, 15)] for scene in scenes])
    constant = np.flatnonzero(seen.std(axis=0) == 0)
    env.close()
    # Only the flag of process 2 stays 0: random actions do not get both arms under (the scripted tests do).
    assert [int(i) for i in constant] == [SLICES["phase"].start]


def test_starts_are_random_and_seeded(env: LunarRescueEnv) -> None:
    a, _ = env.reset_flat(seed=11)
    b, _ = env.reset_flat(seed=12)
    c, _ = env.reset_flat(seed=11)
    assert np.array_equal(a, c) and not np.array_equal(a, b)
    other = LunarRescueEnv()
    drawn = []
    for made in (env, other):  # a seed also decides about the unseeded episodes after it
        made.reset_flat(seed=5)
        drawn.append(made.reset_flat()[1]["scene"])
    other.close()
    assert drawn[0] == drawn[1] and drawn[0].seed in TRAIN


def test_a_seed_alone_is_a_training_scene_and_a_split_is_asked_for_by_name(env: LunarRescueEnv) -> None:
    for seed in (0, 7, 2_000_000_000, 2_030_000_005):
        assert env.reset_flat(seed=seed)[1]["scene"].seed == seed % 2_000_000_000
    first = {name: env.reset_flat(seed=0, options={"split": name})[1]["scene"].seed for name in SPLITS}
    assert first == {
        "train": 0,
        "validation": 2_000_000_000,
        "validation-heldout": 2_010_000_000,
        "test": 2_020_000_000,
        "heldout": 2_030_000_000,
    }
    assert env.reset_flat(options={"split": "test"})[1]["scene"].seed in SPLITS["test"]


def test_what_the_body_felt_is_told(env: LunarRescueEnv) -> None:
    """A body at rest feels nothing; one that is pushed feels what moved it, and the peaks stay."""
    scene = sample_scene(7, posture="prone_straight", task="lift")
    env.reset_flat(options={"scene": scene})
    info = env.step_flat(np.zeros(11))[4]
    assert info["gentle"] and info["peak_force"] == 0.0 and info["peak_speed"] < 0.02
    policy, start, done, peaks = ScriptedPolicy(), np.array([True]), False, []
    observation, _ = env.reset_flat(options={"scene": scene})
    while not done:
        observation, _, terminated, truncated, info = env.step_flat(policy.act(observation[None], start)[0])
        start, done = np.array([False]), terminated or truncated
        peaks.append([info[key] for key in ("peak_force", "peak_speed", "peak_acceleration")])
        assert info["gentle"] == (peaks[-1][0] <= 806.0 and peaks[-1][1] <= 1.0 and peaks[-1][2] <= 4.9)
    assert np.all(np.diff(peaks, axis=0) >= 0)
    assert peaks[-1][0] > 50.0 and 0.1 < peaks[-1][1] < 5.0


def test_nothing_overlaps_at_the_start(env: LunarRescueEnv) -> None:
    deepest = 0.0
    for seed in range(150):
        env.reset_flat(options={"scene": sample_scene(seed)})
        e = env.episode
        grounds = [handle for handle in (env.simulation.ground, env.simulation.relief) if handle is not None]
        for other in (e.astronaut.handle, *e.rocks, *grounds):
            deepest = max(deepest, env.simulation.penetration(env.robot.handle, other))
        for rock in e.rocks:
            deepest = max(deepest, env.simulation.penetration(e.astronaut.handle, rock))
    assert deepest < 0.01  # m


def test_observation_layout(env: LunarRescueEnv) -> None:
    observation, _ = env.reset(seed=0)
    assert list(observation) == [entry.key for entry in ENTRIES]
    flat, _ = env.reset_flat(seed=0)
    assert flat.shape == (SIZE,)
    assert np.array_equal(np.concatenate([observation[e.key] for e in ENTRIES]), flat)


def test_contact_reward_replaces_the_aapf_term_and_nothing_else() -> None:
    scene = next(s for s in map(sample_scene, range(100)) if s.rocks)
    plain, ablated = LunarRescueEnv(), LunarRescueEnv(obstacle_reward="contact")
    for e in (plain, ablated):
        e.reset_flat(options={"scene": scene})
    for _ in range(5):
        action = np.zeros(11)
        *_, first = plain.step_flat(action)
        *_, second = ablated.step_flat(action)
        terms, others = first["reward_terms"], second["reward_terms"]
        assert terms.pop("obstacle_avoidance") <= 0
        assert others.pop("obstacle_avoidance") == 0.0  # as little as the AAPF far from rocks
        assert terms == others
    plain.close()
    ablated.close()


@pytest.mark.process  # the beginnings of a hundred rescues take seconds
def test_coming_near_a_rock_costs_and_the_number_of_rocks_does_not(env: LunarRescueEnv) -> None:
    """The manipulation check of the ablation: what AAPF changes is nearness, and by as much as a step can feel."""
    approach, terms, rocks = [], [], []
    for scene in map(sample_scene, range(1000, 1100)):
        observation, _ = env.reset_flat(options={"scene": scene})
        policy, start, done, own = ScriptedPolicy(), np.array([True]), False, []
        while not done and env.episode.steps < 40:  # by then arms are under the body or have met rocks
            observation, _, terminated, truncated, info = env.step_flat(policy.act(observation[None], start)[0])
            start, done = np.array([False]), terminated or truncated
            approach.append(abs(info["reward_terms"]["approach"]))
            own.append(info["aapf"])
        terms.append(np.mean(own))
        rocks.append(len(scene.rocks))
    weights = env.weights
    joints = np.full((12, 5), 0.4)
    near = joints.copy()
    near[3, 2] = 0.05
    cost = [
        rewards.obstacle_avoidance(d[d < weights.influence], rho=weights.rho, xi=weights.xi) for d in (joints, near)
    ]
    assert cost[0] == 0.0 and -cost[1] > 0.2 * np.mean(approach)
    assert abs(np.corrcoef(rocks, terms)[0, 1]) < 0.3
    assert np.std(terms) > 0


def test_the_nearest_mark_point_of_an_episode_is_remembered(env: LunarRescueEnv) -> None:
    rocks, none = (next(s for s in map(sample_scene, range(100)) if bool(s.rocks) is some) for some in (True, False))
    env.reset_flat(options={"scene": none})
    env.step_flat(np.ones(11))
    assert env.episode.nearest_mark == math.inf
    env.reset_flat(options={"scene": rocks})
    seen = []
    for _ in range(8):
        env.step_flat(np.ones(11))
        points, marks = env.episode.robot.points, env.episode.marks
        seen.append(min(float(np.linalg.norm(point - mark)) for point in points for mark in marks))
    assert env.episode.nearest_mark == pytest.approx(min(seen), abs=1e-6) and max(seen) > min(seen)


def test_time_limit() -> None:
    env = LunarRescueEnv(max_steps=3)
    env.reset_flat(seed=0)
    ends = [env.step_flat(np.zeros(11)) for _ in range(3)]
    assert [e[2] for e in ends] == [False, False, True]  # terminal, as time is observed
    assert not any(e[3] for e in ends)
    assert ends[-1][4]["failure"] == "timeout"
    env.close()


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda e: e.reset(options={"scne": 1}), "scne"),
        (lambda e: e.reset(options={"scene": "x"}), "Scene"),
        (lambda e: e.reset(options={"posture": "x"}), "posture"),
        (lambda e: e.reset(options={"split": "tset"}), "split.*validation-heldout"),
        (lambda e: e.reset(options={"scene": sample_scene(0), "split": "train"}), "split"),
        (lambda e: e.step(np.zeros(3, np.float32)), "action"),
        (lambda e: e.step(np.full(11, np.nan, np.float32)), "action"),
    ],
)
def test_bad_calls_are_refused_by_name(env: LunarRescueEnv, call: Any, words: str) -> None:
    env.reset_flat(seed=0)
    with pytest.raises(ValueError, match=words):
        call(env)


def test_bad_constructions_and_order() -> None:
    with pytest.raises(ValueError, match="render_mode"):
        LunarRescueEnv(render_mode="ansi")
    with pytest.raises(ValueError, match="obstacle_reward"):
        LunarRescueEnv(obstacle_reward="none")
    with pytest.raises(ValueError, match="max_steps"):
        LunarRescueEnv(max_steps=0)
    env = LunarRescueEnv()
    with pytest.raises(RuntimeError, match="reset"):
        env.step(np.zeros(11, np.float32))
    env.close()


def test_each_name_has_its_own_scenes() -> None:
    seen: dict[str, set[tuple[str, str, int, float]]] = {}
    for name in lunar_rescue.ENVIRONMENTS:
        env = gymnasium.make(name, max_episode_steps=3)
        scenes = [env.reset(seed=seed, options={"split": "validation"})[1]["scene"] for seed in range(6)]
        seen[name] = {(s.task, s.posture, len(s.rocks), s.mass) for s in scenes}
        if name in ("LunarRescue-v0", "LunarRescueTurnOver-v0"):
            assert env.reset(options={"posture": "left_side_stride"})[1]["posture"] == "left_side_stride"
        scene = sample_scene(3, task="turn_over")
        assert env.reset(options={"scene": scene})[1]["scene"] is scene
        env.close()
    assert {task for task, *_ in seen["LunarRescueLift-v0"]} == {"lift"}
    assert {task for task, *_ in seen["LunarRescueTurnOver-v0"]} == {"turn_over"}
    assert {(posture, rocks, mass) for _, posture, rocks, mass in seen["LunarRescueEasy-v0"]} == {
        ("left_side_stride", 0, MASS_RANGE[0])
    }
    assert len({posture for _, posture, *_ in seen["LunarRescue-v0"]}) > 2 and lunar_rescue.ENV_ID in seen
    with pytest.raises(ValueError, match="easy scenes have a posture of their own"):
        LunarRescueEnv(scenes={"easy": True}).reset(options={"task": "lift"})


@pytest.mark.parametrize("copied", [copy.deepcopy, pickle.dumps], ids=["deepcopy", "pickle"])
@pytest.mark.parametrize("of", ["env", "simulation", "robot", "episode", "studio"])
def test_nothing_that_holds_a_world_is_copied(copied: Callable[[Any], Any], of: str) -> None:
    env = LunarRescueEnv(render_mode="rgb_array")
    env.reset_flat(seed=0)
    before = env.step_flat(np.zeros(11))[0]
    holder = {
        "env": env,
        "simulation": env.simulation,
        "robot": env.robot,
        "episode": env.episode,
        "studio": Studio(1) if of == "studio" else None,
    }[of]
    with pytest.raises(TypeError, match="simulated world, which cannot be copied or pickled"):
        copied(holder)
    with pytest.raises(TypeError, match="simulated world"):
        copy.copy(env)
    env.reset_flat(seed=0)
    assert np.array_equal(env.step_flat(np.zeros(11))[0], before)
    env.close()


@pytest.mark.parametrize(
    "call",
    [
        lambda e: e.reset(seed=0),
        lambda e: e.reset_flat(0),
        lambda e: e.step(np.zeros(11, np.float32)),
        lambda e: e.step_flat(np.zeros(11)),
        lambda e: e.render(),
        lambda e: e.episode,
    ],
    ids=["reset", "reset_flat", "step", "step_flat", "render", "episode"],
)
def test_a_closed_environment_says_so(call: Callable[[LunarRescueEnv], Any]) -> None:
    env = LunarRescueEnv(render_mode="rgb_array")
    env.reset_flat(seed=0)
    env.close()
    env.close()
    with pytest.raises(gymnasium.error.ClosedEnvironmentError, match="environment is closed"):
        call(env)


def test_flattened_observations_have_the_order_of_the_flat_ones(env: LunarRescueEnv) -> None:
    wrapped = FlattenObservation(env)
    flattened, _ = wrapped.reset(seed=8)
    assert np.array_equal(flattened, env.reset_flat(seed=8)[0])
    assert list(env.observation_space.spaces) == [entry.key for entry in ENTRIES]  # type: ignore[attr-defined]


def test_the_limit_of_make_is_the_only_one() -> None:
    assert gymnasium.spec("LunarRescue-v0").max_episode_steps == 120
    for arguments, limit in (({"max_episode_steps": 10}, 10), ({}, 120), ({"max_episode_steps": -1}, 120)):
        made = gymnasium.make("LunarRescue-v0", **arguments)  # type: ignore[arg-type]
        observation, _ = made.reset(seed=3)
        assert made.unwrapped.max_steps == limit  # type: ignore[attr-defined]
        for step in range(1, 11):
            observation, _, _, truncated, info = made.step(made.unwrapped._zero)  # type: ignore[attr-defined]
            assert observation["phase"][1] == pytest.approx(step / limit)
        assert truncated is (limit == 10)
        assert info["failure"] == ("timeout" if limit == 10 else None)
        made.close()
    again = gymnasium.make(gymnasium.make("LunarRescue-v0", max_episode_steps=7).spec)  # type: ignore[arg-type]
    assert again.unwrapped.max_steps == 7  # type: ignore[attr-defined]
    with pytest.raises(ValueError, match=r"max_steps: expected max_episode_steps=9 .* has 120"):
        gymnasium.make("LunarRescue-v0", max_steps=9)
    made = gymnasium.make("LunarRescue-v0", max_steps=9, max_episode_steps=-1)
    assert made.unwrapped.max_steps == 9  # type: ignore[attr-defined]
