"""Spaces of networks that see flat observations and put out actions in [-1, 1]."""

from __future__ import annotations

import numpy as np
from gymnasium import spaces


def flat_spaces(observations: int, actions: int) -> tuple[spaces.Box, spaces.Box]:
    """Return the spaces of observations (observations,), without bounds, and of actions (actions,) in [-1, 1]."""
    return (
        spaces.Box(-np.inf, np.inf, (observations,), np.float32),
        spaces.Box(-1.0, 1.0, (actions,), np.float32),
    )
