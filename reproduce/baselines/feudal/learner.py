"""FuN's learner: the clipped update of PPO for Worker, the transition policy gradient, clipped alike, for Manager.

FuN was trained by A3C, each rollout used once. Steps of a physical simulation are dear, so here a rollout is used
several times as in the other methods of this project, with the same learner under it, and what is compared is the
hierarchy. That wants ratios: Worker's is that of its actions. Manager's follows from FuN's own derivation,
which takes directions s_{t+c} - s_t as drawn from a von Mises-Fisher distribution around the goal, p ~ exp(kappa cos).
Its norm does not depend on the goal, so the ratio of new and old is exp(kappa (cos_new - cos_old)); at the rollout's
own goals it is 1 and its gradient, times A^M, is that of Eq. 7, A^M grad cos(s_{t+c} - s_t, g_t).
"""

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

from reproduce.baselines.feudal.network import FunConfig, FunNetwork
from reproduce.baselines.feudal.rollout import FunBuffer, FunRollout, directions, intrinsic_rewards
from reproduce.learning.sequence_ppo import SequencePPO
from reproduce.learning.sequences import Floats, Minibatch, Rollout, advantages_and_returns, as_tensor, env_major


class FunPPO(SequencePPO):
    """SequencePPO for Worker, with a Manager above it; ``memory`` is what both remember of episodes under way."""

    policy: FunNetwork  # type: ignore[assignment]  # SB3 believes that every policy is its ActorCriticPolicy
    rollout_buffer: FunBuffer

    def __init__(self, *args: Any, fun: FunConfig | None = None, **kwargs: Any) -> None:
        """Make a learner of a ``FunNetwork`` as SequencePPO does; discount and lambda are Worker's."""
        self.fun = fun or FunConfig()
        sizes = {name: getattr(self.fun, name) for name in ("goal_size", "embedding_size", "horizon")}
        kwargs["policy_kwargs"] = {**sizes, **(kwargs.get("policy_kwargs") or {})}
        super().__init__(*args, **kwargs)

    def _setup_model(self) -> None:
        """Make network, memory and buffer; see SB3."""
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        make: Any = self.policy_class
        self.policy = make(self.observation_space, self.action_space, self.lr_schedule, **self.policy_kwargs)
        sizes: Any = {"n_envs": self.n_envs, "spec": self.policy.spec, "sequence_length": self.sequence_length}
        self.rollout_buffer = FunBuffer(self.n_steps, self.observation_space, self.action_space, device="cpu", **sizes)
        self.memory = self.policy.empty_memory(self.n_envs)
        self._last_lstm_states: Any = ()  # sb3-contrib's, which ``memory`` stands in for
        # Goals reach over the end of a rollout: observations and goals of the last c - 1 steps before this one.
        before = self.fun.horizon - 1
        self._tail_observations = th.zeros(before, self.n_envs, self.policy.spec.observations)
        self._tail_goals = th.zeros(before, self.n_envs, self.fun.goal_size)
        self.clip_range = FloatSchedule(self.clip_range)

    # -- collecting ----------------------------------------------------------------------------------------------------
    def collect_rollouts(
        self, env: VecEnv, callback: BaseCallback, rollout_buffer: RolloutBuffer, n_rollout_steps: int
    ) -> bool:
        """Step the environments and fill the buffer; see SB3. False if the callback wants to stop."""
        self.policy.set_training_mode(False)
        # The last c - 1 steps of the rollout before this one.
        rollout = as_tensor(self.rollout_buffer.observations)
        self._tail_observations = th.cat([self._tail_observations, rollout])[len(rollout) :]
        self._tail_goals = th.cat([self._tail_goals, self.rollout_buffer.goals])[len(rollout) :]
        rollout_buffer.reset()
        callback.on_rollout_start()
        for _ in range(n_rollout_steps):
            if not self._collect_step(env, callback):
                return False
        callback.on_rollout_end()
        return True

    def _collect_step(self, env: VecEnv, callback: BaseCallback) -> bool:
        assert isinstance(self.action_space, spaces.Box)
        buffer = self.rollout_buffer
        observations, starts = np.asarray(self._last_obs, np.float32), np.asarray(self._last_episode_starts, bool)
        self.memory.forget(th.from_numpy(starts))
        buffer.add_memory(self.memory)
        step = self.policy.step(th.from_numpy(observations), self.memory, random_goals=self.fun.random_goals)
        actions = step.actions.numpy()
        new, rewards, dones, infos = env.step(np.clip(actions, self.action_space.low, self.action_space.high))
        self.num_timesteps += env.num_envs
        callback.update_locals(locals())
        if not callback.on_step():
            return False
        self._update_info_buffer(infos, dones)
        worker, manager = self._rewards(rewards, dones, infos)
        buffer.add_levels(step, manager, dones)
        buffer.add(observations, actions, worker, starts, step.worker_values, step.log_probs)
        self._last_obs, self._last_episode_starts = new, dones  # type: ignore[assignment]
        return True

    def _rewards(
        self, rewards: NDArray[Any], dones: NDArray[Any], infos: list[dict[str, Any]]
    ) -> tuple[Floats, Floats]:
        """Return Worker's and Manager's rewards (n,): at a time limit what would have come is added, as in SB3."""
        worker, manager = rewards.astype(np.float32), rewards.astype(np.float32)
        ended = np.flatnonzero(dones)
        if len(ended):
            last = as_tensor([infos[i]["terminal_observation"] for i in ended])
            self.rollout_buffer.last_observations.append((self.rollout_buffer.pos, ended, last))
            cut = np.array([infos[i].get("TimeLimit.truncated", False) for i in ended])
            if cut.any():
                after = self.policy.step(last, self.memory.copy(th.from_numpy(ended)), deterministic=True)
                worker[ended] += self.gamma * cut * after.worker_values.numpy()
                manager[ended] += self.fun.manager_gamma * cut * after.manager_values.numpy()
        return worker, manager

    # -- learning ------------------------------------------------------------------------------------------------------
    @th.no_grad()
    def rollout(self) -> FunRollout:
        """Return the collected steps as sequences, environments end to end, with all that the two losses need."""
        buffer, c = self.rollout_buffer, self.fun.horizon
        states, following = self._states()
        intrinsic = intrinsic_rewards(states, following, th.cat([self._tail_goals, buffer.goals]), buffer.clock, c)
        ways, known = directions(states[c - 1 :], following, buffer.ends, c)
        worker, manager = self._returns(intrinsic)
        bounds, first_states = buffer.sequences()
        transitions = {name: getattr(buffer, name) for name in ("observations", "actions", "log_probs", "values")}
        transitions |= {"advantages": worker[0], "returns": worker[1], "hidden": buffer.worker_states}
        levels = {
            "pooled": buffer.pooled,
            "directions": ways,
            "known": known,
            "old_cosines": functional.cosine_similarity(ways, buffer.own_goals, dim=-1),
            "manager_advantages": _standardised(th.from_numpy(manager[0]), known),
            "manager_returns": th.from_numpy(manager[1]),
            "clock": buffer.clock,
            "intrinsic": intrinsic,
        }
        columns: dict[str, Any] = {name: env_major(as_tensor(array)).numpy() for name, array in transitions.items()}
        columns |= {name: env_major(tensor) for name, tensor in levels.items()}
        explained = float(explained_variance(buffer.manager_values.numpy().ravel(), manager[1].ravel()))
        self._rollout = FunRollout(**columns, bounds=bounds, manager_states=first_states, manager_explained=explained)
        return self._rollout

    def _returns(self, intrinsic: th.Tensor) -> tuple[tuple[Floats, Floats], tuple[Floats, Floats]]:
        """Return advantages and returns (t, n) of Worker, from R + alpha R^I, and of Manager, from R alone."""
        buffer, fun = self.rollout_buffer, self.fun
        last = self.policy.step(as_tensor(self._last_obs), self.memory.copy(), deterministic=True)
        rewards, ends = buffer.rewards + fun.intrinsic_weight * intrinsic.numpy(), buffer.ends.numpy()
        worker = advantages_and_returns(rewards, buffer.values, last.worker_values, ends, self.gamma, self.gae_lambda)
        rewards, values, after = buffer.manager_rewards.numpy(), buffer.manager_values.numpy(), last.manager_values
        manager = advantages_and_returns(rewards, values, after, ends, fun.manager_gamma, fun.manager_gae_lambda)
        return worker, manager

    def _states(self) -> tuple[th.Tensor, th.Tensor]:
        """Return Manager's states from c - 1 steps before the rollout on, (c - 1 + t, n, d), and each step's next."""
        buffer, now = self.rollout_buffer, as_tensor(self._last_obs)[None]
        states = self.policy.states(th.cat([self._tail_observations, as_tensor(buffer.observations), now]))
        following = states[self.fun.horizon :].clone()  # (t, n, d)
        for step, ended, observations in buffer.last_observations:
            following[step, ended] = self.policy.states(observations)
        return states[:-1], following

    def losses(self, batch: Minibatch, data: dict[str, th.Tensor]) -> tuple[th.Tensor, dict[str, float]]:
        """Return Worker's loss, PPO's on A^D, plus Manager's; neither has a gradient in the other's network."""
        worker, log = super().losses(batch, data)
        manager, manager_log = self.manager_losses(batch)
        return worker + manager, {**log, **manager_log}

    def evaluate_sequences(self, batch: Minibatch, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """Return V^D, log probabilities and entropies of Worker at the real steps of a minibatch, (m,) each."""
        pooled = self._rollout.pooled[batch.rows]
        distribution, values = self.policy.act_towards(batch.observations, batch.hidden, batch.mask, pooled)
        return values, distribution.log_prob(actions).sum(-1), distribution.entropy().sum(-1)

    def manager_losses(self, batch: Minibatch) -> tuple[th.Tensor, dict[str, float]]:
        """Return the clipped transition policy gradient plus V^M's loss, and its parts by name for logging."""
        rollout, rows = self._rollout, batch.rows
        first = rows[: batch.mask.shape[1]]  # rows go step by step, and every sequence has a first
        states, clock = rollout.states_before(first), rollout.clock[first]
        goals, values = self.policy.set_goals(batch.observations, states, clock, batch.mask)
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
        self.logger.record("train/intrinsic", float(self._rollout.intrinsic.mean()))
        self.logger.record("train/manager_explained_variance", self._rollout.manager_explained)


def _standardised(advantages: th.Tensor, known: th.Tensor) -> th.Tensor:
    """Scale to mean 0 and deviation 1 over the steps that Manager learns from; a minibatch has few sequences."""
    learnt = advantages[known]
    return advantages if len(learnt) < 2 else (advantages - learnt.mean()) / (learnt.std() + 1e-8)
