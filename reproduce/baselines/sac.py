"""`sac` and `sac_large_buffer`: SB3's SAC, flat, on the environment's own reward (section 4.3).

The paper compares with SAC of Unity's toolkit, whose replay buffer holds 50,000 transitions; SB3's holds a million. At
the same number of environment steps and within the hour that every method has, one gradient step follows every other
step of all environments together.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn
from stable_baselines3.sac.policies import Actor, SACPolicy

from lunar_rescue.observation import SIZE
from lunar_rescue.physics.robot import JOINTS
from reproduce.baselines.recurrent_ppo import EpisodeLog
from reproduce.learning.config import SacConfig, TrainingConfig
from reproduce.learning.policy import Actions, MirroredPolicy, Observations
from reproduce.learning.standardiser import Standardiser
from reproduce.learning.training import CollectedTraining, make_environments
from reproduce.storage.checkpoint import module_tensors, optimizer_tensors, restore_module, restore_optimizer

LEVEL = "actor"
EACH_STEP = TrainFreq(1, TrainFrequencyUnit.STEP)
_BUFFER = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


class StandardisedExtractor(BaseFeaturesExtractor):
    """Standardised observations, as the other methods' networks have them."""

    def __init__(self, observation_space: spaces.Box) -> None:
        """Make it.

        Args:
            observation_space: Flat observations (d,).
        """
        size = observation_space.shape[0]
        super().__init__(observation_space, size)
        self.standardiser = Standardiser(size)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """(n, d) to (n, d)."""
        standardised: th.Tensor = self.standardiser(observations)
        return standardised


@dataclass(frozen=True)
class SacSpec:
    """All that is needed to build the actor.

    Attributes:
        observations: Size of the flat observation.
        actions: Size of the action.
        hidden_units: Units of each of its two layers.
    """

    observations: int
    actions: int
    hidden_units: int

    def build(self) -> Actor:
        """Make the actor, untrained."""
        box = spaces.Box(-np.inf, np.inf, (self.observations,), np.float32)
        act = spaces.Box(-1.0, 1.0, (self.actions,), np.float32)
        return SACPolicy(box, act, lambda _: 0.0, **policy_arguments(self.hidden_units)).actor


def policy_arguments(hidden_units: int) -> dict[str, Any]:
    """What SB3's SAC policy takes."""
    return {"net_arch": [hidden_units, hidden_units], "features_extractor_class": StandardisedExtractor}


class KeptSAC(SAC):
    """SB3's SAC, unchanged, with standardised observations and a checkpoint that holds its replay buffer too."""

    def state_tensors(self) -> dict[str, th.Tensor]:
        """See ``reproduce.storage.checkpoint.Learner``."""
        assert self.replay_buffer is not None
        assert self.ent_coef_optimizer is not None and self.log_ent_coef is not None
        rows = self.replay_buffer.buffer_size if self.replay_buffer.full else self.replay_buffer.pos
        return {
            **module_tensors("policy", self.policy),
            **optimizer_tensors("actor_optimizer", self.actor.optimizer),
            **optimizer_tensors("critic_optimizer", self.critic.optimizer),
            **optimizer_tensors("entropy_optimizer", self.ent_coef_optimizer),
            "log_ent_coef": self.log_ent_coef.detach().clone(),
            **{f"buffer.{name}": th.from_numpy(getattr(self.replay_buffer, name)[:rows]) for name in _BUFFER},
        }

    def state_numbers(self) -> dict[str, Any]:
        """See ``reproduce.storage.checkpoint.Learner``."""
        assert self.replay_buffer is not None
        return {"pos": self.replay_buffer.pos, "full": self.replay_buffer.full, "updates": self._n_updates}

    def load_state(self, tensors: dict[str, th.Tensor], numbers: dict[str, Any]) -> None:
        """See ``reproduce.storage.checkpoint.Learner``."""
        buffer = self.replay_buffer
        assert buffer is not None and self.ent_coef_optimizer is not None and self.log_ent_coef is not None
        restore_module("policy", self.policy, tensors)
        restore_optimizer("actor_optimizer", self.actor.optimizer, tensors)
        restore_optimizer("critic_optimizer", self.critic.optimizer, tensors)
        restore_optimizer("entropy_optimizer", self.ent_coef_optimizer, tensors)
        self.log_ent_coef.data.copy_(tensors["log_ent_coef"])
        for name in _BUFFER:
            kept = tensors[f"buffer.{name}"].numpy()
            getattr(buffer, name)[: len(kept)] = kept
        buffer.pos, buffer.full, self._n_updates = int(numbers["pos"]), bool(numbers["full"]), int(numbers["updates"])

    def collect(self, env: Any, callback: BaseCallback) -> None:
        """Step all environments once, by the actor from the beginning: what it draws can be repeated."""
        assert self.replay_buffer is not None
        self.collect_rollouts(env, callback, EACH_STEP, self.replay_buffer, learning_starts=0, log_interval=None)

    def observe(self, observations: NDArray[np.float32]) -> None:
        """Let standardisers see observations (m, d)."""
        seen = th.from_numpy(observations)
        for module in self.policy.modules():
            if isinstance(module, Standardiser):
                module.observe(seen)


def make_sac(env: Any, config: SacConfig, seed: int) -> KeptSAC:
    """The learner as SB3 knows it."""
    learner = KeptSAC(
        "MlpPolicy",
        env,
        learning_rate=config.learning_rate,
        buffer_size=config.buffer_size,
        batch_size=config.batch_size,
        tau=config.tau,
        gamma=config.gamma,
        ent_coef=f"auto_{config.first_ent_coef}",
        policy_kwargs=policy_arguments(config.hidden_units),
        seed=seed,
        device="cpu",
    )
    learner.set_logger(Logger(folder=None, output_formats=[]))
    return learner


class BusyEpisodeLog(EpisodeLog):
    """Lets the learner learn while the workers step; what they step to is in the replay buffer only afterwards."""

    def __init__(self, venv: Any) -> None:
        """Wrap environments."""
        super().__init__(venv)
        #: What the parent does in the steps to come until it waits for the workers.
        self.meanwhile: Callable[[], None] | None = None

    def step_wait(self) -> VecEnvStepReturn:
        """Learn, then wait."""
        if self.meanwhile is not None:
            self.meanwhile()
        return super().step_wait()


class SacTraining(CollectedTraining):
    """Trains SAC; an ``update`` is as many environment steps as one of the other methods'."""

    logged = ("actor_loss", "critic_loss", "ent_coef")

    def __init__(self, config: TrainingConfig, seed: int) -> None:
        """Start environments and learner."""
        venv = make_environments(config, seed)
        env = BusyEpisodeLog(venv)
        self.learner = make_sac(env, config.sac, seed)
        super().__init__(config, venv, env, self.learner, {LEVEL: self.learner})

    @property
    def steps_per_update(self) -> int:
        """Environment steps of one update."""
        return self.config.sac.n_steps * self.config.n_envs

    def update(self, done: int) -> dict[str, Any]:
        """Step, and learn meanwhile; ``done`` steps were taken before."""
        self.follow_schedule(done)
        sac, seen = self.config.sac, []
        for step in range(sac.n_steps):
            seen.append(np.asarray(self.learner._last_obs, np.float32))
            taken = done // self.config.n_envs + step  # by each environment
            learns = taken * self.config.n_envs >= max(sac.learning_starts, 1) and taken % sac.train_every == 0
            self.env.meanwhile = self._learn if learns else None
            self.learner.collect(self.env, self.callback)
        self.learner.observe(np.concatenate(seen))
        return self.row()

    def _learn(self) -> None:
        self.learner.train(self.config.sac.gradient_steps, self.config.sac.batch_size)

    def networks(self) -> dict[str, tuple[SacSpec, Actor]]:
        """The actor; see ``Training``."""
        return {LEVEL: (SacSpec(SIZE, JOINTS, self.config.sac.hidden_units), self.learner.actor)}


class SacPolicy(MirroredPolicy):
    """Acts by the actor's mean; it has no memory."""

    def __init__(self, actor: Actor, mirrored: bool = True) -> None:
        """Keep the network.

        Args:
            actor: Trained.
            mirrored: Whether it sees scenes through ``reproduce.learning.mirror``.
        """
        super().__init__(mirrored)
        self._actor = actor

    def begin(self, count: int) -> None:
        """Nothing is remembered."""

    def outputs(self, observations: Observations, starts: NDArray[np.bool_]) -> Actions:
        """See ``MirroredPolicy``."""
        with th.no_grad():
            means: Actions = self._actor(th.from_numpy(observations), deterministic=True).numpy()
        return means
