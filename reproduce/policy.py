"""What every method offers after training: a way to act on a batch of observations."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

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
