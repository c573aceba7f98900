"""The suited astronaut as a set of rigid parts, from the angles of the limbs.

A pressurised suit holds its posture, so one rigid body per posture is the model (an assumption, see the assumptions
table). Lengths follow the 50th percentile male of NASA-STD-3000 with some centimetres of suit around them; the
life-support backpack and the chest unit are boxes.

Body frame: x to the front (ventral), y to the left, z to the head, origin in the middle of the torso.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from lunar_rescue.arrays import Array
from lunar_rescue.scenes.records import checked, within

SHOULDER = (0.0, 0.27, 0.20)  # m, left shoulder joint; the right one mirrors y
HIP = (0.0, 0.11, -0.30)  # m, left hip joint
UPPER_ARM, FOREARM = 0.28, 0.32  # m, joint to joint; the forearm includes the glove
THIGH, SHIN = 0.42, 0.40  # m, joint to joint
SPACING = 0.02  # m, between the points of ``surface_points``

# What a pressurised suit's joints can do, roughly [deg].
ShoulderFlexion = Annotated[float, within((-40.0, 180.0))]
ShoulderAbduction = Annotated[float, within((0.0, 150.0))]
ElbowFlexion = Annotated[float, within((0.0, 130.0))]
HipFlexion = Annotated[float, within((-20.0, 110.0))]
HipAbduction = Annotated[float, within((0.0, 45.0))]
KneeFlexion = Annotated[float, within((0.0, 120.0))]


@checked
@dataclass(frozen=True)
class Limbs:
    """Limb angles of one posture [deg]; zero is standing at attention."""

    left_shoulder_flexion: ShoulderFlexion
    left_shoulder_abduction: ShoulderAbduction
    left_elbow_flexion: ElbowFlexion
    right_shoulder_flexion: ShoulderFlexion
    right_shoulder_abduction: ShoulderAbduction
    right_elbow_flexion: ElbowFlexion
    left_hip_flexion: HipFlexion
    left_hip_abduction: HipAbduction
    left_knee_flexion: KneeFlexion
    right_hip_flexion: HipFlexion
    right_hip_abduction: HipAbduction
    right_knee_flexion: KneeFlexion


class Part(NamedTuple):
    """One rigid part of the suit."""

    name: str  # part name, unique within the suit
    kind: str  # ``"box"``, ``"capsule"`` or ``"sphere"``
    size: tuple[float, ...]  # box half extents (3,) [m]; capsule (radius, length) [m]; sphere (radius,) [m]
    position: tuple[float, ...]  # centre in the body frame (3,) [m]
    quaternion: tuple[float, ...]  # orientation x, y, z, w in the body frame; a capsule's axis is its local z
    mass_fraction: float  # share of the whole suited mass


class MassProperties(NamedTuple):
    """Mass properties per kilogram of the whole body, in the body frame."""

    centre: Array  # centre of gravity (3,) [m]
    inertia: Array  # principal moments per unit mass (3,) [m^2]
    axes: Array  # quaternion x, y, z, w of the principal axes in the body frame


def _capsule(name: str, start: Array, end: Array, radius: float, fraction: float) -> Part:
    axis = end - start
    length = float(np.linalg.norm(axis))
    rotation, _ = Rotation.align_vectors([axis / length], [[0.0, 0.0, 1.0]])
    middle, turn = ((start + end) / 2).tolist(), rotation.as_quat().tolist()
    return Part(name, "capsule", (radius, length), tuple(middle), tuple(turn), fraction)


def _swing(flexion: float, abduction: float, side: int) -> Rotation:
    """Return the rotation of a hanging limb: flexion to the front, then abduction away from the middle."""
    return Rotation.from_euler("x", side * abduction, degrees=True) * Rotation.from_euler("y", -flexion, degrees=True)


def _limb(root: Array, swing: Rotation, bend: float, lengths: tuple[float, float]) -> tuple[Array, Array, Rotation]:
    """Return middle joint, end and the lower segment's rotation; positive bend lifts the end to the front."""
    middle = root + swing.apply([0.0, 0.0, -lengths[0]])
    lower = swing * Rotation.from_euler("y", -bend, degrees=True)
    return middle, middle + lower.apply([0.0, 0.0, -lengths[1]]), lower


_TRUNK = (
    # name, half extents, centre, mass fraction. The depth of torso with backpack (0.50 m) is the EMU's, roughly.
    ("torso", (0.14, 0.20, 0.26), (0.0, 0.0, 0.02), 0.24),
    ("backpack", (0.10, 0.20, 0.25), (-0.24, 0.0, 0.07), 0.36),
    ("chest_unit", (0.08, 0.13, 0.09), (0.22, 0.0, 0.10), 0.04),
)


@lru_cache(maxsize=256)
def suit_parts(limbs: Limbs) -> tuple[Part, ...]:
    """Return the parts of the suit for these limb angles, in a fixed order."""
    identity = (0.0, 0.0, 0.0, 1.0)
    parts = [Part(n, "box", s, c, identity, f) for n, s, c, f in _TRUNK]
    parts.append(Part("helmet", "sphere", (0.17,), (0.02, 0.0, 0.45), identity, 0.06))
    parts.append(_capsule("hips", np.array([0, -0.08, HIP[2]]), np.array([0, 0.08, HIP[2]]), 0.14, 0.07))
    for side, name in ((1, "left"), (-1, "right")):
        parts += [*_arm(limbs, side, name), *_leg(limbs, side, name)]
    return tuple(parts)


def _arm(limbs: Limbs, side: int, name: str) -> list[Part]:
    shoulder = np.array([SHOULDER[0], side * SHOULDER[1], SHOULDER[2]])
    swing = _swing(getattr(limbs, f"{name}_shoulder_flexion"), getattr(limbs, f"{name}_shoulder_abduction"), side)
    elbow, hand, _ = _limb(shoulder, swing, getattr(limbs, f"{name}_elbow_flexion"), (UPPER_ARM, FOREARM))
    upper_arm = _capsule(f"{name}_upper_arm", shoulder, elbow, 0.085, 0.025)
    return [upper_arm, _capsule(f"{name}_forearm", elbow, hand, 0.065, 0.015)]


def _leg(limbs: Limbs, side: int, name: str) -> list[Part]:
    hip = np.array([HIP[0], side * HIP[1], HIP[2]])
    swing = _swing(getattr(limbs, f"{name}_hip_flexion"), getattr(limbs, f"{name}_hip_abduction"), side)
    # A knee bends the other way than an elbow.
    knee, ankle, lower = _limb(hip, swing, -getattr(limbs, f"{name}_knee_flexion"), (THIGH, SHIN))
    boot = ankle + lower.apply([0.05, 0.0, -0.04])
    return [
        _capsule(f"{name}_thigh", hip, knee, 0.11, 0.045),
        _capsule(f"{name}_shin", knee, ankle, 0.085, 0.02),
        Part(f"{name}_boot", "box", (0.14, 0.06, 0.05), tuple(boot.tolist()), tuple(lower.as_quat().tolist()), 0.01),
    ]


#: Names of the points that describe the posture to the robot (13 of them).
KEYPOINT_NAMES = (
    "head", "left_shoulder", "left_elbow", "left_hand", "right_shoulder", "right_elbow", "right_hand",
    "left_hip", "left_knee", "left_foot", "right_hip", "right_knee", "right_foot",
)  # fmt: skip


@lru_cache(maxsize=256)
def keypoints(limbs: Limbs) -> Array:
    """Return the skeleton's key points in the body frame, (13, 3) [m], in the order of ``KEYPOINT_NAMES``."""
    named = {part.name: part for part in suit_parts(limbs)}
    points = [named["helmet"].position]
    for side in ("left", "right"):
        points += [*_ends(named[f"{side}_upper_arm"]), _ends(named[f"{side}_forearm"])[1]]
    for side in ("left", "right"):
        points += [*_ends(named[f"{side}_thigh"]), named[f"{side}_boot"].position]
    return np.array(points)


def _ends(part: Part) -> tuple[Any, Any]:
    half = Rotation.from_quat(part.quaternion).apply([0.0, 0.0, part.size[1] / 2])
    return np.array(part.position) - half, np.array(part.position) + half


def _unit_inertia(part: Part) -> Array:
    """Return a part's principal inertia per unit mass about its centre, (3,) [m^2]; a capsule as its cylinder."""
    if part.kind == "box":
        x, y, z = part.size
        return np.array([y * y + z * z, x * x + z * z, x * x + y * y]) / 3
    radius = part.size[0]
    if part.kind == "sphere":
        return np.full(3, 0.4 * radius**2)
    length = part.size[1] + 4 / 3 * radius
    across = (3 * radius**2 + length**2) / 12
    return np.array([across, across, radius**2 / 2])


@lru_cache(maxsize=256)
def mass_properties(limbs: Limbs) -> MassProperties:
    """Return centre of gravity and principal inertia per kilogram of the suited body."""
    parts = suit_parts(limbs)
    fractions = np.array([part.mass_fraction for part in parts])
    positions = np.array([part.position for part in parts])
    centre = fractions @ positions
    tensor = np.zeros((3, 3))
    for part, fraction, offset in zip(parts, fractions, positions - centre, strict=True):
        rotation = Rotation.from_quat(part.quaternion).as_matrix()
        own = rotation @ np.diag(_unit_inertia(part)) @ rotation.T
        tensor += fraction * (own + offset @ offset * np.eye(3) - np.outer(offset, offset))
    moments, axes = np.linalg.eigh(tensor)
    if np.linalg.det(axes) < 0:
        axes[:, 2] *= -1
    return MassProperties(centre, moments, Rotation.from_matrix(axes).as_quat())


@lru_cache(maxsize=256)
def surface_points(limbs: Limbs) -> Array:
    """Return points on the surface of every part in the body frame, (M, 3) [m], about ``SPACING`` apart."""
    clouds = []
    for part in suit_parts(limbs):
        local = _box_surface(part.size) if part.kind == "box" else _round_surface(part)
        clouds.append(Rotation.from_quat(part.quaternion).apply(local) + part.position)
    return np.concatenate(clouds)


def _box_surface(half: tuple[float, ...]) -> Array:
    axes = [np.linspace(-h, h, max(2, int(2 * h / SPACING) + 1)) for h in half]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return grid[np.any(np.isclose(np.abs(grid), half), axis=1)]


def _round_surface(part: Part) -> Array:
    radius = part.size[0]
    half = part.size[1] / 2 if part.kind == "capsule" else 0.0
    count = max(8, int(2 * np.pi * radius / SPACING))
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    rings = [(radius, z) for z in np.linspace(-half, half, max(2, int(2 * half / SPACING) + 1))]
    for polar in np.linspace(0, np.pi / 2, max(4, count // 4)):
        rings += [(radius * np.cos(polar), sign * (half + radius * np.sin(polar))) for sign in (-1, 1)]
    x, y = np.cos(angle), np.sin(angle)
    return np.concatenate([np.column_stack([r * x, r * y, np.full(count, z)]) for r, z in rings])
