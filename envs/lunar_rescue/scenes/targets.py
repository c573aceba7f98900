"""The two target areas between astronaut and ground (section 4.1), from the geometry of a resting posture.

One area lies on the head's side of the centre of gravity and one on the feet's side, each where a flat plate can pass
under the body from the robot's side.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from lunar_rescue.arrays import Array
from lunar_rescue.scenes.postures import Posture

PLATE_HALF_WIDTH = 0.12  # m, half the plate's width (0.075) and room for not coming in quite squarely
NEAREST, FURTHEST = 0.24, 0.66  # m, along the body from the centre of gravity; arms reach no further apart
PREFERRED = 0.42  # m, a span of 0.84 m suits shoulders 0.72 m apart
BEFORE_EDGE = 0.16  # m, the way in begins this far before the body: a plate's tip (0.12 m) and a little room
COVER = 0.06  # m, the body must reach this near to straight above a target
TIP_BEYOND = 0.10  # m, the plate's tip reaches this far beyond the target
OPEN_HEIGHT = 0.3  # m, free height where nothing of the body lies above a strip
HIGH_ENOUGH = 0.14  # m, more free height than this makes a strip no better
SPAN_COST, WAY_COST = 0.12, 0.25  # score per metre from the preferred span, and per metre of way under the body
STRIP = 0.02  # m, between the places that are tried
HIGHEST = 0.05  # m, a target lies no higher above the ground than this

#: How far short of the body's long axis the target lies. Lifting wants the plates under the centre; turning over wants
#: them under the near half, so that the far edge is the hinge.
DEPTH: dict[str, float] = {"lift": 0.0, "turn_over": 0.15}


class TargetAreas(NamedTuple):
    """Two target areas of one posture, side and task."""

    offsets: Array  # head's and feet's target from the centre of gravity, rest frame (head along +x) (2, 3) [m]
    clearance: Array  # free height under the body on the way in (2,) [m]
    near_edge: Array  # how far the body reaches towards the robot beside each target (2,) [m]
    way_in: Array  # length of the way from in front of the body to each target (2,) [m]


@lru_cache(maxsize=64)
def approach_sides(posture: Posture) -> tuple[int, ...]:
    """Return the sides from which the robot comes: +1 is +y with the head along +x.

    Lying on a side, the robot comes from the front: it turns the astronaut away from itself, onto the back.
    """
    front_y = posture.rest_rotation().apply([1.0, 0.0, 0.0])[1]
    if posture.attitude in ("supine", "prone"):
        return (1, -1)
    return (1,) if front_y > 0 else (-1,)


@lru_cache(maxsize=256)
def target_areas(posture: Posture, side: int, task: str) -> TargetAreas:
    """Choose the two target areas for a robot on ``side``."""
    points = posture.resting_surface()
    depth = DEPTH[task]
    along, towards, height = points[:, 0], side * points[:, 1], points[:, 2]
    strips = np.arange(NEAREST, FURTHEST, STRIP)
    best = [max(_candidate(s, along, towards, height, depth) for s in way * strips) for way in (1, -1)]
    _, place, clearance, edge = np.array(best).T
    z = np.minimum(clearance / 2, HIGHEST) - posture.rest.height
    offsets = np.column_stack([place, np.full(2, side * depth), z])
    return TargetAreas(offsets, clearance, edge, edge - depth + BEFORE_EDGE)


def _candidate(s: float, along: Array, towards: Array, height: Array, depth: float) -> tuple[float, ...]:
    """Return score, place, clearance and near edge of one strip: free height first, a short way in, a handy span."""
    strip = (np.abs(along - s) < PLATE_HALF_WIDTH) & (towards > depth - TIP_BEYOND)
    clearance = float(height[strip].min()) if strip.any() else OPEN_HEIGHT
    edge = float(towards[strip].max()) if strip.any() else depth
    above = (np.abs(along - s) < COVER) & (np.abs(towards - depth) < COVER)
    if not above.any():
        return -1.0, s, clearance, edge  # a gap, between the legs say, is not under the body
    score = min(clearance, HIGH_ENOUGH) - SPAN_COST * abs(abs(s) - PREFERRED) - WAY_COST * edge
    return score, s, clearance, edge
