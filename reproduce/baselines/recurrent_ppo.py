"""`ppo_lstm`: one recurrent PPO network on the environment's own reward; shows what the hierarchy adds."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lunar_rescue.physics.robot import JOINTS
from reproduce.learning.config import PolicyConfig, RecurrentConfig
from reproduce.learning.demonstrations import PlayedBack
from reproduce.learning.imitation import Example
from reproduce.learning.networks import Memory, NetworkSpec, RecurrentNetwork
from reproduce.learning.policy import Actions, MirroredPolicy, Observations, load_only_network
from reproduce.learning.training import EpisodeLog, RecurrentTraining, imitate, make_environments, make_learner
from reproduce.learning.way_in import view_size

LEVEL = "policy"  # name of the one learner, in checkpoints and run folders


class FlatPolicy(MirroredPolicy):
    """One recurrent network, acting every step by its mean."""

    def __init__(self, network: RecurrentNetwork, config: PolicyConfig) -> None:
        """Make a policy that acts in no environment yet; see ``MirroredPolicy``."""
        super().__init__(config)
        self.network = network

    def begin(self, count: int) -> None:
        """Begin with empty memories of ``count`` environments; see ``MirroredPolicy``."""
        self._memory = Memory(self.network, count)

    def outputs(self, observations: Observations, starts: NDArray[np.bool_]) -> Actions:
        """Return the mean outputs (n, JOINTS); see ``MirroredPolicy``."""
        self._memory.forget(starts)
        return self._memory.act(observations, np.arange(len(observations)))


def load_flat_policy(folder: Path) -> FlatPolicy:
    """Read the policy of a run folder; see ``load_only_network``."""
    return FlatPolicy(*load_only_network(folder, LEVEL, NetworkSpec))


class FlatTraining(RecurrentTraining):
    """Trains one recurrent network; an ``update`` is one rollout and one training on it."""

    def __init__(self, config: RecurrentConfig, seed: int) -> None:
        venv = make_environments(config, seed)
        env = EpisodeLog(venv, config.priors.set_point_changes)
        self.learner = make_learner(env, config.low, seed, bounded_mean=False)
        super().__init__(config, venv, env, self.learner, {LEVEL: self.learner})

    def imitate(self, played: Sequence[PlayedBack], seed: int) -> Iterator[dict[str, Any]]:
        """Imitate demonstrations; see ``Training``."""
        examples = [Example(one.observations, one.outputs, one.returns, one.begin) for one in played]
        yield from imitate(LEVEL, self.learner.policy, examples, self.config.imitation, seed)

    def networks(self) -> dict[str, tuple[NetworkSpec, RecurrentNetwork]]:
        """Return the one network with its sizes; see ``Training``."""
        return {
            LEVEL: (
                NetworkSpec(view_size(self.config.seen_places), JOINTS, self.config.low.hidden_units, False),
                self.learner.policy,
            )
        }
