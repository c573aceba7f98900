"""A policy for others' programs acts as the command line's, speaks SB3's language, and refuses what it cannot do."""

from __future__ import annotations

from pathlib import Path

import gymnasium
import numpy as np
import pytest
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from untrained import untrained_policy  # type: ignore[import-not-found]  # pytest puts this folder on the path

import reproduce
from lunar_rescue import LunarRescueEnv, sample_scene
from lunar_rescue.observation import SIZE, as_dict, as_flat
from reproduce.experiments.evaluate import find_policy, run_episode
from reproduce.report.reference import PUBLIC, markdown, reference
from reproduce.storage.errors import UserError


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return untrained_policy("hrl_dcs", tmp_path_factory.mktemp("library") / "run")


@pytest.mark.process
def test_it_acts_as_the_policy_that_the_command_line_tests(folder: Path, env: LunarRescueEnv) -> None:
    scene = sample_scene(7)
    expected = run_episode(env, find_policy(folder)[1], scene)
    policy = reproduce.load_policy(folder)
    assert policy.method == "hrl_dcs" and policy.rescue(env, scene) == expected
    observation, _ = env.reset(options={"scene": scene})
    state, total, done = None, 0.0, False
    while not done:
        action, state = policy.predict(observation, state)
        assert action.shape == (11,)
        observation, reward, done, _, info = env.step(action)
        total += reward
    assert (total, info["failure"], env.episode.steps) == (expected["return"], expected["failure"], expected["steps"])


def test_a_state_is_remembered_and_none_forgets(folder: Path, env: LunarRescueEnv) -> None:
    policy = reproduce.load_policy(str(folder))
    observation, _ = env.reset(seed=1)
    first, state = policy.predict(observation)
    second, state = policy.predict(observation, state)
    assert not np.array_equal(first, second)  # the recurrent networks have seen it twice
    assert np.array_equal(policy.predict(observation)[0], first)
    begun, _ = policy.predict(as_flat(observation)[None], state, episode_start=np.array([True]))
    assert begun.shape == (1, 11) and np.array_equal(begun[0], first)


def test_sb3_evaluates_it_like_a_model_of_its_own(folder: Path) -> None:
    env = Monitor(gymnasium.make("LunarRescue-v0", max_episode_steps=8))
    returns, lengths = evaluate_policy(
        reproduce.load_policy(folder), env, n_eval_episodes=2, return_episode_rewards=True
    )
    assert lengths == [8, 8] and np.isfinite(returns).all()


def test_what_it_cannot_do_is_refused(folder: Path, tmp_path: Path) -> None:
    policy = reproduce.load_policy(folder)
    with pytest.raises(ValueError, match=rf"observation: expected shape \({SIZE},\) or \(n, {SIZE}\), got \(3,\)"):
        policy.predict(np.zeros(3, np.float32))
    with pytest.raises(ValueError, match="deterministic: expected True"):
        policy.predict(np.zeros(SIZE, np.float32), deterministic=False)
    with pytest.raises(UserError, match="no such run folder"):
        reproduce.load_policy(tmp_path / "nowhere")


def test_flat_observations_do_not_depend_on_the_order_of_keys() -> None:
    flat = np.arange(3 * SIZE, dtype=np.float32).reshape(3, SIZE)
    assert np.array_equal(as_flat(dict(reversed(as_dict(flat).items()))), flat)


def test_the_reference_has_every_name_with_signature_and_words() -> None:
    parts = reference()
    items = [item for group in parts.values() for item in group]
    assert [item.name.rpartition(".")[2] for item in items] == [n.partition(":")[2] for g in PUBLIC.values() for n in g]
    for shown in [*items, *(method for item in items for method in item.methods)]:
        assert len(shown.text.split()) > 5 and "self" not in shown.signature, shown.name
    predict = next(m for item in items for m in item.methods if m.name == "LoadedPolicy.predict")
    assert predict.signature.startswith("predict(\n    observation: Observation,\n    state: Any = None,\n")


def test_docstrings_become_markdown() -> None:
    text = (
        "Do it to ``x``.\n\nArgs:\n    x: One thing,\n        or two.\n    y, z: Others.\n\nReturns:\n    What is left."
    )
    arguments = "**Arguments**\n\n- `x`: One thing,\n  or two.\n- `y, z`: Others."
    assert markdown(text) == f"Do it to `x`.\n\n{arguments}\n\n**Returns**\n\nWhat is left."
