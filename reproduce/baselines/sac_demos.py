"""`sac_demos`: off-policy learning with demonstrations in the buffer, as RLPD has it (Ball et al. 2023).

The actor first imitates the planner's rescues. Then critics learn on the demonstrations alone, and in the end both
learn on minibatches of which a fixed share are demonstrations, with layers normalised in the critics, returns of
several steps, and an imitation loss that stays. There is no entropy weight: noise as large as SAC's undoes what was
imitated (see the training log), so the actor is deterministic and explores with small noise, which is SB3's TD3.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.td3.policies import Actor, TD3Policy
from torch.nn import functional

from lunar_rescue.physics.robot import JOINTS
from lunar_rescue.scenes.records import checked
from reproduce.baselines.demonstrated_td3 import OffPolicyConfig, make_td3
from reproduce.baselines.sac import BusyEpisodeLog, SacPolicy, policy_arguments
from reproduce.learning.config import ImitationConfig, TrainingConfig
from reproduce.learning.demonstrations import PlayedBack
from reproduce.learning.imitation import lower_rate
from reproduce.learning.networks import NoOptimizer, flat_spaces, observe_all
from reproduce.learning.policy import load_only_network
from reproduce.learning.training import Training, make_environments
from reproduce.learning.way_in import view_size
from reproduce.storage.policies import Spec

LEVEL = "actor"


@checked
@dataclass(frozen=True)
class SacDemosConfig(TrainingConfig):
    """A training off policy that begins from demonstrations."""

    imitation: ImitationConfig = field(default_factory=ImitationConfig)  # What it imitates first, and how long
    off_policy: OffPolicyConfig = field(default_factory=OffPolicyConfig)  # What comes after

    @property
    def discount(self) -> float:
        """Return the discount of the demonstrations' returns."""
        return self.off_policy.gamma


# Without a schema of its own pydantic would make a ``Spec``, which builds nothing.
@checked
@dataclass(frozen=True)
class ActorSpec(Spec):
    """Sizes, which are all that is needed to build the actor."""

    def build(self) -> Actor:
        """Make an actor of these sizes, not trained."""
        seen, acts = flat_spaces(self.observations, self.actions)
        more: Any = {"optimizer_class": NoOptimizer}
        return TD3Policy(seen, acts, lambda _: 0.0, **policy_arguments(self.hidden_units), **more).actor


class SacDemosTraining(Training):
    """Imitates, then learns off policy; an ``update`` takes as many environment steps as those of other methods."""

    config: SacDemosConfig
    logged = ("actor_loss", "critic_loss")

    def __init__(self, config: SacDemosConfig, seed: int) -> None:
        venv = make_environments(config, seed)
        env = BusyEpisodeLog(venv, config.priors.set_point_changes)
        self.learner = make_td3(env, config.off_policy, seed)
        super().__init__(config, venv, env, self.learner, {LEVEL: self.learner}, config.off_policy.n_steps)

    def imitate(self, played: Sequence[PlayedBack], seed: int) -> Iterator[dict[str, Any]]:
        """Imitate demonstrations, then let the critics learn on them; see ``Training``."""
        learner, how, rng = self.learner, self.config.imitation, np.random.default_rng(seed)
        learner.remember(played)
        seen, wanted = learner.demonstrations.observations[:, 0], learner.wanted
        observe_all(learner.policy, seen)
        optimizer = th.optim.Adam(learner.actor.parameters(), lr=how.learning_rate)
        for epoch in range(how.epochs):
            losses, order = [], np.array_split(rng.permutation(len(seen)), math.ceil(len(seen) / how.transitions))
            for index, rows in enumerate(order):
                lower_rate(optimizer, how, (epoch + index / len(order)) / how.epochs)
                loss = functional.mse_loss(learner.actor(th.from_numpy(seen[rows])), th.from_numpy(wanted[rows]))
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
                losses.append(loss.item())
            yield {"level": LEVEL, "epoch": epoch + 1, "imitation_loss": float(np.mean(losses)), "value_loss": np.nan}
        learner.actor_target.load_state_dict(learner.actor.state_dict())
        for _ in range(self.config.off_policy.critic_first):
            learner.critic_step(self.config.off_policy.batch_size, own=False)

    def update(self, done: int) -> dict[str, Any]:
        """Step the environments and learn meanwhile; ``done`` steps were taken before."""
        self.follow_schedule(done)
        how = self.config.off_policy
        first, last = how.imitation_weight, how.final_imitation_weight
        share = done / max(1, self.config.steps)
        self.learner.imitation_weight = first * (last / first) ** share if first and last else first * (1.0 - share)
        for step in range(how.n_steps):
            learns = done or step  # with the first step nothing is in the buffer yet
            self.env.meanwhile = partial(self.learner.train, how.gradient_steps, how.batch_size) if learns else None
            self.learner.collect(self.env, self.callback)
        return self.row()

    def networks(self) -> dict[str, tuple[ActorSpec, Actor]]:
        """Return the actor with its sizes; see ``Training``."""
        units = self.config.off_policy.hidden_units
        return {LEVEL: (ActorSpec(view_size(self.config.seen_places), JOINTS, units), self.learner.actor)}


def load_sac_demos_policy(folder: Path) -> SacPolicy:
    """Read the policy of a run folder; see ``load_only_network``."""
    return SacPolicy(*load_only_network(folder, LEVEL, ActorSpec))
