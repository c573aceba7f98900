"""The way in, in joint angles: how far the joints are from where both ends are above, before and under the body.

What the planner's rescues have in common is the way of the plates: above where a slide begins, down to it, and under
the body. A network that sees the joints' distance to these places need not become the inverse kinematics of two arms
before it can imitate, or try, such a way. It is the kinematic step towards the next target, for networks with sub-goals
and without, and an observation and nothing more: no output is added to the network's. Any method may have this prior.
"""

import numpy as np
from numpy.typing import NDArray

from lunar_rescue.observation import SIZE, SLICES
from lunar_rescue.physics.kinematics import solve_arms
from lunar_rescue.physics.robot import ARM_WINDOW, INITIAL_ARM, JOINTS, WAIST, WAIST_WINDOW
from reproduce.learning.actions import ANGLES, LOWER, UPPER
from reproduce.learning.config import PlacesConfig

Floats = NDArray[np.float32]
Array = NDArray[np.float64]

PLACES = 3  # above where the slide begins, there, and under the body
WAY_SIZE = 2 * PLACES * JOINTS

_PHASE = SLICES["phase"].start
_MIRROR = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, 1.0]])  # arm B is arm A mirrored


def view_size(places: PlacesConfig | None) -> int:
    """Return how many numbers a network sees, with the way to these places or without."""
    return SIZE + (WAY_SIZE if places else 0)


def joints_at_places(observations: Floats, config: PlacesConfig) -> Floats:
    """Return Eq. 3's actions (n, PLACES, JOINTS) that bring both ends above the slide's beginning, there and under.

    Places follow from the targets and the entries before the body in flat observations (n, SIZE or more). Each is
    solved from the one before it, the first one from the initial posture.
    """
    goals = _goals(observations).astype(np.float64)
    target, way = goals[:, 0], goals[:, 1] - goals[:, 2]  # from the entry to the target
    way[..., 2] = 0.0
    length = np.linalg.norm(way, axis=2, keepdims=True)
    begin = target - (length + config.before) * way / np.maximum(length, 1e-6)
    back = length.max(axis=(1, 2)) + config.before
    under = np.full(len(target), np.radians(config.waist))
    there = np.clip(under - np.radians(config.lean) * back, LOWER[WAIST], UPPER[WAIST])
    above = np.maximum(there - np.radians(config.above_lean), LOWER[WAIST])
    rows, arms = [], np.broadcast_to(INITIAL_ARM, (len(target), 2, 5))
    for place, slope, waists in (
        (begin + [0.0, 0.0, config.above], config.above_slope, above),
        (begin, config.begin_slope, there),
        (target, config.under_slope, under),
    ):
        arms = _solved(place, slope, waists, arms)
        rows.append(np.column_stack([((arms - INITIAL_ARM) / ARM_WINDOW).reshape(-1, 10), waists / WAIST_WINDOW]))
    return np.stack(rows, axis=1).astype(np.float32)


def _goals(observations: Floats) -> Floats:
    """Return P_G: targets, and the ways from the ends to targets and to entries, of both arms (n, 3, 2, 3) [m]."""
    return observations[:, SLICES["P_G"]].reshape(-1, 3, 2, 3)


def _solved(places: Array, slope: float, waists: Array, starts: Array) -> Array:
    """Solve both arms' joints (n, 2, 5) [rad] with their ends at places (n, 2, 3) [m]."""
    count, bounds = 2 * len(places), (LOWER[:5], UPPER[:5])
    slopes = np.full(count, np.radians(slope))
    wanted, begins = (places * _MIRROR).reshape(count, 3), starts.reshape(count, 5)
    return solve_arms(wanted, slopes, np.repeat(waists, 2), 1, begins, *bounds)[0].reshape(-1, 2, 5)


class WayIn:
    """Completes the observations of several environments by the way in; nothing where it is not a prior."""

    def __init__(self, count: int, config: PlacesConfig | None) -> None:
        """Make it for ``count`` environments; ``config`` None leaves observations as they are."""
        self._config = config
        self._seen = np.full((count, 12), np.inf, np.float32)  # where targets and entries were when places were solved
        self._places = np.zeros((count, PLACES, JOINTS), np.float32)

    def begin(self, starts: NDArray[np.bool_]) -> None:
        """Forget the places of environments that begin an episode, ``starts`` (n,)."""
        self._seen[starts] = np.inf

    def view(self, observations: Floats) -> Floats:
        """Return observations (n, SIZE) with the way in behind them (n, SIZE + WAY_SIZE)."""
        if self._config is None:
            return observations
        goals = _goals(observations)
        seen = np.concatenate([goals[:, 0], goals[:, 0] + goals[:, 2] - goals[:, 1]], axis=1).reshape(-1, 12)
        # In process 2 the body moves with the plates: places stay where they were, as the planner's way-points do.
        free = (observations[:, _PHASE] < 0.5) | np.isinf(self._seen[:, 0])
        rows = np.flatnonzero(free & (np.abs(seen - self._seen).max(axis=1) > self._config.moved))
        if len(rows):
            self._seen[rows] = seen[rows]
            self._places[rows] = joints_at_places(observations[rows], self._config)
        return self.complete(observations, slice(None))

    def complete(self, observations: Floats, rows: slice | list[int]) -> Floats:
        """Return observations of some environments with the way to the places as they are."""
        if self._config is None:
            return observations
        way = (self._places[rows] - observations[:, None, ANGLES]).reshape(len(observations), -1)
        return np.concatenate([observations, way, np.clip(self._config.near * way, -1.0, 1.0)], axis=1)
