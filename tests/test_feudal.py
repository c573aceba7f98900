"""FeUdal Networks: each part against a plain reading of its equation, then a task that wants memory."""

from __future__ import annotations

import copy
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch as th
from feudal_task import HELD, CueMaze  # type: ignore[import-not-found]  # pytest puts this folder on the path
from gymnasium import spaces
from numpy.typing import NDArray
from safetensors.torch import load_file, save_file
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnvWrapper
from torch import nn
from torch.nn import functional

from lunar_rescue.observation import SIZE
from lunar_rescue.physics.robot import JOINTS
from reproduce.baselines.feudal.learner import FunPPO
from reproduce.baselines.feudal.levels import DilatedLSTM
from reproduce.baselines.feudal.network import FunConfig, FunNetwork, FunSpec
from reproduce.baselines.feudal.rollout import FunBuffer, FunRollout, directions
from reproduce.baselines.feudal.training import LEVEL, FunPolicy, FunTraining, load_feudal_policy
from reproduce.experiments.methods import METHODS
from reproduce.learning.config import PolicyConfig
from reproduce.learning.sequence_ppo import SequencePPO
from reproduce.learning.sequences import TARGETS, Minibatch, minibatches
from reproduce.learning.training import start_collecting
from reproduce.storage.checkpoint import Progress, load_checkpoint, save_checkpoint
from reproduce.storage.errors import UserError
from reproduce.storage.policies import save_policy

C, D, ENVS, STEPS = 4, 8, 3, 26
SMALL = FunConfig(horizon=C, goal_size=D, embedding_size=3, random_goals=0.2, intrinsic_weight=0.3)


class Wander(gymnasium.Env[NDArray[np.float64], NDArray[np.float64]]):
    """Random observations and rewards; episodes of 1 to 13 steps that end by themselves or are cut off."""

    def __init__(self) -> None:
        self.observation_space = spaces.Box(-9.0, 9.0, (3,), np.float64)
        self.action_space = spaces.Box(-2.0, 1.0, (2,), np.float64)
        self._left, self._cut = 0, False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self._left, self._cut = int(self.np_random.integers(1, 14)), bool(self.np_random.integers(2))
        return self.np_random.normal(size=3), {}

    def step(self, action: NDArray[np.float64]) -> Any:
        assert self.action_space.contains(np.asarray(action, np.float64))
        self._left -= 1
        over, cut = self._left == 0, self._cut
        seen, reward = self.np_random.normal(size=3), float(self.np_random.normal())
        return seen, reward, over and not cut, over and cut, {}


class Noted(VecEnvWrapper):
    """Notes each step's rewards, as they were, and where an episode was cut off."""

    def __init__(self, venv: Any) -> None:
        super().__init__(venv)
        self.rewards: list[NDArray[Any]] = []
        self.cuts: list[NDArray[Any]] = []

    def reset(self) -> Any:
        return self.venv.reset()

    def step_wait(self) -> Any:
        seen, rewards, dones, infos = self.venv.step_wait()
        self.rewards.append(np.array(rewards))
        self.cuts.append(np.array([info["TimeLimit.truncated"] for info in infos]))
        return seen, rewards, dones, infos


def make(fun: FunConfig = SMALL, **kwargs: Any) -> FunPPO:
    env = DummyVecEnv([Wander] * ENVS)
    env.seed(5)
    settings = {"n_steps": STEPS, "batch_size": 40, "n_epochs": 2, "sequence_length": 6, "seed": 1, **kwargs}
    sizes = {"hidden_units": 16, "log_std_init": -0.5}
    made = FunPPO(FunNetwork, env, fun=fun, policy_kwargs=sizes, device="cpu", **settings)
    made.set_logger(Logger(folder=None, output_formats=[]))
    return made


def collect(learner: FunPPO, rollouts: int = 1) -> FunBuffer:
    if learner._last_obs is None:
        learner._callback = start_collecting(learner, 10_000)  # type: ignore[attr-defined]
    env: Any = learner.env
    for _ in range(rollouts):
        learner.collect_rollouts(env, learner._callback, learner.rollout_buffer, STEPS)  # type: ignore[attr-defined]
    buffer = learner.rollout_buffer
    assert isinstance(buffer, FunBuffer)
    return buffer


def ends(buffer: FunBuffer) -> list[tuple[int, int, th.Tensor]]:
    """Step, environment and last observation of each episode that ended."""
    return [
        (t, int(index), observation)
        for t, envs, observations in buffer.last_observations
        for index, observation in zip(envs, observations, strict=True)
    ]


def by_step(tensor: th.Tensor) -> th.Tensor:
    """(n * t, ...) back to (t, n, ...)."""
    return tensor.unflatten(0, (ENVS, STEPS)).transpose(0, 1)


def one_batch(rollout: FunRollout) -> tuple[Minibatch, dict[str, th.Tensor]]:
    (batch,) = minibatches(rollout, len(rollout), np.random.default_rng(0))
    return batch, {name: th.from_numpy(getattr(rollout, name))[batch.rows] for name in TARGETS}


# -- the dilated LSTM --------------------------------------------------------------------------------------------------
def test_group_t_mod_r_alone_moves_and_the_output_is_the_sum_of_the_last_r() -> None:
    th.manual_seed(0)
    lstm, clock = DilatedLSTM(5, D, C), th.tensor([0, 3, 9])
    state, own = th.zeros(3, 2, C, D), [[(th.zeros(1, D), th.zeros(1, D)) for _ in range(C)] for _ in range(3)]
    outputs: list[list[th.Tensor]] = [[], [], []]
    with th.no_grad():
        for t in range(11):
            inputs, before = th.randn(3, 5), state.clone()
            pooled = lstm.step(inputs, state, clock + t)
            for row in range(3):
                group = int(clock[row] + t) % C
                others = [g for g in range(C) if g != group]
                assert th.equal(state[row][:, others], before[row][:, others])
                assert not th.equal(state[row][:, group], before[row][:, group])
                output, own[row][group] = lstm.core(inputs[None, row], own[row][group])  # a plain LSTM of its own
                outputs[row].append(output[0])
                assert th.allclose(pooled[row], th.stack(outputs[row][-C:]).sum(0), atol=1e-6)


@pytest.mark.parametrize("length", [1, C - 1, C, 2 * C + 3])
def test_whole_sequences_are_the_same_as_single_steps(length: int) -> None:
    th.manual_seed(0)
    lstm, clock = DilatedLSTM(5, D, C), th.tensor([0, 2, 7])
    inputs, state = th.randn(length, 3, 5), th.randn(3, 2, C, D)
    whole = lstm(inputs, state, clock)
    with th.no_grad():
        stepped = state.clone()
        for t in range(length):
            assert th.allclose(whole[t], lstm.step(inputs[t], stepped, clock + t), atol=1e-5)
    whole.sum().backward()
    assert all(p.grad is not None and bool(p.grad.abs().sum() > 0) for p in lstm.parameters())


# -- goals -------------------------------------------------------------------------------------------------------------
@pytest.mark.process
def test_goals_have_norm_one_and_their_sum_restarts_with_the_episode() -> None:
    learner = make()
    buffer = collect(learner, 2)
    assert th.allclose(buffer.goals.norm(dim=-1), th.ones(STEPS, ENVS), atol=1e-5)
    assert th.allclose(buffer.own_goals.norm(dim=-1), th.ones(STEPS, ENVS), atol=1e-5)
    assert buffer.ends.any()
    for env in range(ENVS):
        for t in range(C, STEPS):
            back = min(int(buffer.clock[t, env]) + 1, C)
            assert th.allclose(buffer.pooled[t, env], buffer.goals[t + 1 - back : t + 1, env].sum(0), atol=1e-5)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.2])
def test_share_of_random_goals(share: float) -> None:
    network, count = FunSpec(3, 2, 16, D, 3, C).build(), 20_000
    step = network.step(th.randn(count, 3), network.empty_memory(count), random_goals=share)
    random = (step.goals != step.own_goals).any(-1)
    # Four standard deviations of a share over 20,000 draws.
    assert float(random.float().mean()) == pytest.approx(share, abs=4 * np.sqrt(share * (1 - share) / count) + 1e-12)
    if share:
        drawn = step.goals[random]
        assert float(drawn.mean(0).norm()) < 4 / np.sqrt(len(drawn))  # in no direction rather than another


@pytest.mark.process
@pytest.mark.parametrize("share", [0.0, 0.2, 1.0])
def test_random_goals_are_sent_while_collecting(share: float) -> None:
    learner = make(replace(SMALL, random_goals=share))
    found = []
    for _ in range(20):
        buffer = collect(learner)
        found.append((buffer.goals != buffer.own_goals).any(-1).flatten())
    sent = float(th.cat(found).float().mean())
    assert sent == share if share in (0.0, 1.0) else abs(sent - share) < 0.05  # 1,560 steps: 5 deviations


def test_a_zero_goal_gives_a_zero_mean_action() -> None:
    worker = FunSpec(3, 2, 16, D, 3, C).build().worker
    assert worker.phi.bias is None
    memory = th.randn(5, 16)
    assert th.equal(worker.mean(memory, th.zeros(5, D)), th.zeros(5, 2))
    goal = th.randn(5, D)
    assert bool((worker.mean(memory, goal) != 0).all())
    assert th.allclose(worker.mean(memory, -goal), -worker.mean(memory, goal))


def test_an_episode_begins_with_an_empty_memory() -> None:
    network, first = FunSpec(3, 2, 16, D, 3, C).build(), th.randn(2, 3)
    memory = network.empty_memory(2)
    fresh = network.step(first, network.empty_memory(2), deterministic=True)
    for _ in range(2 * C + 1):
        network.step(th.randn(2, 3), memory, deterministic=True)
    memory.forget(th.tensor([True, False]))
    again = network.step(first, memory, deterministic=True)
    for name in ("actions", "goals", "pooled", "worker_values", "manager_values"):
        assert th.allclose(getattr(again, name)[0], getattr(fresh, name)[0], atol=1e-6), name
        assert not th.allclose(getattr(again, name)[1], getattr(fresh, name)[1], atol=1e-6), name


# -- what the levels learn from ----------------------------------------------------------------------------------------
def test_signals_are_what_brute_force_gives_over_ends_and_over_rollouts() -> None:
    """Intrinsic reward (Eq. 8) and directions (Eq. 7), from a list of all steps of an environment."""
    learner = make()
    first = copy.deepcopy(collect(learner))
    second = collect(learner)
    rollout = learner.rollout()
    seen = np.concatenate([first.observations, second.observations, np.asarray(learner._last_obs)[None]])
    goals, ended = th.cat([first.goals, second.goals]), th.cat([first.ends, second.ends])
    last = {
        (offset + t, index): seen_last
        for offset, buffer in ((0, first), (STEPS, second))
        for t, index, seen_last in ends(buffer)
    }
    assert len(last) == int(ended.sum()) > ENVS

    def state(t: int, env: int, after: bool) -> th.Tensor:
        observation = last[t - 1, env] if after and (t - 1, env) in last else th.from_numpy(seen[t, env]).float()
        return learner.policy.states(observation)

    intrinsic, ways, known = by_step(rollout.intrinsic), by_step(rollout.directions), by_step(rollout.known)
    with th.no_grad():
        for env in range(ENVS):
            for t in range(STEPS, 2 * STEPS):
                begun = max([k + 1 for k in range(t) if ended[k, env]], default=0)
                total = 0.0
                for i in range(1, C + 1):
                    if t + 1 - i >= begun:
                        moved = state(t + 1, env, True) - state(t + 1 - i, env, False)
                        total += float(functional.cosine_similarity(moved, goals[t + 1 - i, env], dim=0))
                assert float(intrinsic[t - STEPS, env]) == pytest.approx(total / C, abs=1e-5)
                stop = min([k for k in range(t, 2 * STEPS) if ended[k, env]], default=2 * STEPS)
                until = min(t + C - 1, stop)
                assert bool(known[t - STEPS, env]) == (until < 2 * STEPS)
                if until < 2 * STEPS:
                    way = state(until + 1, env, True) - state(t, env, False)
                    assert th.allclose(ways[t - STEPS, env], way, atol=1e-5)
    assert not known.all() and known[-1].sum() == second.ends[-1].sum()


def test_worker_gets_the_intrinsic_reward_and_manager_does_not() -> None:
    learner = make(replace(SMALL, manager_gamma=0.0), gamma=0.0)  # returns are the rewards themselves
    buffer = collect(learner)
    rollout = learner.rollout()
    assert by_step(rollout.manager_returns).numpy() == pytest.approx(buffer.rewards, abs=1e-5)
    worker = buffer.rewards + 0.3 * by_step(rollout.intrinsic).numpy()
    assert by_step(th.from_numpy(rollout.returns)).numpy() == pytest.approx(worker, abs=1e-5)
    assert float(rollout.intrinsic.abs().max()) > 0.01


def test_at_a_time_limit_and_only_there_the_value_of_what_would_come_is_added() -> None:
    learner = make(replace(SMALL, manager_gamma=0.5), gamma=0.9)
    env: Any = learner.env
    noted = Noted(env)
    learner.env = noted
    for _ in range(50):  # until one episode is cut off in the same step in which another ends by itself
        noted.rewards.clear()
        noted.cuts.clear()
        buffer = collect(learner)
        plain, cut = np.array(noted.rewards), np.array(noted.cuts)
        over = buffer.ends.numpy() & ~cut
        if (cut.any(1) & over.any(1)).any():
            break
    else:
        pytest.fail("no such step in 50 rollouts")
    manager = buffer.manager_rewards.numpy()
    assert buffer.rewards[~cut] == pytest.approx(plain[~cut], abs=1e-6)
    assert manager[~cut] == pytest.approx(plain[~cut], abs=1e-6)
    # What is added is the value of the last observation, as seen with the memory of the whole episode.
    checked = 0
    for t, index, observation in ends(buffer):
        begun = t - int(buffer.clock[t, index])
        if not cut[t, index] or begun < 0:
            continue
        network, memory = learner.policy, learner.policy.empty_memory(1)
        for k in range(begun, t + 1):
            network.step(th.from_numpy(buffer.observations[k, index]).float()[None], memory, deterministic=True)
            memory.goals[0, (k - begun) % C] = buffer.goals[k, index]  # some were random
        after = network.step(observation[None], memory, deterministic=True)
        worker_value, manager_value = float(after.worker_values[0]), float(after.manager_values[0])
        assert buffer.rewards[t, index] - plain[t, index] == pytest.approx(0.9 * worker_value, abs=1e-4)
        assert manager[t, index] - plain[t, index] == pytest.approx(0.5 * manager_value, abs=1e-4)
        checked += 1
    assert checked > 0


# -- learning ----------------------------------------------------------------------------------------------------------
def test_learning_sees_what_acting_did() -> None:
    """In whole sequences, cut anywhere, actions, values and goals are as they were step by step, two rollouts on."""
    learner = make()
    buffer = collect(learner, 2)
    rollout = learner.rollout()
    assert len(rollout.bounds) > ENVS * STEPS / 6  # cut at episodes and every six steps
    for batch in minibatches(rollout, 30, np.random.default_rng(0)):
        with th.no_grad():
            values, log_probs, _ = learner.evaluate_sequences(batch, th.from_numpy(rollout.actions)[batch.rows])
            first = batch.rows[: batch.mask.shape[1]]
            state, clock = rollout.states_before(first), rollout.clock[first]
            goals, manager_values = learner.policy.set_goals(batch.observations, state, clock, batch.mask)
            _, log = learner.manager_losses(batch)
        assert log_probs.numpy() == pytest.approx(rollout.log_probs[batch.rows], abs=1e-4)
        assert values.numpy() == pytest.approx(rollout.values[batch.rows], abs=1e-4)
        own = buffer.own_goals.transpose(0, 1).flatten(0, 1)[batch.rows]
        assert th.allclose(goals, own, atol=1e-4)
        expected = buffer.manager_values.transpose(0, 1).flatten()[batch.rows]
        assert th.allclose(manager_values, expected, atol=1e-4)
        assert log["manager_clip_fraction"] == 0.0


def gradients(learner: FunPPO, loss: th.Tensor) -> dict[str, float]:
    """Largest absolute gradient of each parameter; 0 where there is none."""
    learner.policy.zero_grad()
    loss.backward()
    return {name: 0.0 if p.grad is None else float(p.grad.abs().max()) for name, p in learner.policy.named_parameters()}


def test_no_gradient_goes_from_one_level_into_the_other() -> None:
    learner = make()
    collect(learner, 2)
    batch, data = one_batch(learner.rollout())
    worker = gradients(learner, SequencePPO.losses(learner, batch, data)[0])
    manager = gradients(learner, learner.manager_losses(batch)[0])
    both = gradients(learner, learner.losses(batch, data)[0])
    for name in both:
        assert both[name] > 0.0, name
        if name.startswith("manager."):
            assert worker[name] == 0.0 and manager[name] > 0.0, name
        elif name.startswith("percept."):
            assert worker[name] > 0.0 and manager[name] > 0.0, name  # shared, as in Eq. 1
        else:
            assert worker[name] > 0.0 and manager[name] == 0.0, name


def test_no_gradient_goes_through_the_state_difference(monkeypatch: pytest.MonkeyPatch) -> None:
    states, following = th.randn(9, 2, D, requires_grad=True), th.randn(9, 2, D, requires_grad=True)
    ways, _ = directions(states, following, th.zeros(9, 2, dtype=th.bool), C)
    assert not ways.requires_grad
    learner = make()
    collect(learner, 2)
    batch, _ = one_batch(learner.rollout())
    # With the LSTM's input severed only the difference is left to bring a gradient into the space of states.
    core = learner.policy.manager.core
    forward = core.forward
    monkeypatch.setattr(core, "forward", lambda inputs, state, clock: forward(inputs.detach(), state, clock))
    severed = gradients(learner, learner.manager_losses(batch)[0])
    monkeypatch.undo()
    whole = gradients(learner, learner.manager_losses(batch)[0])
    for name, size in whole.items():
        if name.startswith(("manager.space.", "percept.")):
            assert severed[name] == 0.0 and size > 0.0, name
    assert severed["manager.core.core.weight_ih_l0"] > 0.0


def test_the_clipped_loss_begins_with_the_transition_policy_gradient() -> None:
    """At the rollout's own goals its gradient is that of Eq. 7, -mean A^M cos(s_{t+c} - s_t, g_t)."""
    learner = make(vf_coef=0.0)
    collect(learner, 2)
    rollout = learner.rollout()
    batch, _ = one_batch(rollout)
    learner.manager_losses(batch)[0].backward()
    core = learner.policy.manager.core.core
    ours = [p.grad.clone() for p in core.parameters() if p.grad is not None]
    learner.policy.zero_grad()
    first = batch.rows[: batch.mask.shape[1]]
    state = rollout.states_before(first)
    goals, _ = learner.policy.set_goals(batch.observations, state, rollout.clock[first], batch.mask)
    rows = batch.rows[rollout.known[batch.rows]]
    ways, advantages = rollout.directions[rows], rollout.manager_advantages[rows]
    cosines = (ways * goals[rollout.known[batch.rows]]).sum(-1) / ways.norm(dim=-1)
    (-(advantages * cosines).mean()).backward()
    assert len(ours) == 4
    for mine, p in zip(ours, core.parameters(), strict=True):
        assert p.grad is not None and float(p.grad.abs().max()) > 1e-4
        assert th.allclose(mine, p.grad, atol=1e-6)


def test_an_update_moves_every_parameter_and_shows_it() -> None:
    learner = make(log_std_line=(-0.5, -1.0, 0.5), desired_kl=(0.01, 0.01))
    learner._current_progress_remaining = 0.5
    before = [p.detach().clone() for p in learner.policy.parameters()]
    collect(learner)
    learner.train()
    moved = [not th.equal(a, b) for a, b in zip(before, learner.policy.parameters(), strict=True)]
    assert all(moved)
    assert bool((learner.policy.log_std <= -1.0).all())  # exploration under its line, as SequencePPO's
    logged = learner.logger.name_to_value
    for key in ("approx_kl", "intrinsic", "goal_cosine", "manager_value_loss", "manager_explained_variance"):
        assert np.isfinite(logged[f"train/{key}"]), key


# -- around it ---------------------------------------------------------------------------------------------------------
def test_a_resumed_training_repeats_bit_for_bit(tmp_path: Path) -> None:
    def go_on(learner: FunPPO) -> dict[str, th.Tensor]:
        env: Any = learner.env
        env.seed(77)
        learner._callback = start_collecting(learner, 10_000)  # type: ignore[attr-defined]
        for _ in range(3):
            collect(learner)
            learner.train()
        return learner.policy.state_dict()

    whole = make()
    for _ in range(2):
        collect(whole)
        whole.train()
    whole.rate_factor = 0.5
    save_checkpoint(tmp_path, {LEVEL: whole}, Progress(2, 2 * STEPS * ENVS, 1.0), {"a": 1})
    expected = go_on(whole)
    th.manual_seed(999)
    resumed = make(seed=2)
    assert load_checkpoint(tmp_path, {LEVEL: resumed}, {"a": 1}).update == 2
    assert resumed.rate_factor == 0.5
    found = go_on(resumed)
    assert all(th.equal(expected[name], found[name]) for name in expected)


SHARED = PolicyConfig(mirror=True, set_point_changes=True, places=None)


def saved(folder: Path) -> FunNetwork:
    network = FunSpec(SIZE, JOINTS, 16, D, 3, C).build()
    specs: Any = {LEVEL: (network.spec, network)}
    save_policy(folder, "fun", specs, SHARED)
    return network


def test_a_saved_policy_acts_the_same(tmp_path: Path) -> None:
    network = saved(tmp_path)
    first, second = FunPolicy(network, SHARED), load_feudal_policy(tmp_path)
    rng = np.random.default_rng(0)
    for t in range(2 * C + 3):
        seen = rng.normal(size=(2, SIZE)).astype(np.float32)
        starts = np.array([t == 0, t in (0, 5)])
        actions = first.act(seen, starts)
        assert actions.shape == (2, JOINTS) and np.abs(actions).max() <= 1.0
        assert np.array_equal(actions, second.act(seen, starts))
    assert first.overlay() == {}


def test_memories_of_a_batch_are_kept_apart() -> None:
    network = FunSpec(SIZE, JOINTS, 16, D, 3, C).build()
    together, alone = FunPolicy(network, SHARED), FunPolicy(network, SHARED)
    rng = np.random.default_rng(0)
    for t in range(2 * C + 3):
        seen = rng.normal(size=(3, SIZE)).astype(np.float32)
        starts = np.array([t == 0, t in (0, 3), t in (0, 7)])
        assert together.act(seen, starts)[1] == pytest.approx(alone.act(seen[1:2], starts[1:2])[0], abs=1e-5)


@pytest.mark.parametrize(
    ("how", "word"),
    [("shape", "log_std"), ("missing", "phi"), ("unknown", "extra"), ("huge", "goal_size"), ("long", "horizon"),
     ("level", "networks"), ("sizes", "observations")],
)  # fmt: skip
def test_damaged_run_folders_are_refused_by_name(how: str, word: str, tmp_path: Path) -> None:
    saved(tmp_path)
    weights, path = tmp_path / "policy.safetensors", tmp_path / "policy.json"
    tensors, raw = load_file(weights), json.loads(path.read_text())
    match how:
        case "shape":
            tensors["fun.log_std"] = th.zeros(3)
        case "missing":
            del tensors["fun.worker.phi.weight"]
        case "unknown":
            tensors["fun.extra"] = th.zeros(1)
        case "huge":
            raw["networks"]["fun"]["goal_size"] = 10**9
        case "long":
            raw["networks"]["fun"]["horizon"] = 10**6
        case "level":
            raw["networks"] = {"sgn": raw["networks"]["fun"]}
        case "sizes":
            raw["networks"]["fun"]["observations"] = 7
    save_file(tensors, weights)
    path.write_text(json.dumps(raw))
    with pytest.raises(UserError, match=word):
        load_feudal_policy(tmp_path)


def test_predict_keeps_a_memory_as_sb3_s_recurrent_policies_do() -> None:
    network = FunSpec(3, 2, 16, D, 3, C).build()
    seen = np.random.default_rng(0).normal(size=(2 * C, 3)).astype(np.float32)
    memory, state = network.empty_memory(1), None
    for row in seen:
        action, state = network.predict(row, state, deterministic=True)
        expected = network.step(th.from_numpy(row)[None], memory, deterministic=True).actions[0]
        assert action == pytest.approx(expected.numpy(), abs=1e-6)
    again, _ = network.predict(seen[0], state, np.array([True]), deterministic=True)
    assert again == pytest.approx(network.predict(seen[0], deterministic=True)[0], abs=1e-6)


def test_what_makes_no_sense_is_refused() -> None:
    for bad in ({"horizon": 0}, {"goal_size": True}, {"random_goals": 1.5}, {"intrinsic_weight": float("nan")}):
        with pytest.raises(ValueError, match=next(iter(bad))):
            FunConfig(**bad)
    box, discrete = spaces.Box(-1.0, 1.0, (2,), np.float32), spaces.Discrete(3)
    with pytest.raises(ValueError, match="action_space"):
        FunNetwork(box, discrete, lambda _: 0.0)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="observation_space"):
        FunNetwork(spaces.Box(0.0, 1.0, (4, 4), np.float32), box, lambda _: 0.0)


@pytest.mark.process
def test_it_trains_on_the_rescue() -> None:
    smoke = METHODS["fun"].config("smoke")
    low = replace(smoke.low, n_steps=16, batch_size=16, n_epochs=1, hidden_units=16)
    training = FunTraining(replace(smoke, n_envs=2, low=low, fun=SMALL), 0)
    try:
        before = {name: tensor.clone() for name, tensor in training.learner.policy.state_dict().items()}
        row = training.update(0)
        training.restart(1)
        assert training.steps_per_update == 32 and set(training.learners) == {LEVEL}
        assert {"success", "both_arms_under", "return_high", "fun_approx_kl", "fun_std"} <= set(row)
        assert np.isfinite(row["fun_intrinsic"]) and np.isfinite(row["fun_approx_kl"])
        assert not th.equal(before["log_std"], training.learner.policy.state_dict()["log_std"])
    finally:
        training.close()


# -- a task that wants memory ------------------------------------------------------------------------------------------
def test_nothing_but_the_cue_tells_the_two_mazes_apart() -> None:
    """So whoever acts on the observation alone is right in half of the episodes at best."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        left, right = CueMaze(), CueMaze()
        pair = {}
        for env in (left, right):
            for seed in range(50):
                env.reset(seed=seed)
                if env._cue == (-1.0 if env is left else 1.0):
                    break
            pair[env] = env._cue
        assert set(pair.values()) == {-1.0, 1.0}
        for t in range(40):
            action = rng.uniform(-0.2, 1.0, 2).astype(np.float32)
            seen = [env.step(action) for env in (left, right)]
            assert np.array_equal(seen[0][0][:2], seen[1][0][:2]) and seen[0][2:4] == seen[1][2:4]
            if t + 1 >= HELD:
                assert np.array_equal(seen[0][0], seen[1][0])
            else:
                assert seen[0][0][0] == 0.0 and seen[0][0][2] == -1.0
            if seen[0][2] or seen[0][3]:
                break


def right_turns(policy: Any, episodes: int) -> float:
    """Share of episodes that end in the right arm."""
    env = DummyVecEnv([CueMaze] * 20)
    env.seed(1000)
    ended: list[bool] = []

    def note(before: dict[str, Any], _: dict[str, Any]) -> None:
        if before["done"]:
            ended.append(bool(before["info"]["is_success"]))

    evaluate_policy(policy, env, n_eval_episodes=episodes, callback=note, warn=False)
    return float(np.mean(ended))


class Forgetful(nn.Module):
    """Worker's LSTM without its memory: each step is the first."""

    def __init__(self, core: nn.LSTM) -> None:
        super().__init__()
        self.core = core

    def forward(self, inputs: th.Tensor, state: Any) -> Any:
        length, count, _ = inputs.shape
        outputs, _ = self.core(inputs.reshape(1, length * count, -1))
        return outputs.view(length, count, -1), tuple(th.zeros_like(part) for part in state)


def maze_learner(worker_remembers: bool = True) -> FunPPO:
    settings: dict[str, Any] = {"n_steps": 64, "batch_size": 256, "n_epochs": 4, "sequence_length": 64}
    learner = FunPPO(
        FunNetwork,
        DummyVecEnv([CueMaze] * 16),
        learning_rate=1e-3,
        ent_coef=1e-3,
        policy_kwargs={"hidden_units": 64, "log_std_init": 0.0},
        fun=FunConfig(horizon=5, goal_size=32),
        seed=0,
        device="cpu",
        **settings,
    )
    learner.set_logger(Logger(folder=None, output_formats=[]))
    if not worker_remembers:
        worker: Any = learner.policy.worker
        worker.core = Forgetful(worker.core)
    return learner


@pytest.mark.slow
@pytest.mark.parametrize("worker_remembers", [True, False])
def test_a_task_that_wants_memory_is_solved(worker_remembers: bool) -> None:
    """Also where Worker forgets every step: then only Manager remembers, and only goals can tell Worker."""
    th.set_num_threads(1)
    learner = maze_learner(worker_remembers)
    learner.learn(60_000)
    # Without memory 0.5 is the best, and 200 episodes show it with a deviation of 0.035: 0.9 is eleven of them away.
    assert right_turns(learner.policy, 200) > 0.9


@pytest.mark.slow
def test_the_same_task_is_not_solved_without_memory() -> None:
    th.set_num_threads(1)
    flat = PPO(
        "MlpPolicy",
        DummyVecEnv([CueMaze] * 16),
        n_steps=64,
        batch_size=256,
        n_epochs=4,
        learning_rate=1e-3,
        ent_coef=1e-3,
        seed=0,
        device="cpu",
    )
    flat.learn(60_000)
    share = right_turns(flat.policy, 200)
    assert 0.35 < share < 0.65  # it walks into an arm, but 0.5 is the best; four deviations each way
