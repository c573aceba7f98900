"""What every method offers after training: a way to act on a batch of observations."""

from abc import abstractmethod
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lunar_rescue import LunarRescueEnv, Scene
from lunar_rescue.physics.robot import JOINTS
from reproduce.learning.actions import environment_actions
from reproduce.learning.config import PolicyConfig
from reproduce.learning.mirror import Mirror
from reproduce.learning.way_in import WayIn, view_size
from reproduce.storage.policies import Spec, load_networks, load_policy_config

Observations = NDArray[np.float32]
Actions = NDArray[np.float32]


class Policy(Protocol):
    """Acts on flat observations of several environments at once and keeps its own memory of each."""

    def act(self, observations: Observations, starts: NDArray[np.bool_]) -> Actions:
        """Choose actions (n, 11) in [-1, 1] for flat observations (n, SIZE).

        ``starts`` (n,) says which environments begin an episode with this observation; in the first call all do.
        """

    def overlay(self) -> dict[str, NDArray[Any]]:
        """Return what the method wants drawn into a picture, such as sub-goals in the base frame (n, 2, 3) [m]."""
        return {}  # most methods aim at no point in space


def begin_episode(env: LunarRescueEnv, policy: Policy, scene: Scene, **options: Any) -> Observations:
    """Reset an environment to a scene and return the flat observation (SIZE,); ``options`` are more of the reset.

    A policy that knows the scene, as the planner does, is told it, and one that draws at random begins at its seed.
    """
    observation: Observations = env.reset_flat(options={"scene": scene, **options})[0]
    for name, what in (("prepare", scene), ("reseed", scene.seed)):
        getattr(policy, name, lambda _: None)(what)
    return observation


class MirroredPolicy(Policy):
    """Networks that act every step, seeing scenes through ``reproduce.learning.mirror`` if they were trained so."""

    def __init__(self, config: PolicyConfig) -> None:
        """Make a policy that acts in no environment yet; ``config`` says how its networks see and act."""
        self.config, self._count = config, 0

    def begin(self, count: int) -> None:
        """Forget everything, if there is a memory, and be ready for ``count`` environments."""

    @abstractmethod
    def outputs(self, observations: Observations, starts: NDArray[np.bool_]) -> Actions:
        """Return what the network puts out (n, 11) for observations in its own view (n, SIZE or more)."""

    def act(self, observations: Observations, starts: NDArray[np.bool_]) -> Actions:
        """Choose actions, see ``Policy.act``; the first call, and one for another n, begins an episode everywhere."""
        if len(observations) != self._count:
            self._count, self._mirror = len(observations), Mirror(len(observations))
            self._way = WayIn(self._count, self.config.places)
            self.begin(self._count)
            starts = np.ones(self._count, bool)
        if self.config.mirror:
            self._mirror.begin(observations, starts)
        self._way.begin(starts)
        seen = self._way.view(self._mirror.observations(observations))
        outputs = self.outputs(seen, starts)
        return self._mirror.actions(environment_actions(seen, outputs, self.config.set_point_changes))


def load_only_network(folder: Path, level: str, kind: type[Spec]) -> tuple[Any, PolicyConfig]:
    """Return the network of a run folder's only level and how it sees and acts; see ``load_networks``."""
    config = load_policy_config(folder, PolicyConfig)
    return load_networks(folder, {level: (view_size(config.places), JOINTS)}, kind)[level], config
