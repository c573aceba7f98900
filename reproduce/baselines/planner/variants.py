"""Process 2: way-points of a lift or a turn in several variants, as data found by random search on training scenes."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from lunar_rescue import Scene
from reproduce.baselines.scripted import THEN
from reproduce.storage.errors import UserError
from reproduce.storage.files import read_json

DATA_FILE = Path(__file__).parent / "data" / "variants.json"
LONGEST_WAIT = 60  # steps


@dataclass(frozen=True)
class Point:
    """A wanted place of both arm ends.

    Attributes:
        ahead: From the targets as first seen [m].
        aside: From the targets as first seen, to the left [m].
        up: From the targets as first seen [m].
        slope: Forearm above the horizontal [deg].
        waist: Waist angle [deg].
        patience: Most steps to spend.
    """

    ahead: float
    aside: float
    up: float
    slope: float
    waist: float
    patience: int


Variant = tuple[Point, ...]


def kind(scene: Scene) -> str:
    """Which variants suit a scene: its task and the attitude of the body."""
    attitude = scene.model.attitude
    return f"{scene.task} {'side' if attitude.endswith('side') else attitude}"


def scripted_variant(name: str) -> Variant:
    """The way-points of method ``scripted``."""
    return tuple(Point(*p.offset, p.slope, p.waist, p.patience) for p in THEN[name])


@lru_cache(maxsize=4)
def load_variants(path: Path = DATA_FILE) -> dict[str, tuple[Variant, ...]]:
    """Variants by kind, the most useful first.

    Raises:
        UserError: When the file is missing or malformed.
    """
    raw = read_json(path, "file of variants")
    try:
        return {name: tuple(_variant(v) for v in rows) for name, rows in raw["kinds"].items()}
    except (KeyError, TypeError, AttributeError) as error:
        raise UserError(f"{path}: file of variants: expected kinds, each a list of lists of points: {error}") from None


def _variant(rows: list[dict[str, Any]]) -> Variant:
    return tuple(Point(**row) for row in rows)


def as_data(variant: Variant) -> list[dict[str, Any]]:
    """Plain data of a variant, for the file."""
    return [{k: round(v, 3) for k, v in asdict(point).items()} for point in variant]


def vary(variant: Variant, rng: np.random.Generator, spread: float = 1.0) -> Variant:
    """A variant nearby, every number moved at random."""
    shift = rng.normal(0.0, 0.04 * spread, 3)
    points = []
    for point in variant:
        ahead, aside, up = np.array([point.ahead, point.aside, point.up]) + shift * [1, 0.7, 0.5]
        ahead, up = ahead + rng.normal(0.0, 0.05 * spread), up + rng.normal(0.0, 0.04 * spread)
        points.append(
            replace(
                point,
                ahead=float(ahead),
                aside=float(aside),
                up=float(max(up, -0.02)),
                slope=float(np.clip(point.slope + rng.normal(0.0, 6.0 * spread), -30.0, 75.0)),
                waist=float(np.clip(point.waist + rng.normal(0.0, 6.0 * spread), -35.0, 60.0)),
                patience=int(np.clip(round(point.patience * np.exp(rng.normal(0.0, 0.25 * spread))), 4, LONGEST_WAIT)),
            )
        )
    return tuple(points)
