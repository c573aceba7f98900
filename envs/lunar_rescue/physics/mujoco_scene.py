"""A world for MuJoCo: what lies in it, and the model that is compiled from that for each episode.

MuJoCo has no bodies that come and go, so a world is described first and compiled as a whole, which takes some
milliseconds. Sources of differences to Bullet that are easily overlooked are dealt with here: a robot file brings no
actuators and loses fixed links unless told otherwise, and friction of a pair is the larger of the two surfaces' and not
their product, so each surface has the wanted coefficient itself.
"""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lunar_rescue.arrays import Array
from lunar_rescue.physics.client import MOUND_FILE
from lunar_rescue.physics.quiet import decimal_points
from lunar_rescue.scenes.suit import Limbs, Part, mass_properties, suit_parts
from lunar_rescue.scenes.terrain import Terrain, mounds

GROUND, BASE = 0, -1  # handle of the plane; the base among the links of a body
#: Of a suit that rolls or turns on the spot, times the root of the friction coefficient, as Bullet combines them [m].
ROLLING, SPINNING = 0.005, 0.01
BASE_FRICTION = 0.5  # of the robot's base, times the same root: what Bullet gives to whom nothing else is given
KINDS = {"box": mujoco.mjtGeom.mjGEOM_BOX, "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE}
KINDS["sphere"] = mujoco.mjtGeom.mjGEOM_SPHERE
#: How contacts yield: time constant [s] and damping ratio of a spring that is solved for the end of a substep, and its
#: impedance when touched and when deep, 1 is rigid; see ``mujoco_engine``.
SOLREF, SOLIMP = (0.005, 1.0), (0.95, 0.99, 0.001, 0.5, 2.0)


class Hull(NamedTuple):
    """A fixed convex body: corners (M, 3) about its own origin, that origin in the world [m], and heading [rad]."""

    corners: Array
    position: tuple[float, float, float]
    yaw: float


class Joint(NamedTuple):
    """A joint of the robot's file; fixed ones too, so that every link has a number."""

    name: str
    link: str
    kind: str
    speed: float  # limit [rad/s], which MuJoCo does not know


@dataclass
class Contents:
    """What lies in a world; poses are a centre (3,) [m] and a quaternion x, y, z, w."""

    robot: Path | None = None
    joints: list[Joint] = field(default_factory=list)
    robot_handle: int = BASE
    base: tuple[Array, Array] = field(default_factory=lambda: (np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])))
    pairs: set[tuple[int, int]] = field(default_factory=set)  # links that may meet each other
    # Limbs, mass [kg] and what their centre of gravity is off by, in the body frame (3,) [m], by handle.
    suits: dict[int, tuple[Limbs, float, Array]] = field(default_factory=dict)
    fixed: dict[int, list[Hull]] = field(default_factory=dict)  # rocks and mounds by handle
    friction: float = 0.8  # until an episode sets its own


class World(NamedTuple):
    """A compiled world with its state, and what its numbers mean."""

    model: Any
    data: Any
    owners: NDArray[np.int64]  # handle and link of each shape (ngeom, 2)
    links: NDArray[np.int64]  # body of each of the robot's links, the base last (n + 1,)
    angles: dict[int, int]  # place in qpos of each joint that turns, by its number
    speeds: dict[int, int]  # and in qvel
    motors: dict[int, int]  # and its actuator
    suits: dict[int, tuple[int, int, int]]  # body and places in qpos and qvel by handle


def read_joints(path: Path) -> list[Joint]:
    """Read names, links, kinds and speed limits of a robot file's joints, in the file's order."""

    def one(joint: ElementTree.Element) -> Joint:
        child, limit = joint.find("child"), joint.find("limit")
        link = "" if child is None else str(child.get("link"))
        speed = 0.0 if limit is None else float(limit.get("velocity", "0"))
        return Joint(str(joint.get("name")), link, str(joint.get("type")), speed)

    return [one(joint) for joint in ElementTree.parse(path).iter("joint")]


def read_robot(path: Path) -> Any:
    """Read a robot file as a specification that keeps its fixed links."""
    with decimal_points():
        spec = mujoco.MjSpec.from_file(str(path))
    spec.compiler.fusestatic = False
    return spec


def compile_world(contents: Contents, robot: Any) -> World:
    """Compile a world; ``robot`` is the specification of ``read_robot``, or an empty one."""
    spec = robot.copy()
    ground = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 1.0])
    for hulls in contents.fixed.values():
        for hull in hulls:
            _add_hull(spec, hull)
    _dress_robot(spec, contents, skip=ground)
    for handle, suit in contents.suits.items():
        _add_suit(spec, f"suit {handle}", *suit)
    _set_surfaces(spec, contents)
    with decimal_points():
        model = spec.compile()
    return _index(contents, model)


def _add_hull(spec: Any, hull: Hull) -> None:
    name = f"hull {len(spec.meshes)}"
    spec.add_mesh(
        name=name, uservert=hull.corners.ravel().tolist(), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
    )
    turned = [math.cos(hull.yaw / 2), 0.0, 0.0, math.sin(hull.yaw / 2)]
    geom = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, pos=hull.position)
    geom.quat = turned


def _dress_robot(spec: Any, contents: Contents, skip: Any) -> None:
    """Put the base in its place, give each joint a motor without limits of its own, and keep links apart."""
    if contents.robot is None:
        return
    names = [*(joint.link for joint in contents.joints), _base_name(spec, contents)]
    position, (x, y, z, w) = contents.base
    base = spec.body(names[BASE])
    base.pos, base.quat = position, [w, x, y, z]
    for joint in contents.joints:
        if joint.kind != "fixed":
            spec.joint(joint.name).actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE  # see ``mujoco_motors``
            motor = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            motor.biastype = mujoco.mjtBias.mjBIAS_AFFINE
    count = len(contents.joints)
    for first in range(-1, count):
        for second in range(first + 1, count):
            if not {(first, second), (second, first)} & contents.pairs:
                spec.add_exclude(bodyname1=names[first], bodyname2=names[second])


def _base_name(spec: Any, contents: Contents) -> str:
    """Return the link that no joint of the file moves."""
    moved = {joint.link for joint in contents.joints}
    return next(str(body.name) for body in spec.bodies if body.name != "world" and body.name not in moved)


def _add_suit(spec: Any, name: str, limbs: Limbs, mass: float, offset: Array) -> None:
    """Add the astronaut as a body whose frame is that of the principal axes."""
    properties = mass_properties(limbs)
    centre, to_axes = properties.centre + offset, Rotation.from_quat(properties.axes).inv()
    body = spec.worldbody.add_body(name=name, pos=[0.0, 0.0, 50.0])
    body.add_freejoint(name=name)
    body.explicitinertial, body.mass, body.inertia = True, mass, properties.inertia * mass
    body.ipos, body.iquat = [0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]  # or MuJoCo takes where the body is added
    for part in suit_parts(limbs):
        x, y, z, w = (to_axes * Rotation.from_quat(part.quaternion)).as_quat()
        geom = body.add_geom(type=KINDS[part.kind], size=_size(part), condim=6)
        geom.pos, geom.quat = to_axes.apply(np.array(part.position) - centre), [w, x, y, z]


def _size(part: Part) -> list[float]:
    """Return half extents, radius and half length, or radius [m], as MuJoCo takes them (3,)."""
    sizes = {"box": part.size, "capsule": (part.size[0], 0.5 * part.size[-1]), "sphere": part.size}
    return [*sizes[part.kind], 0.0, 0.0][:3]


def _set_surfaces(spec: Any, contents: Contents) -> None:
    """Give every shape its friction and how it yields; only the base's friction differs, and then counts alone."""
    root = math.sqrt(contents.friction)
    for geom in spec.geoms:
        geom.solref, geom.solimp = SOLREF, SOLIMP
        rolls = geom.condim == 6
        geom.friction = [contents.friction, SPINNING * root * rolls, ROLLING * root * rolls]
    if contents.robot is not None:
        for geom in spec.body(_base_name(spec, contents)).geoms:
            geom.friction, geom.priority = [BASE_FRICTION * root, 0.0, 0.0], 1


def _index(contents: Contents, model: Any) -> World:
    """Make the state and find out which number of the model is whose."""
    ids: dict[str, int] = {model.body(i).name: i for i in range(model.nbody)}
    links = [ids[joint.link] for joint in contents.joints]
    moved = set(links)
    suits = {handle: ids[f"suit {handle}"] for handle in contents.suits}
    others = [i for i in range(1, model.nbody) if i not in moved and i not in suits.values()]
    links += others[:1]
    owners = np.full((model.ngeom, 2), BASE, np.int64)
    of_world = [GROUND, *(handle for handle, hulls in contents.fixed.items() for _ in hulls)]
    owners[np.flatnonzero(model.geom_bodyid == 0), 0] = of_world
    for number, body in enumerate(links):
        owner = contents.robot_handle, BASE if number == len(contents.joints) else number
        owners[model.geom_bodyid == body] = owner
    for handle, body in suits.items():
        owners[model.geom_bodyid == body, 0] = handle
    turning = {i: model.joint(j.name).id for i, j in enumerate(contents.joints) if j.kind != "fixed"}
    free = {handle: int(model.body_jntadr[body]) for handle, body in suits.items()}
    return World(
        model,
        mujoco.MjData(model),
        owners,
        np.array(links, np.int64),
        {i: int(model.jnt_qposadr[j]) for i, j in turning.items()},
        {i: int(model.jnt_dofadr[j]) for i, j in turning.items()},
        {i: model.actuator(contents.joints[i].name).id for i in turning},
        {h: (suits[h], int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j])) for h, j in free.items()},
    )


def relief_hulls(terrain: Terrain) -> list[Hull]:
    """Return the mounds of a terrain as convex bodies in the world."""
    c, s = math.cos(terrain.yaw), math.sin(terrain.yaw)
    unit = _unit_mound()
    return [
        Hull(
            unit * [m.along, m.across, m.height],
            (terrain.x + c * m.x - s * m.y, terrain.y + s * m.x + c * m.y, 0.0),
            terrain.yaw + m.yaw,
        )
        for m in mounds(terrain.relief, terrain.patch)
    ]


def _unit_mound() -> Array:
    """Read the corners of the unit cap (M, 3)."""
    lines = MOUND_FILE.read_text(encoding="utf-8").splitlines()
    return np.array([[float(word) for word in line.split()[1:]] for line in lines if line.startswith("v ")])
