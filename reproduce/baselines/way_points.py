"""Way-points of both arms as data: what the script does, and what the planner tries out for a lift or a turn."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from lunar_rescue import Scene
from lunar_rescue.physics.kinematics import solve_arms
from lunar_rescue.physics.robot import ARMS, JOINTS, WAIST
from reproduce.learning.actions import LOWER, UPPER
from reproduce.storage.errors import UserError
from reproduce.storage.files import read_json

Array = NDArray[np.float64]
Data = TypeVar("Data")

DATA = Path(__file__).parent / "planner" / "data"
SCRIPT, VARIANTS = DATA / "script.json", DATA / "variants.json"
LONGEST_WAIT = 60  # steps at a way-point that is drawn
ARRIVED = np.radians(3.0)  # rad, a way-point is reached when every joint is this near
STRICT = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)
Metres = Annotated[float, Field(ge=-2.0, le=2.0)]
Degrees = Annotated[float, Field(ge=-90.0, le=90.0)]


@dataclass(frozen=True, config=STRICT)
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


@dataclass(frozen=True, config=ConfigDict(strict=True, extra="ignore"))
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
