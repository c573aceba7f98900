"""From what a learner puts out to the environment's action, the same for every method that learns.

Eq. 3 makes an action an absolute joint angle: holding still means repeating an angle, and a network must know inverse
kinematics of the whole workspace before anything works. Here a network puts out the *change* that it wants, as a share
of the most that the speed limit allows in a step, and Eq. 3's action is the previous action plus the change: the same
action space, with a skip connection from a_{t-1}, which the observation holds and the paper gives to LLN.

The change is not added to the present angle: an arm under load hangs a little behind its set-point, so a set-point that
starts from the angle again in each step sinks, and a network had to push all the time to hold a body up (measured: see
the training log). A previous action further ahead of the angle than a step can go is cut first, so that an arm which is
blocked does not wind its set-point up.
"""

import numpy as np
from numpy.typing import NDArray

from lunar_rescue.observation import SLICES
from lunar_rescue.physics.robot import ARM_WINDOW, CONTROL_STEP, INITIAL_ARM, INITIAL_WAIST, JOINT_SPEED, WAIST_WINDOW

Floats = NDArray[np.float32]

#: Largest change in a step, in units of Eq. 3's window; further ahead the set-point is cut anyway.
LARGEST_CHANGE = float(JOINT_SPEED * CONTROL_STEP / ARM_WINDOW)

#: Angles that an action can ask for: Eq. 3's window within the joints' limits, arm A, arm B, waist (11,) [rad].
_ARM_LIMITS = np.radians([[-100.0, -25.0, -100.0, 0.0, -105.0], [100.0, 80.0, 100.0, 160.0, 105.0]])
_WAIST_LIMITS = np.radians([-35.0, 60.0])
ARM_LOWER = np.maximum(INITIAL_ARM - ARM_WINDOW, _ARM_LIMITS[0])
ARM_UPPER = np.minimum(INITIAL_ARM + ARM_WINDOW, _ARM_LIMITS[1])
LOWER = np.concatenate([ARM_LOWER, ARM_LOWER, [max(INITIAL_WAIST - WAIST_WINDOW, _WAIST_LIMITS[0])]])
UPPER = np.concatenate([ARM_UPPER, ARM_UPPER, [min(INITIAL_WAIST + WAIST_WINDOW, _WAIST_LIMITS[1])]])

#: Where the joints' angles are in a flat observation: arm A, arm B, waist (11,).
ANGLES = np.r_[
    SLICES["P_A"].start : SLICES["P_A"].start + 5,
    SLICES["P_B"].start : SLICES["P_B"].start + 5,
    SLICES["P_W"].start : SLICES["P_W"].start + 1,
]


def _held(observations: Floats) -> Floats:
    """Return the previous actions (n, 11), no further ahead of the angles than a step can go."""
    angles = observations[:, ANGLES]
    held: Floats = np.clip(observations[:, SLICES["a_prev"]], angles - LARGEST_CHANGE, angles + LARGEST_CHANGE)
    return held


def environment_actions(observations: Floats, outputs: Floats, changes: bool) -> Floats:
    """Return Eq. 3's actions (n, 11): a network's outputs (n, 11) as they are, or taken as changes of set-points."""
    return to_environment(observations, outputs) if changes else np.clip(outputs, -1.0, 1.0).astype(np.float32)


def to_environment(observations: Floats, outputs: Floats) -> Floats:
    """Return Eq. 3's actions (n, 11) for flat observations (n, SIZE or more) and outputs (n, 11) in [-1, 1]."""
    wanted = _held(observations) + LARGEST_CHANGE * np.clip(outputs, -1.0, 1.0)
    return np.clip(wanted, -1.0, 1.0).astype(np.float32)


def to_outputs(observations: Floats, actions: Floats) -> Floats:
    """Return the outputs (n, 11) in [-1, 1] by which ``to_environment`` comes nearest to Eq. 3's actions (n, 11)."""
    outputs: Floats = np.clip((actions - _held(observations)) / LARGEST_CHANGE, -1.0, 1.0).astype(np.float32)
    return outputs
