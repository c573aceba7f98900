"""`sac` and `sac_large_buffer`: SB3's SAC, flat, on the environment's own reward (section 4.3).

The paper compares with SAC of Unity's toolkit, whose replay buffer holds 50,000 transitions; SB3's holds a million. At
the same number of environment steps and within the hour that every method has, one gradient step follows every other
step of all environments together.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from pydantic import NonNegativeInt, PositiveFloat, PositiveInt
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn
from stable_baselines3.sac.policies import Actor, SACPolicy

from lunar_rescue.physics.robot import JOINTS
from lunar_rescue.scenes.records import checked
from reproduce.learning.config import PolicyConfig, Share, TrainingConfig
from reproduce.learning.networks import NoOptimizer, Standardiser, flat_spaces, observe_all
from reproduce.learning.policy import Actions, MirroredPolicy, Observations, load_only_network
from reproduce.learning.sequence_ppo import check_losses
from reproduce.learning.training import EpisodeLog, Training, make_environments
from reproduce.learning.way_in import view_size
from reproduce.storage.checkpoint import module_tensors, optimizer_tensors, restore_module, restore_optimizer
from reproduce.storage.policies import Spec
from reproduce.storage.records import Units

LEVEL = "actor"  # name of the one learner, in checkpoints and run folders
EACH_STEP = TrainFreq(1, TrainFrequencyUnit.STEP)
_BUFFER = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


@checked
@dataclass(frozen=True)
class SacConfig:
    """What only SAC has; SB3's defaults where nothing is said."""

    buffer_size: PositiveInt = 50_000  # Transitions in the replay buffer; ML-Agents' default and the paper's
    batch_size: PositiveInt = 256  # Transitions in a gradient step
    train_every: PositiveInt = 2  # Steps of all environments between learning: what fits into the hour of every method
    gradient_steps: PositiveInt = 1  # Gradient steps each time; SB3's default
    learning_starts: NonNegativeInt = 10_000  # Environment steps before the first gradient step
    learning_rate: PositiveFloat = 3.0e-4  # Learning rate of actor, critics and entropy weight
    tau: Share = 0.005  # Share of the critics that goes into the target critics after each gradient step
    hidden_units: Units = 128  # Units of both layers of actor and critics; paper, section 4.1. SB3's 256 are slower
    gamma: Share = 0.99  # Discount; paper, section 4.1
    first_ent_coef: PositiveFloat = 1.0  # Entropy weight at the beginning; it is learnt (SB3's "auto" begins with 1)
    n_steps: PositiveInt = 128  # Steps of an environment to a row of `progress.csv` and new standardisation


@checked
@dataclass(frozen=True)
class SacTrainingConfig(TrainingConfig):
    """A training of SAC, which is flat: one learner."""

    sac: SacConfig = field(default_factory=SacConfig)  # What only SAC has


class StandardisedExtractor(BaseFeaturesExtractor):
    """Standardises observations (d,), as the other methods' networks do."""

    def __init__(self, observation_space: spaces.Box) -> None:
        size = observation_space.shape[0]
        super().__init__(observation_space, size)
        self.standardiser = Standardiser(size)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Standardise observations (n, d) by their statistics so far."""
        standardised: th.Tensor = self.standardiser(observations)
        return standardised


# Without a schema of its own pydantic would make a ``Spec``, which builds nothing.
@checked
@dataclass(frozen=True)
class SacSpec(Spec):
    """Sizes, which are all that is needed to build the actor."""

    def build(self) -> Actor:
        """Make an actor of these sizes, not trained."""
        seen, acts = flat_spaces(self.observations, self.actions)
        more: Any = {"optimizer_class": NoOptimizer, **policy_arguments(self.hidden_units)}
        return SACPolicy(seen, acts, lambda _: 0.0, **more).actor


def policy_arguments(hidden_units: int) -> dict[str, Any]:
    """Return the arguments of SB3's SAC policy for two layers of ``hidden_units``."""
    return {"net_arch": [hidden_units, hidden_units], "features_extractor_class": StandardisedExtractor}


class CheckpointedSAC(SAC):
    """SB3's SAC, unchanged, with a checkpoint that holds its replay buffer too."""

    where = "SAC"  # name of the learner and number of the update, for errors; a training sets it
    replay_buffer: ReplayBuffer
    log_ent_coef: th.Tensor

    def _optimizers(self) -> dict[str, Any]:
        networks = {"actor_optimizer": self.actor.optimizer, "critic_optimizer": self.critic.optimizer}
        return {**networks, "entropy_optimizer": self.ent_coef_optimizer}

    def state_tensors(self) -> dict[str, th.Tensor]:
        """Return weights, moments of the optimisers and the filled part of the buffer; see ``checkpoint.Learner``."""
        tensors = {**module_tensors("policy", self.policy), "log_ent_coef": self.log_ent_coef.detach().clone()}
        for name, optimizer in self._optimizers().items():
            tensors |= optimizer_tensors(name, optimizer)
        rows = self.replay_buffer.size()
        return tensors | {f"buffer.{name}": th.from_numpy(getattr(self.replay_buffer, name)[:rows]) for name in _BUFFER}

    def state_numbers(self) -> dict[str, Any]:
        """Return the buffer's position and the count of gradient steps; see ``checkpoint.Learner``."""
        return {"pos": self.replay_buffer.pos, "full": self.replay_buffer.full, "updates": self._n_updates}

    def load_state(self, tensors: dict[str, th.Tensor], numbers: dict[str, Any]) -> None:
        """Go on from what ``state_tensors`` and ``state_numbers`` returned; see ``checkpoint.Learner``."""
        restore_module("policy", self.policy, tensors)
        for name, optimizer in self._optimizers().items():
            restore_optimizer(name, optimizer, tensors)
        self.log_ent_coef.data.copy_(tensors["log_ent_coef"])
        buffer = self.replay_buffer
        for name in _BUFFER:
            rows = tensors[f"buffer.{name}"].numpy()
            getattr(buffer, name)[: len(rows)] = rows
        buffer.pos, buffer.full, self._n_updates = int(numbers["pos"]), bool(numbers["full"]), int(numbers["updates"])

    def collect(self, env: Any, callback: BaseCallback) -> None:
        """Step all environments once, by the actor from the first step on: what it draws can be repeated."""
        self.collect_rollouts(env, callback, EACH_STEP, self.replay_buffer, learning_starts=0, log_interval=None)

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """Take gradient steps on minibatches of the buffer; ``RunFailedError`` at a loss that is not finite."""
        for _ in range(gradient_steps):
            super().train(1, batch_size)
            check_losses(self.where, self.logger.name_to_value)


def make_sac(env: Any, config: SacConfig, seed: int) -> CheckpointedSAC:
    """Make the learner for SB3's environments."""
    same: Any = {name: getattr(config, name) for name in ("learning_rate", "buffer_size", "batch_size", "tau", "gamma")}
    same |= {"policy_kwargs": policy_arguments(config.hidden_units), "ent_coef": f"auto_{config.first_ent_coef}"}
    learner = CheckpointedSAC("MlpPolicy", env, seed=seed, device="cpu", **same)
    learner.set_logger(Logger(folder=None, output_formats=[]))
    return learner


class BusyEpisodeLog(EpisodeLog):
    """Lets the learner learn while the workers step; what they step to is in the replay buffer only afterwards."""

    meanwhile: Callable[[], None] | None = None  # called in each step before the workers are waited for

    def step_wait(self) -> VecEnvStepReturn:
        """Learn first, then wait for the environments."""
        if self.meanwhile is not None:
            self.meanwhile()
        return super().step_wait()


class SacTraining(Training):
    """Trains SAC; an ``update`` takes as many environment steps as those of the other methods."""

    config: SacTrainingConfig
    logged = ("actor_loss", "critic_loss", "ent_coef")

    def __init__(self, config: SacTrainingConfig, seed: int) -> None:
        venv = make_environments(config, seed)
        env = BusyEpisodeLog(venv, config.priors.set_point_changes)
        self.learner = make_sac(env, config.sac, seed)
        super().__init__(config, venv, env, self.learner, {LEVEL: self.learner}, config.sac.n_steps)

    def update(self, done: int) -> dict[str, Any]:
        """Step the environments and learn meanwhile; ``done`` steps were taken before."""
        self.follow_schedule(done)
        sac, observations = self.config.sac, []
        for step in range(sac.n_steps):
            observations.append(np.asarray(self.learner._last_obs, np.float32))
            taken = done // self.config.n_envs + step  # steps of each environment
            learns = taken * self.config.n_envs >= max(sac.learning_starts, 1) and taken % sac.train_every == 0
            self.env.meanwhile = partial(self.learner.train, sac.gradient_steps, sac.batch_size) if learns else None
            self.learner.collect(self.env, self.callback)
        observe_all(self.learner.policy, np.concatenate(observations))
        return self.row()

    def networks(self) -> dict[str, tuple[SacSpec, Actor]]:
        """Return the actor with its sizes; see ``Training``."""
        units = self.config.sac.hidden_units
        return {LEVEL: (SacSpec(view_size(self.config.seen_places), JOINTS, units), self.learner.actor)}


class SacPolicy(MirroredPolicy):
    """Acts by the actor's mean; it has no memory."""

    def __init__(self, actor: BasePolicy, config: PolicyConfig) -> None:
        """Make a policy that acts in no environment yet; see ``MirroredPolicy``."""
        super().__init__(config)
        self.network = actor

    def outputs(self, observations: Observations, starts: NDArray[np.bool_]) -> Actions:
        """Return the mean actions; see ``MirroredPolicy``."""
        with th.no_grad():
            means: Actions = self.network._predict(th.from_numpy(observations), deterministic=True).numpy()
        return means


def load_sac_policy(folder: Path) -> SacPolicy:
    """Read the policy of a run folder; see ``load_only_network``."""
    return SacPolicy(*load_only_network(folder, LEVEL, SacSpec))
