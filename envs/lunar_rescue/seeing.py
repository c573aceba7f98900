"""The environment as a robot sees it: pictures of its head camera, and its own sensors."""

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from lunar_rescue.arrays import Array, Floats
from lunar_rescue.env import LunarRescueEnv
from lunar_rescue.observation import BOUND, SIZE, SLICES, observation_space
from lunar_rescue.pictures.head import HEIGHT, WIDTH, Head, Sight

#: Keys of the observation that the robot's own sensors, its task and its memory give.
OWN = ("P_A", "P_B", "P_W", "P_R", "a_prev", "I", "phase")
UP = slice(SLICES["P_T"].start, SLICES["P_T"].start + 3)  # of the ground's key, an inclinometer gives the up vector
_KNOWN = np.zeros(SIZE, bool)
for _where in (*(SLICES[key] for key in OWN), UP):
    _KNOWN[_where] = True
_KNOWN.flags.writeable = False


class SeeingEnv(LunarRescueEnv):
    """``LunarRescueEnv`` whose observations are ``colour``, ``depth``, the robot's own keys and ``up``.

    What the robot would have to recognise is zero in its flat observations. Rewards, success and failure are those of
    ``LunarRescueEnv``, bit for bit.

    Attributes:
        sight: What the head camera sees now.
        truth: The flat observation (SIZE,) of ``LunarRescueEnv``, for labels and measurements.
    """

    def __init__(self, **arguments: Any) -> None:
        """Connect to the simulator; ``arguments`` are those of ``LunarRescueEnv``."""
        super().__init__(**arguments)
        self.head = Head()
        own = {key: observation_space()[key] for key in OWN}
        self.observation_space = spaces.Dict(
            {
                "colour": spaces.Box(0, 255, (HEIGHT, WIDTH, 3), np.uint8),
                "depth": spaces.Box(0, 65535, (HEIGHT, WIDTH), np.uint16),
                "up": spaces.Box(-BOUND, BOUND, (3,), np.float32),
                **own,
            }
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """Start an episode, see ``LunarRescueEnv.reset``; pictures look as the scene's seed says."""
        vector, info = self.reset_flat(seed, options)
        return self._seen(vector), info

    def step(self, action: NDArray[np.float32]) -> tuple[dict[str, NDArray[Any]], float, bool, bool, dict[str, Any]]:
        """Hold an action for 0.1 s and return what Gymnasium wants of a step."""
        vector, reward, terminated, truncated, info = self.step_flat(action)
        return self._seen(vector), reward, terminated, truncated, info

    def look(self) -> Floats:
        """Take a picture of the episode as it is now, wherever its body and joints were put; return what is known."""
        return self._observe(self._zero)

    def close(self) -> None:
        """Disconnect from the simulator and free the camera's stage."""
        super().close()
        self.head.close()

    def _observe(self, action: Array) -> Floats:
        self.truth = super()._observe(action)
        self.sight: Sight = self.head.look(self.episode)
        return np.where(_KNOWN, self.truth, np.float32(0.0))

    def _seen(self, vector: Floats) -> dict[str, NDArray[Any]]:
        own = {key: vector[SLICES[key]].copy() for key in OWN}
        return {"colour": self.sight.colour, "depth": self.sight.depth, "up": vector[UP].copy(), **own}
