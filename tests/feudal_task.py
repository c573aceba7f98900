"""A continuous T-maze: the cue is gone before it can be acted on, so only memory tells which arm is right."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

HELD = 3  # steps at the start, with the cue in sight
SPEED = 0.15  # of a corridor's length, in a step at full action
ARM = 0.5  # length of an arm, in corridors
REWARD = 2.0  # of the right arm
LIMIT = 40  # steps; the best needs 14


class CueMaze(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """Walk along a corridor, then turn into the arm that the cue told.

    Nothing moves while the cue is in sight, and afterwards both mazes look and move alike: whoever acts on the
    observation alone cannot tell them apart, nor write the cue down in where it stands, and is right in half of the
    episodes at best.

    Observation: x in [0, 1] along the corridor, y in [-0.5, 0.5] along the arms, the cue (-1, 1, or 0 when gone).
    Action: forwards and sideways, in [-1, 1]. Reward: the way gained along x, and 2 in the right arm.
    """

    def __init__(self) -> None:
        self.observation_space = spaces.Box(-1.0, 1.0, (3,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self._x = self._y = self._cue = 0.0
        self._step = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self._x = self._y = 0.0
        self._cue, self._step = float(self.np_random.choice([-1.0, 1.0])), 0
        return self._seen(), {}

    def step(self, action: NDArray[np.float32]) -> Any:
        before = self._x
        if self._step >= HELD:
            self._move(float(np.clip(action[0], -1.0, 1.0)), float(np.clip(action[1], -1.0, 1.0)))
        self._step += 1
        done = abs(self._y) >= ARM
        right = done and self._y * self._cue > 0.0
        reward = self._x - before + REWARD * right
        return self._seen(), reward, done, self._step >= LIMIT and not done, {"is_success": right}

    def _move(self, forwards: float, sideways: float) -> None:
        if self._x >= 1.0:
            self._y = float(np.clip(self._y + SPEED * sideways, -ARM, ARM))
        else:
            self._x = float(np.clip(self._x + SPEED * forwards, 0.0, 1.0))

    def _seen(self) -> NDArray[np.float32]:
        return np.array([self._x, self._y, self._cue if self._step < HELD else 0.0], np.float32)
