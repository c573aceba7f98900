"""Put the suit of a posture onto the points that the depth camera sees of it, and so find the body's pose.

The network says which posture it is and roughly where the body lies; a suit that is rigid, and whose shape is known,
then has to fit the picture. Points are those of the picture that lie near the body, and neither on the ground nor on
the robot's arms, whose joints the robot knows. A few Gauss-Newton steps make their distances from the suit's surface
small, those far off counting little (Geman and McClure), with the pose before as a prior for what cannot be seen.
"""

from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from lunar_rescue.arrays import Array
from lunar_rescue.physics.kinematics import ArmChain
from lunar_rescue.physics.robot import ARMS, WAIST
from lunar_rescue.scenes.suit import Limbs, mass_properties, suit_parts

MOST = 160  # points that are fitted to
FEWEST = 25  # and without which nothing is
NEAR = 1.3  # m, points further from the centre of gravity are not the body's
OFF_GROUND, OFF_ARMS = 0.05, 0.11  # m, points that are lower, or this near to an arm's axis, are not either
GATES = (0.15, 0.08, 0.05, 0.03)  # m, of the steps: points at this distance from the surface count a quarter
SPREAD = 0.03  # m, what a single point is trusted to: they are many, and off together
#: How sure the pose before is: standard deviations of place [m] and attitude [rad], along and about the base's axes.
ROUGH = np.array([0.10, 0.10, 0.10, 0.25, 0.25, 0.25])
RESTING = np.array([0.10, 0.10, 0.005, 0.01, 0.01, 0.25])  # of a body at rest, whose height and lie are known


class Pose(NamedTuple):
    """A body's pose in the base frame."""

    centre: Array  # of gravity (3,) [m]
    rotation: Array  # axes front, left and head in columns (3, 3)


class SuitSurface:
    """The surface of a posture's suit: how far points are from it."""

    def __init__(self, limbs: Limbs) -> None:
        """Take over the suit's parts; those that are round are segments with a radius."""
        parts, centre = suit_parts(limbs), mass_properties(limbs).centre
        boxes, round_ones = ([p for p in parts if (p.kind == "box") is box] for box in (True, False))
        self._half = np.array([p.size for p in boxes])
        self._turns = Rotation.from_quat([p.quaternion for p in boxes]).as_matrix()
        middles = np.array([p.position for p in boxes]) - centre
        self._offsets = (middles[:, None] @ self._turns)[:, 0]  # of the boxes' middles, along their own axes
        self._radii = np.array([p.size[0] for p in round_ones])
        lengths = np.array([p.size[1] if p.kind == "capsule" else 0.0 for p in round_ones])
        self._axes = Rotation.from_quat([p.quaternion for p in round_ones]).apply([0.0, 0.0, 1.0]) * lengths[:, None]
        self._starts = np.array([p.position for p in round_ones]) - centre - 0.5 * self._axes
        self._squares = np.maximum(lengths**2, 1e-9)

    def distances(self, points: Array) -> tuple[Array, Array]:
        """Return distances (n,) [m] of points (n, 3) from the surface, less than 0 inside, and its normals (n, 3).

        Points and normals are in the body frame, from the centre of gravity.
        """
        along = points @ self._axes.T - (self._starts * self._axes).sum(axis=1)
        share = np.clip(along / self._squares, 0.0, 1.0)
        square = (points**2).sum(axis=1)[:, None] - 2 * points @ self._starts.T + (self._starts**2).sum(axis=1)
        square += share * (share * self._squares - 2 * along)
        own = np.abs(points @ self._turns - self._offsets[:, None]) - self._half[:, None]  # (boxes, n, 3)
        outside = np.sqrt((np.maximum(own, 0.0) ** 2).sum(axis=2))
        flat = np.where(outside > 0, outside, own.max(axis=2)).T
        every = np.concatenate([np.sqrt(np.maximum(square, 0.0)) - self._radii, flat], axis=1)
        nearest, rows = every.argmin(axis=1), np.arange(len(points))
        normals, box = np.empty((len(points), 3)), nearest >= len(self._radii)
        part = nearest[~box]
        away = points[~box] - self._starts[part] - share[rows[~box], part, None] * self._axes[part]
        normals[~box] = away / np.maximum(np.sqrt((away * away).sum(axis=1)), 1e-9)[:, None]
        normals[box] = self._box_normals(points[box], nearest[box] - len(self._radii))
        return every[rows, nearest], normals

    def _box_normals(self, points: Array, part: Array) -> Array:
        """Return the normals (n, 3) of boxes (n,) where points (n, 3) are nearest to them."""
        own = (points[:, None] @ self._turns[part])[:, 0] - self._offsets[part]
        over = np.abs(own) - self._half[part]
        inside = np.where(over == over.max(axis=1, keepdims=True), 1.0, 0.0)  # the face that is nearest
        out = np.where((over > 0).any(axis=1, keepdims=True), np.maximum(over, 0.0), inside) * np.sign(own)
        normals = out / np.maximum(np.sqrt((out * out).sum(axis=1, keepdims=True)), 1e-9)
        return np.asarray((self._turns[part] @ normals[:, :, None])[:, :, 0])


@lru_cache(maxsize=64)
def suit_surface(limbs: Limbs) -> SuitSurface:
    """Return the surface of a posture's suit."""
    return SuitSurface(limbs)


def body_points(points: Array, angles: Array, centre: Array) -> Array:
    """Return those of a picture's points (n, 3) [m] that may be the body's, at most ``MOST``, in the base frame.

    Args:
        points: Of all pixels in which something is near enough to be measured.
        angles: The robot's joints (11,) [rad].
        centre: Where the body's centre of gravity is thought to be (3,) [m].
    """
    points = points[(points[:, 2] > OFF_GROUND) & (((points - centre) ** 2).sum(axis=1) < NEAR**2)]
    for arm in ARMS:
        joints = ArmChain(angles[WAIST, None], angles[None, arm.joints]).points[0, [0, 1, 2, 4]] * [1, arm.side, 1]
        for start, end in pairwise(joints):
            along = np.clip((points - start) @ (end - start) / ((end - start) @ (end - start)), 0.0, 1.0)
            away = points - start - along[:, None] * (end - start)
            points = points[(away * away).sum(axis=1) > OFF_ARMS**2]
    return points[:: -(-len(points) // MOST)] if len(points) else points


def refine(pose: Pose, points: Array, surface: SuitSurface, trust: Array = ROUGH) -> tuple[Pose, float]:
    """Return the pose that brings a suit's surface onto points (n, 3) [m], and how badly it fits, from 0 to 1.

    ``trust`` (6,) says how sure the pose before is, see ``ROUGH``. With too few points the pose stays and fits worst.
    """
    if len(points) < FEWEST:
        return pose, 1.0
    (centre, rotation), moved = pose, np.zeros(6)
    for gate in GATES:
        distance, normal, arms = _seen_from(points, centre, rotation, surface)
        weight = (1.0 / (1.0 + (distance / gate) ** 2)) ** 2 / SPREAD**2
        rows = np.concatenate([normal, np.cross(arms, normal)], axis=1)
        left = (rows * weight[:, None]).T @ rows + np.diag(1.0 / trust**2)
        step = np.linalg.solve(left, rows.T @ (weight * distance) - moved / trust**2)
        moved, centre = moved + step, centre + step[:3]
        rotation = Rotation.from_rotvec(step[3:]).as_matrix() @ rotation
    square = (_seen_from(points, centre, rotation, surface)[0] / GATES[-1]) ** 2
    return Pose(centre, rotation), float((square / (1.0 + square)).mean())


def _seen_from(points: Array, centre: Array, rotation: Array, surface: SuitSurface) -> tuple[Array, Array, Array]:
    """Return distances (n,), normals and arms from the centre of gravity (n, 3), the latter along the base's axes."""
    arms = points - centre
    distance, normal = surface.distances(arms @ rotation)
    return distance, normal @ rotation.T, arms
