"""`sac_demos`: demonstrations in the buffer, and its losses, on cases worked by hand."""

from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from lunar_rescue.observation import BOUND, SIZE
from lunar_rescue.physics.robot import JOINTS
from reproduce.baselines.demonstrated_td3 import DemonstratedTD3, OffPolicyConfig, make_td3
from reproduce.learning.demonstrations import PlayedBack
from reproduce.learning.training import OnlySpaces


def _learner(**changes: Any) -> DemonstratedTD3:
    config = OffPolicyConfig(**{"hidden_units": 8, "buffer_size": 10, "gamma": 0.5, "returns": 2, **changes})
    seen, acts = spaces.Box(-BOUND, BOUND, (SIZE,), np.float32), spaces.Box(-1.0, 1.0, (JOINTS,), np.float32)
    return make_td3(OnlySpaces(1, seen, acts), config, 0)


def _played(rewards: list[float]) -> PlayedBack:
    steps = len(rewards)
    seen = np.repeat(np.arange(steps, dtype=np.float32)[:, None] / 10.0, SIZE, axis=1)
    outputs, taken = np.full((steps, JOINTS), 0.5, np.float32), np.full((steps, JOINTS), -0.5, np.float32)
    told = np.array(rewards, np.float32)
    return PlayedBack(seen, outputs, taken, told, told, 0)


@pytest.mark.process
def test_demonstrations_give_returns_of_several_steps_and_end_where_they_end() -> None:
    learner = _learner()
    learner.remember([_played([1.0, 2.0, 4.0]), _played([8.0])])
    samples = learner.demonstrations._get_samples(np.arange(4))
    # 1 + 0.5 * 2, then from its second step the end is met within two steps; the last is alone.
    assert samples.rewards.flatten().tolist() == [2.0, 4.0, 4.0, 8.0]
    assert samples.dones.flatten().tolist() == [0.0, 1.0, 1.0, 1.0]
    assert samples.discounts is not None
    assert samples.discounts.flatten()[0] == 0.25
    assert samples.next_observations[0, 0].item() == pytest.approx(0.2)  # two steps on
    assert np.allclose(samples.actions, -0.5), "what was done, not what was wanted, has led to the rewards"


@pytest.mark.process
def test_critics_learn_what_a_demonstration_was_worth() -> None:
    learner = _learner(returns=1, tau=1.0, critic_learning_rate=1e-2)
    learner.remember([_played([0.0, 0.0, 4.0])])
    for _ in range(400):
        learner.critic_step(16, own=False)
    seen, acts = (th.from_numpy(getattr(learner.demonstrations, name)[:, 0]) for name in ("observations", "actions"))
    last = learner.critic.q1_forward(seen, acts)[2].item()
    assert last == pytest.approx(4.0, abs=0.2)


@pytest.mark.process
def test_the_actor_comes_to_what_was_wanted_where_imitation_weighs_enough() -> None:
    learner = _learner(imitation_weight=1e4, actor_learning_rate=1e-2)
    learner.remember([_played([0.0, 0.0, 4.0])])
    for _ in range(200):
        learner.critic_step(16, own=False)
        learner.actor_step()
    acts = learner.actor(th.from_numpy(learner.demonstrations.observations[:, 0]))
    assert th.allclose(acts, th.full_like(acts, 0.5), atol=0.1)


def test_what_a_checkpoint_holds_brings_back_buffers_and_weights() -> None:
    learner, other = _learner(), _learner()
    learner.remember([_played([1.0, 2.0, 4.0])])
    learner.critic_step(4, own=False)
    other.load_state(learner.state_tensors(), learner.state_numbers())
    assert other.demonstrations.rewards[:, 0].tolist() == [1.0, 2.0, 4.0]
    assert other.wanted.tolist() == learner.wanted.tolist()
    for own, loaded in zip(learner.critic.parameters(), other.critic.parameters(), strict=True):
        assert th.equal(own, loaded)
