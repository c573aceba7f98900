"""FuN's learner: the clipped update of PPO for Worker, the transition policy gradient, clipped alike, for Manager.

FuN was trained by A3C, each rollout used once. Steps of a physical simulation are dear, so here a rollout is used
several times as in the other methods of this project, with the same learner under it, and what is compared is the
hierarchy. That wants ratios: Worker's is that of its actions. Manager's follows from FuN's own derivation,
which takes directions s_{t+c} - s_t as drawn from a von Mises-Fisher distribution around the goal, p ~ exp(kappa cos).
Its norm does not depend on the goal, so the ratio of new and old is exp(kappa (cos_new - cos_old)); at the rollout's
own goals it is 1 and its gradient, times A^M, is that of Eq. 7, A^M grad cos(s_{t+c} - s_t, g_t).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import FloatSchedule, explained_variance
from stable_baselines3.common.vec_env import VecEnv
from torch.nn import functional

from reproduce.baselines.feudal.config import FunConfig
from reproduce.baselines.feudal.network import FunNetwork
from reproduce.baselines.feudal.rollout import FunBuffer, FunRollout, as_tensor, env_major
from reproduce.baselines.feudal.signals import advantages_and_returns, directions, intrinsic_rewards
from reproduce.learning.sequence_ppo import SequencePPO
from reproduce.learning.sequences import Minibatch, Rollout


class FunPPO(SequencePPO):
    """SequencePPO for Worker, with a Manager above it."""

    def __init__(self, *args: Any, fun: FunConfig | None = None, **kwargs: Any) -> None:
        """As SequencePPO, whose discount and lambda are Worker's.

        Args:
            *args: See ``SequencePPO``; the policy is ``FunNetwork``.
            fun: What only this method has.
            **kwargs: See ``SequencePPO``.
        """
        self.fun = fun or FunConfig()
        sizes = {name: getattr(self.fun, name) for name in ("goal_size", "embedding_size", "horizon")}
        kwargs["policy_kwargs"] = {**sizes, **(kwargs.get("policy_kwargs") or {})}
        super().__init__(*args, **kwargs)

    @property
    def network(self) -> FunNetwork:
        """The policy, by its own type."""
        network: Any = self.policy  # SB3 believes that every policy is its ActorCriticPolicy
        assert isinstance(network, FunNetwork)
        return network

    def _setup_model(self) -> None:
        """Make network, memory and buffer."""
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        make: Any = self.policy_class
        self.policy = make(self.observation_space, self.action_space, self.lr_schedule, **self.policy_kwargs)
        self.rollout_buffer = FunBuffer(
            self.n_steps,
            self.observation_space,
            self.action_space,
            device="cpu",
            gamma=self.gamma,
            gae_lambda=self.gae_lambda,
            n_envs=self.n_envs,
            network=self.network,
            sequence_length=self.sequence_length,
        )
        self.memory = self.network.empty_memory(self.n_envs)
        self._last_lstm_states: Any = ()  # sb3-contrib's; ours is ``memory``, emptied where episodes begin
        # The end of the rollout before, as goals reach over to the next: observations and goals of c - 1 steps.
        before = self.fun.horizon - 1
        self._tail_observations = th.zeros(before, self.n_envs, self.network.spec.observations)
        self._tail_goals = th.zeros(before, self.n_envs, self.fun.goal_size)
        self.clip_range = FloatSchedule(self.clip_range)
        if self.clip_range_vf is not None:
            self.clip_range_vf = FloatSchedule(self.clip_range_vf)

    # -- collecting ----------------------------------------------------------------------------------------------------
    def collect_rollouts(
        self, env: VecEnv, callback: BaseCallback, rollout_buffer: RolloutBuffer, n_rollout_steps: int
    ) -> bool:
        """Step the environments and fill the buffer; see SB3. False if the callback wants to stop."""
        assert isinstance(rollout_buffer, FunBuffer)
        self.policy.set_training_mode(False)
        self._keep_tail(rollout_buffer)
        rollout_buffer.reset()
        callback.on_rollout_start()
        for _ in range(n_rollout_steps):
            if not self._collect_step(env, callback, rollout_buffer):
                return False
        callback.on_rollout_end()
        return True

    def _keep_tail(self, buffer: FunBuffer) -> None:
        before = self.fun.horizon - 1
        seen = th.cat([self._tail_observations, as_tensor(buffer.observations)])
        goals = th.cat([self._tail_goals, buffer.goals])
        self._tail_observations, self._tail_goals = seen[len(seen) - before :], goals[len(goals) - before :]

    def _collect_step(self, env: VecEnv, callback: BaseCallback, buffer: FunBuffer) -> bool:
        assert isinstance(self.action_space, spaces.Box)
        observations, starts = np.asarray(self._last_obs, np.float32), np.asarray(self._last_episode_starts, bool)
        self.memory.forget(th.from_numpy(starts))
        buffer.add_before(self.memory)
        step = self.network.step(th.from_numpy(observations), self.memory, random_goals=self.fun.random_goals)
        actions = step.actions.numpy()
        new, rewards, dones, infos = env.step(np.clip(actions, self.action_space.low, self.action_space.high))
        self.num_timesteps += env.num_envs
        callback.update_locals(locals())
        if not callback.on_step():
            return False
        self._update_info_buffer(infos, dones)
        worker, manager = self._rewards(rewards, dones, infos, buffer)
        buffer.add_levels(step, manager, dones)
        buffer.add(observations, actions, worker, starts, step.worker_values, step.log_probs)
        self._last_obs, self._last_episode_starts = new, dones  # type: ignore[assignment]
        return True

    def _rewards(
        self, rewards: NDArray[Any], dones: NDArray[Any], infos: list[dict[str, Any]], buffer: FunBuffer
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """The environment's reward for Worker and Manager; at a time limit what would have come is added, as in SB3."""
        worker, manager = rewards.astype(np.float32), rewards.astype(np.float32)
        ended = np.flatnonzero(dones)
        if len(ended):
            last = as_tensor([infos[i]["terminal_observation"] for i in ended])
            buffer.last_observations.append((buffer.pos, ended, last))
            cut = np.array([infos[i].get("TimeLimit.truncated", False) for i in ended])
            if cut.any():
                after = self.network.step(last, self.memory.copy(th.from_numpy(ended)), deterministic=True)
                worker[ended] += self.gamma * cut * after.worker_values.numpy()
                manager[ended] += self.fun.manager_gamma * cut * after.manager_values.numpy()
        return worker, manager

    # -- learning ------------------------------------------------------------------------------------------------------
    @th.no_grad()
    def rollout(self) -> FunRollout:
        """The collected steps as sequences, environments end to end, with all that the two losses need."""
        buffer, c = self.rollout_buffer, self.fun.horizon
        assert isinstance(buffer, FunBuffer)
        states, following = self._states(buffer)
        goals = th.cat([self._tail_goals, buffer.goals])
        intrinsic = intrinsic_rewards(states, following, goals, buffer.clock, c)
        ways, known = directions(states[c - 1 :], following, buffer.ends, c)
        worker, manager = self._returns(buffer, intrinsic)
        bounds, first_states = buffer.sequences()
        sequence_of = th.full((buffer.ends.numel(),), -1)
        sequence_of[bounds[:, 0]] = th.arange(len(bounds))
        self._rollout = FunRollout(
            observations=env_major(as_tensor(buffer.observations)).numpy(),
            actions=env_major(as_tensor(buffer.actions)).numpy(),
            log_probs=env_major(th.from_numpy(buffer.log_probs)).numpy(),
            values=env_major(th.from_numpy(buffer.values)).numpy(),
            advantages=env_major(worker[0]).numpy(),
            returns=env_major(worker[1]).numpy(),
            hidden=env_major(buffer.worker_states).numpy(),
            bounds=bounds,
            pooled=env_major(buffer.pooled),
            directions=env_major(ways),
            known=env_major(known),
            old_cosines=env_major(functional.cosine_similarity(ways, buffer.own_goals, dim=-1)),
            manager_advantages=env_major(_standardised(manager[0], known)),
            manager_returns=env_major(manager[1]),
            clock=env_major(buffer.clock),
            manager_states=first_states,
            sequence_of=sequence_of,
            intrinsic=env_major(intrinsic),
            manager_explained=float(
                explained_variance(buffer.manager_values.numpy().ravel(), manager[1].numpy().ravel())
            ),
        )
        return self._rollout

    def _returns(
        self, buffer: FunBuffer, intrinsic: th.Tensor
    ) -> tuple[tuple[th.Tensor, th.Tensor], tuple[th.Tensor, th.Tensor]]:
        """Advantages and returns (t, n) of Worker, from R + alpha R^I, and of Manager, from R alone."""
        last, fun = self.network.step(as_tensor(self._last_obs), self.memory.copy(), deterministic=True), self.fun
        rewards, values = th.from_numpy(buffer.rewards) + fun.intrinsic_weight * intrinsic, th.from_numpy(buffer.values)
        worker = advantages_and_returns(rewards, values, last.worker_values, buffer.ends, self.gamma, self.gae_lambda)
        rewards, values = buffer.manager_rewards, buffer.manager_values
        manager = advantages_and_returns(
            rewards, values, last.manager_values, buffer.ends, fun.manager_gamma, fun.manager_gae_lambda
        )
        return worker, manager

    def _states(self, buffer: FunBuffer) -> tuple[th.Tensor, th.Tensor]:
        """Manager's states, c - 1 before the rollout first (c - 1 + t, n, d), and what each step led to (t, n, d)."""
        now = as_tensor(self._last_obs)[None]
        seen = th.cat([self._tail_observations, as_tensor(buffer.observations), now])
        states = self.network.states(seen)
        following = states[self.fun.horizon :].clone()
        for step, ended, observations in buffer.last_observations:
            following[step, ended] = self.network.states(observations)
        return states[:-1], following

    def losses(self, batch: Minibatch, data: dict[str, th.Tensor]) -> tuple[th.Tensor, dict[str, float]]:
        """Worker's loss, which is PPO's on A^D, and Manager's; neither has a gradient in the other's network."""
        worker, log = super().losses(batch, data)
        manager, more = self.manager_losses(batch)
        return worker + manager, {**log, **more}

    def evaluate_sequences(self, batch: Minibatch, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """V^D, log probabilities and entropies of Worker at the real steps of a minibatch."""
        pooled = self._rollout.pooled[batch.rows]
        distribution, values = self.network.act_towards(batch.observations, batch.hidden, batch.mask, pooled)
        return values, distribution.log_prob(actions).sum(-1), distribution.entropy().sum(-1)

    def manager_losses(self, batch: Minibatch) -> tuple[th.Tensor, dict[str, float]]:
        """The clipped transition policy gradient and V^M's loss, and what is worth logging."""
        rollout, rows = self._rollout, batch.rows
        first = rows[: batch.mask.shape[1]]  # rows go step by step, and every sequence has a first
        state = rollout.manager_states[rollout.sequence_of[first]]
        goals, values = self.network.set_goals(batch.observations, state, rollout.clock[first], batch.mask)
        cosines = functional.cosine_similarity(rollout.directions[rows], goals, dim=-1)
        ratio = th.exp(self.fun.concentration * (cosines - rollout.old_cosines[rows]))
        clip = self.clip_range(self._current_progress_remaining)  # type: ignore[operator]
        advantages, known = rollout.manager_advantages[rows], rollout.known[rows]
        surrogate = th.min(advantages * ratio, advantages * th.clamp(ratio, 1 - clip, 1 + clip))
        policy_loss = -(surrogate * known).sum() / known.sum().clamp(min=1)
        value_loss = functional.mse_loss(values, rollout.manager_returns[rows])
        return policy_loss + self.vf_coef * value_loss, {
            "manager_loss": float(policy_loss.detach()),
            "manager_value_loss": float(value_loss.detach()),
            "manager_clip_fraction": float((th.abs(ratio.detach() - 1) > clip).float().mean()),
            "goal_cosine": float((cosines.detach() * known).sum() / known.sum().clamp(min=1)),
        }

    def _record(self, rollout: Rollout, logs: list[dict[str, float]]) -> None:
        super()._record(rollout, logs)
        assert isinstance(rollout, FunRollout)
        self.logger.record("train/intrinsic", float(rollout.intrinsic.mean()))
        self.logger.record("train/manager_explained_variance", rollout.manager_explained)


def _standardised(advantages: th.Tensor, known: th.Tensor) -> th.Tensor:
    """Mean 0 and deviation 1 over the steps that Manager learns from; over a rollout, as its sequences are few."""
    chosen = advantages[known]
    if len(chosen) < 2:
        return advantages
    return (advantages - chosen.mean()) / (chosen.std() + 1e-8)
