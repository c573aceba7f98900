"""Methods that neither learn nor look."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lunar_rescue.physics.robot import JOINTS
from reproduce.learning.policy import Actions, Observations, Policy


class RandomPolicy(Policy):
    """Uniform actions in [-1, 1], the same for the same seed and order of calls."""

    def __init__(self, seed: Any = 0) -> None:
        """Seed the generator; anything but an integer counts as 0."""
        self.reseed(seed if isinstance(seed, int) else 0)

    def reseed(self, seed: int) -> None:
        """Start a scene's own sequence of actions, so that the order of tests does not matter."""
        self._rng = np.random.default_rng(seed)

    def act(self, observations: Observations, starts: NDArray[np.bool_]) -> Actions:
        """Draw actions (n, 11) without a look at the observations; see ``Policy.act``."""
        return self._rng.uniform(-1.0, 1.0, (len(observations), JOINTS)).astype(np.float32)
