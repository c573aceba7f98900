"""`random`, and `scripted`: inverse kinematics and way-points, what a roboticist would try first; neither learns.

The script sees the same observation as the learners: retract, lower, slide in under the body, then lift or push over.
It knows nothing of rocks, so it also tells how hard the problem is without looking at them. Its way-points are data, in
``planner/data/script.json``.
"""

import json
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass as strict_dataclass

from lunar_rescue import Scene
from lunar_rescue.observation import SLICES
from lunar_rescue.physics.kinematics import solve_arm, solve_arms
from lunar_rescue.physics.robot import ARM_WINDOW, ARMS, INITIAL, JOINTS, WAIST, WINDOW
from reproduce.learning.actions import ANGLES, LOWER, UPPER
from reproduce.learning.policy import Actions, Observations, Policy
from reproduce.storage.errors import UserError
from reproduce.storage.files import read_json

Array = NDArray[np.float64]
Data = TypeVar("Data")

SIDE_FRONT = 0.75  # lying on a side, the front points up or down by less than this sine
DATA = Path(__file__).parent / "planner" / "data"
SCRIPT, VARIANTS = DATA / "script.json", DATA / "variants.json"
LONGEST_WAIT = 60  # steps at a way-point that is drawn
ARRIVED = np.radians(3.0)  # rad, a way-point is reached when every joint is this near
STRICT = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)
Metres = Annotated[float, Field(ge=-2.0, le=2.0)]
Degrees = Annotated[float, Field(ge=-90.0, le=90.0)]


@strict_dataclass(frozen=True, config=STRICT)
class WayPoint:
    """A wanted place of both arm ends."""

    ahead: Metres  # from the targets as first seen [m]
    aside: Metres  # from the targets as first seen, to the left [m]
    up: Metres  # from the targets as first seen [m]
    slope: Degrees  # forearm above the horizontal [deg]
    waist: Degrees  # waist angle [deg]
    patience: Annotated[int, Field(ge=1, le=120)]  # most steps to spend

    def joints(self, targets: Array, before: Array) -> Array:
        """Solve the joint angles (11,) [rad], within their limits, that bring both arms to this way-point.

        ``targets`` are the two as first seen, base frame (2, 3) [m]; ``before`` (11,) is where to begin, and preferred.
        """
        joints = np.empty(JOINTS)
        joints[WAIST] = np.clip(np.radians(self.waist), LOWER[WAIST], UPPER[WAIST])
        slope, waist = np.radians([self.slope]), joints[[WAIST]]
        for arm, place in zip(ARMS, targets + [self.ahead, self.aside, self.up], strict=True):
            j = arm.joints
            joints[j] = solve_arms(place[None], slope, waist, arm.side, before[None, j], LOWER[j], UPPER[j])[0][0]
        return joints


Variant = tuple[WayPoint, ...]


def kind(scene: Scene) -> str:
    """Name the way-points that suit a scene: its task and the attitude of the body."""
    attitude = scene.model.attitude
    return f"{scene.task} {'side' if attitude.endswith('side') else attitude}"


def vary(variant: Variant, rng: np.random.Generator, spread: float = 1.0) -> Variant:
    """Return a variant nearby, every number moved at random by amounts in proportion to ``spread``."""
    shift = rng.normal(0.0, 0.04 * spread, 3)
    points = []
    for point in variant:
        ahead, aside, up = np.array([point.ahead, point.aside, point.up]) + shift * [1, 0.7, 0.5]
        ahead, up = ahead + rng.normal(0.0, 0.05 * spread), up + rng.normal(0.0, 0.04 * spread)
        moved = replace(
            point,
            ahead=float(ahead),
            aside=float(aside),
            up=float(max(up, -0.02)),
            slope=float(np.clip(point.slope + rng.normal(0.0, 6.0 * spread), -30.0, 75.0)),
            waist=float(np.clip(point.waist + rng.normal(0.0, 6.0 * spread), -35.0, 60.0)),
            patience=int(np.clip(round(point.patience * np.exp(rng.normal(0.0, 0.25 * spread))), 4, LONGEST_WAIT)),
        )
        points.append(moved)
    return tuple(points)


@strict_dataclass(frozen=True, config=ConfigDict(strict=True, extra="ignore"))
class _Variants:
    kinds: dict[str, list[list[WayPoint]]]


@lru_cache
def load_way_points(path: Path) -> dict[str, tuple[Variant, ...]]:
    """Read from JSON the variants of each kind, such as ``"lift prone"``, the most useful first; see ``read_data``."""
    kinds = read_data(path, "file of way-points", _Variants).kinds
    return {name: tuple(tuple(variant) for variant in variants) for name, variants in kinds.items()}


def read_data(path: Path, what: str, form: type[Data]) -> Data:
    """Read JSON as a strict dataclass; ``UserError`` names the file, the first faulty place and what is there."""
    raw = read_json(path, what)
    try:
        return TypeAdapter(form).validate_json(json.dumps(raw))  # strict about JSON's types, not Python's
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "the whole"
        raise UserError(f"{path}: {what}: {where}: {first['msg']}, got {first['input']!r:.60}") from None


@dataclass
class _Progress:
    """How far the script has come in one environment."""

    targets: Array  # the two targets as first seen (2, 3) [m]
    points: Variant
    index: int = -1  # of the present way-point
    left: int = 0  # steps that may still be spent on it
    joints: Array = field(default_factory=INITIAL.copy)  # it asks for (11,) [rad]

    def action(self, angles: NDArray[np.float32]) -> Array:
        """Return Eq. 3's action for joint angles (11,) in Eq. 3's units, going on where a way-point is reached."""
        arrived = bool(np.all(np.abs(angles - _to_action(self.joints)) * ARM_WINDOW < ARRIVED))
        if (arrived or self.left <= 0) and self.index + 1 < len(self.points):
            self.index += 1
            self.left = self.points[self.index].patience
            self.joints = _solve(self.points[self.index], self.targets, self.joints)
        self.left -= 1
        return _to_action(self.joints)


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


class ScriptedPolicy(Policy):
    """Go through the script's way-points, with one state machine for each environment."""

    def __init__(self) -> None:
        self._progress: dict[int, _Progress] = {}
        self._script = load_way_points(SCRIPT)

    def act(self, observations: Observations, starts: NDArray[np.bool_]) -> Actions:
        """Go on to the next way-point where one is reached; see ``Policy.act``."""
        rows = [self._one(i, row, bool(start)) for i, (row, start) in enumerate(zip(observations, starts, strict=True))]
        return np.array(rows, dtype=np.float32)

    def _one(self, index: int, row: NDArray[np.float32], start: bool) -> Array:
        if start or index not in self._progress:
            targets = row[SLICES["P_G"]][:6].reshape(2, 3).astype(np.float64)
            self._progress[index] = _Progress(targets, self._script["get under"][0] + self._script[_kind(row)][0])
        return self._progress[index].action(row[ANGLES])


def _kind(row: NDArray[np.float32]) -> str:
    """Name the way-points that suit the task and the attitude that the robot sees."""
    front_up = row[SLICES["P_P"]][5]
    if row[SLICES["I"]][0] > 0.5:
        return "lift supine" if front_up > 0 else "lift prone"
    return "turn_over side" if abs(front_up) < SIDE_FRONT else "turn_over prone"


def _solve(point: WayPoint, targets: Array, before: Array) -> Array:
    joints = np.empty(JOINTS)
    joints[WAIST] = np.radians(point.waist)
    for arm, place in zip(ARMS, targets + [point.ahead, point.aside, point.up], strict=True):
        j = arm.joints
        joints[j] = solve_arm(place, np.radians(point.slope), joints[WAIST], arm.side, before[j], LOWER[j], UPPER[j])
    return joints


def _to_action(joints: Array) -> Array:
    return np.clip((joints - INITIAL) / WINDOW, -1.0, 1.0)
