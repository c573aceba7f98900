"""Process 2: which lifts or turns suit a scene, and others near them; ``planner.search`` found those of the file."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lunar_rescue import Scene
from reproduce.baselines.way_points import Variant

LONGEST_WAIT = 60  # steps


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
