"""From what a learner puts out to the environment's action, the same for every method that learns.

Eq. 3 makes an action an absolute joint angle: holding still means repeating the present angles, and a network must know
inverse kinematics of the whole workspace before anything works. Here a network puts out the *change* it wants, as a
share of the most that the speed limit allows in a step, and Eq. 3's action is present angle plus change. It is the same
action space, with a skip connection from the observed angles (measured: see the training log).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lunar_rescue.observation import SLICES
from lunar_rescue.robot import ARM_WINDOW, CONTROL_STEP, JOINT_SPEED

Floats = NDArray[np.float32]

#: Largest change in a step, in units of Eq. 3's window; further ahead the set-point is cut anyway.
LARGEST_CHANGE = float(JOINT_SPEED * CONTROL_STEP / ARM_WINDOW)

_ANGLES = np.r_[
    SLICES["P_A"].start : SLICES["P_A"].start + 5,
    SLICES["P_B"].start : SLICES["P_B"].start + 5,
    SLICES["P_W"].start : SLICES["P_W"].start + 1,
]


def to_environment(observations: Floats, outputs: Floats) -> Floats:
    """Eq. 3's actions (n, 11) from flat observations (n, SIZE or more) and a network's outputs (n, 11) in [-1, 1]."""
    wanted = observations[:, _ANGLES] + LARGEST_CHANGE * np.clip(outputs, -1.0, 1.0)
    return np.clip(wanted, -1.0, 1.0).astype(np.float32)
