"""SB3's TD3 with demonstrations in a buffer of their own and an imitation loss: the learner of `sac_demos`."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th
from pydantic import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt
from stable_baselines3 import TD3
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.torch_layers import create_mlp
from stable_baselines3.common.utils import polyak_update
from stable_baselines3.td3.policies import TD3Policy
from torch import nn
from torch.nn import functional

from lunar_rescue.physics.robot import JOINTS
from lunar_rescue.scenes.records import checked
from reproduce.baselines.sac import EACH_STEP, policy_arguments
from reproduce.learning.config import Share
from reproduce.learning.demonstrations import PlayedBack
from reproduce.learning.sequence_ppo import check_losses
from reproduce.storage.checkpoint import module_tensors, optimizer_tensors, restore_module, restore_optimizer
from reproduce.storage.records import Units

_BUFFER = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
_BUFFERS = ("replay_buffer", "demonstrations")
_OPTIMIZED = ("actor", "critic")


@checked
@dataclass(frozen=True)
class OffPolicyConfig:
    """How it learns off policy, from what it did and what was demonstrated."""

    buffer_size: PositiveInt = 1_000_000  # Transitions of its own that are kept
    batch_size: PositiveInt = 256  # Transitions in a gradient step
    demonstration_share: Share = 0.5  # Share of a minibatch that are demonstrations; RLPD's
    gradient_steps: PositiveInt = 2  # Gradient steps for each step of all environments
    critic_first: NonNegativeInt = 4_000  # Gradient steps of the critics alone, on demonstrations, before anything else
    imitation_weight: NonNegativeFloat = 10.0  # Weight of the imitation loss beside a mean value scaled to one
    final_imitation_weight: NonNegativeFloat = 10.0  # The same at the last step; geometric between
    actor_learning_rate: PositiveFloat = 1.0e-4  # Learning rate of the actor, after imitation
    critic_learning_rate: PositiveFloat = 3.0e-4  # Learning rate of the critics
    policy_delay: PositiveInt = 2  # Steps of the critics to one of the actor; TD3's
    tau: Share = 0.005  # Share of the networks that goes into the target networks; TD3's
    noise: PositiveFloat = 0.05  # Standard deviation of exploration, a share of the largest change in a step
    target_noise: PositiveFloat = 0.05  # The same on the actions that targets are of; TD3's is 0.2
    returns: PositiveInt = 5  # Steps whose rewards are added up before the critics' estimate
    gamma: Share = 0.99  # Discount; paper, section 4.1
    hidden_units: Units = 256  # Units of both layers of actor and critics; SB3's
    n_steps: PositiveInt = 128  # Steps of an environment to a row of `progress.csv`


class NormalisedCritic(ContinuousCritic):
    """SB3's critics with normalised layers, which keep values of actions that nobody took from growing."""

    def __init__(self, observation_space: Any, action_space: Any, net_arch: list[int], **more: Any) -> None:
        super().__init__(observation_space, action_space, net_arch, **more)
        sizes = more["features_dim"] + action_space.shape[0], 1, net_arch
        for index in range(len(self.q_networks)):
            network = nn.Sequential(*create_mlp(*sizes, more["activation_fn"], post_linear_modules=[nn.LayerNorm]))
            self.q_networks[index] = network
            setattr(self, f"qf{index}", network)


class DemonstratedPolicy(TD3Policy):
    """TD3's networks with ``NormalisedCritic``."""

    def make_critic(self, features_extractor: Any = None) -> ContinuousCritic:
        """Make the critics; see SB3."""
        arguments = self._update_features_extractor(self.critic_kwargs, features_extractor)
        return NormalisedCritic(**arguments).to(self.device)


class DemonstratedTD3(TD3):
    """SB3's TD3 on its own transitions and on demonstrations, with an imitation loss."""

    where = "TD3"  # name of the learner and number of the update, for errors; a training sets it
    replay_buffer: NStepReplayBuffer
    imitation_weight = 0.0
    share = 0.5

    def __init__(self, *args: Any, **more: Any) -> None:
        super().__init__(*args, **more)
        self.demonstrations = self.buffer(1, 1)
        self.wanted = np.zeros((0, JOINTS), np.float32)

    def buffer(self, size: int, envs: int) -> NStepReplayBuffer:
        """Make a buffer for so many transitions."""
        how: Any = {"n_steps": self.n_steps, "gamma": self.gamma, "handle_timeout_termination": True, "device": "cpu"}
        return NStepReplayBuffer(size, self.observation_space, self.action_space, n_envs=envs, **how)

    def remember(self, played: Sequence[PlayedBack]) -> None:
        """Put demonstrations, end to end, into a buffer of their own."""
        buffer = self.demonstrations = self.buffer(sum(len(one.rewards) for one in played), 1)
        seen = np.concatenate([one.observations for one in played])
        buffer.observations[:, 0] = seen
        # Where an episode ends nothing is expected of what comes next, so what stands there does not matter.
        buffer.next_observations[:, 0] = np.roll(seen, -1, axis=0)
        buffer.actions[:, 0] = np.concatenate([one.taken for one in played])
        buffer.rewards[:, 0] = np.concatenate([one.rewards for one in played])
        buffer.dones[np.cumsum([len(one.rewards) for one in played]) - 1, 0] = 1.0
        buffer.full = True
        self.wanted = np.concatenate([one.outputs for one in played])

    def collect(self, env: Any, callback: BaseCallback) -> None:
        """Step all environments once."""
        noise = self.action_noise
        self.collect_rollouts(env, callback, EACH_STEP, self.replay_buffer, noise, learning_starts=0)

    def train(self, gradient_steps: int, batch_size: int = 256) -> None:
        """Take gradient steps; ``RunFailedError`` at a loss that is not finite."""
        self.policy.set_training_mode(True)
        for _ in range(gradient_steps):
            self._n_updates += 1
            log = {"critic_loss": self.critic_step(batch_size)}
            if self._n_updates % self.policy_delay == 0:
                log["actor_loss"] = self.actor_step()
            check_losses(self.where, log)
            for name, value in log.items():
                self.logger.record(f"train/{name}", value)

    def critic_step(self, batch_size: int, own: bool = True) -> float:
        """Take one step of the critics and return their loss; ``own`` tells whether own transitions are learnt too."""
        own = own and self.replay_buffer.size() > self.n_steps
        shown = int(batch_size * self.share) if own else batch_size
        self._rows = th.randint(0, len(self.wanted), (shown,)).numpy()
        parts = [self.demonstrations._get_samples(self._rows)]
        parts += [self.replay_buffer.sample(batch_size - shown)] if own else []
        seen, acts, after, dones, rewards, discounts = (
            th.cat([getattr(part, name) for part in parts])
            for name in ("observations", "actions", "next_observations", "dones", "rewards", "discounts")
        )
        with th.no_grad():
            noise = th.randn_like(acts) * self.target_policy_noise
            noise = noise.clamp(-self.target_noise_clip, self.target_noise_clip)
            following = (self.actor_target(after) + noise).clamp(-1.0, 1.0)
            value = th.cat(self.critic_target(after, following), dim=1).min(dim=1, keepdim=True).values
            target = rewards + (1.0 - dones) * discounts * value
        loss: th.Tensor = sum((functional.mse_loss(q, target) for q in self.critic(seen, acts)), th.zeros(()))
        self.critic.optimizer.zero_grad()
        loss.backward()
        self.critic.optimizer.step()
        polyak_update(self.critic.parameters(), self.critic_target.parameters(), self.tau)
        self._seen = seen
        return loss.item()

    def actor_step(self) -> float:
        """Take one step of the actor in the states of the last step of the critics, and return its loss."""
        acts = self.actor(self._seen)
        value = self.critic.q1_forward(self._seen, acts)
        wanted = th.from_numpy(self.wanted[self._rows])
        # Scaled, so that the weight of imitation means the same whatever values are.
        loss = -(value / value.detach().abs().mean().clamp(min=1e-6)).mean()
        loss = loss + self.imitation_weight * functional.mse_loss(acts[: len(wanted)], wanted)
        self.actor.optimizer.zero_grad()
        loss.backward()
        th.nn.utils.clip_grad_norm_(self.actor.parameters(), 1.0)
        self.actor.optimizer.step()
        polyak_update(self.actor.parameters(), self.actor_target.parameters(), self.tau)
        return float(loss.item())

    def state_tensors(self) -> dict[str, th.Tensor]:
        """Return weights, moments of the optimisers and both buffers; see ``checkpoint.Learner``."""
        tensors = {**module_tensors("policy", self.policy), "wanted": th.from_numpy(self.wanted)}
        for name in _OPTIMIZED:
            tensors |= optimizer_tensors(f"{name}_optimizer", getattr(self, name).optimizer)
        for which in _BUFFERS:
            buffer = getattr(self, which)
            tensors |= {f"{which}.{name}": th.from_numpy(getattr(buffer, name)[: buffer.size()]) for name in _BUFFER}
        return tensors

    def state_numbers(self) -> dict[str, Any]:
        """Return the buffer's position and the count of gradient steps; see ``checkpoint.Learner``."""
        return {"pos": self.replay_buffer.pos, "full": self.replay_buffer.full, "updates": self._n_updates}

    def load_state(self, tensors: dict[str, th.Tensor], numbers: dict[str, Any]) -> None:
        """Go on from what ``state_tensors`` and ``state_numbers`` returned; see ``checkpoint.Learner``."""
        restore_module("policy", self.policy, tensors)
        for name in _OPTIMIZED:
            restore_optimizer(f"{name}_optimizer", getattr(self, name).optimizer, tensors)
        self.wanted = tensors["wanted"].numpy()
        self.demonstrations = self.buffer(max(1, len(self.wanted)), 1)
        self.demonstrations.full = True
        for which in _BUFFERS:
            for name in _BUFFER:
                rows = tensors[f"{which}.{name}"].numpy()
                getattr(getattr(self, which), name)[: len(rows)] = rows
        buffer = self.replay_buffer
        buffer.pos, buffer.full, self._n_updates = int(numbers["pos"]), bool(numbers["full"]), int(numbers["updates"])


def make_td3(env: Any, config: OffPolicyConfig, seed: int) -> DemonstratedTD3:
    """Make the learner for SB3's environments."""
    same: Any = {name: getattr(config, name) for name in ("buffer_size", "batch_size", "tau", "gamma", "policy_delay")}
    noise = NormalActionNoise(np.zeros(JOINTS), np.full(JOINTS, config.noise))
    same |= {"policy_kwargs": policy_arguments(config.hidden_units), "n_steps": config.returns, "action_noise": noise}
    same |= {"target_policy_noise": config.target_noise, "target_noise_clip": 2.0 * config.target_noise}
    same |= {"replay_buffer_kwargs": {"handle_timeout_termination": True}}
    learner = DemonstratedTD3(DemonstratedPolicy, env, seed=seed, device="cpu", **same)
    learner.share, learner.imitation_weight = config.demonstration_share, config.imitation_weight
    learner.actor.optimizer = th.optim.Adam(learner.actor.parameters(), lr=config.actor_learning_rate)
    learner.critic.optimizer = th.optim.Adam(learner.critic.parameters(), lr=config.critic_learning_rate)
    learner.set_logger(Logger(folder=None, output_formats=[]))
    return learner
