"""What every method offers after training: a way to act on a batch of observations."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from reproduce.learning.actions import to_environment
from reproduce.learning.mirror import Mirror

Observations = NDArray[np.float32]
Actions = NDArray[np.float32]


class Policy(Protocol):
    """Acts on flat observations of several environments at once and keeps its own memory of each."""

    def act(self, observations: Observations, starts: NDArray[np.bool_]) -> Actions:
        """Choose actions.

        Args:
            observations: Flat observations (n, SIZE).
            starts: Which environments begin an episode with this observation (n,).

        Returns:
            Actions (n, 11) in [-1, 1].
        """
        ...

    def overlay(self) -> dict[str, NDArray[Any]]:
        """What the method wants drawn into a picture, such as sub-goals in the base frame (n, 2, 3) [m]."""
        ...


class MirroredPolicy(ABC):
    """One network that acts every step, seeing scenes through ``reproduce.learning.mirror`` if it was trained so."""

    def __init__(self, mirrored: bool) -> None:
        """Start without environments."""
        self._mirrored, self._count = mirrored, 0

    @abstractmethod
    def begin(self, count: int) -> None:
        """Forget all and be ready for so many environments."""

    @abstractmethod
    def outputs(self, observations: Observations, starts: NDArray[np.bool_]) -> Actions:
        """What the network puts out (n, 11) for observations in its own view (n, SIZE)."""

    def act(self, observations: Observations, starts: NDArray[np.bool_]) -> Actions:
        """See ``Policy.act``."""
        if len(observations) != self._count:
            self._count, self._mirror = len(observations), Mirror(len(observations))
            self.begin(self._count)
        if self._mirrored:
            self._mirror.begin(observations, starts)
        seen = self._mirror.observations(observations)
        return self._mirror.actions(to_environment(seen, self.outputs(seen, starts)))

    def overlay(self) -> dict[str, NDArray[Any]]:
        """Nothing to draw: no sub-goal that lies in space."""
        return {}
