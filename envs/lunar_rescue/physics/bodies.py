"""The bodies of an episode: astronaut, rocks and mounds, made anew at each reset from shapes that are kept.

They have next to nothing to be seen (pictures are taken in a client of their own). Shapes that are kept, most of them
rocks that never come again, add some 14 kB of memory an episode, so the whole world is made anew, and with it memory
stands still, every ``WORLD_LIFE`` episodes.
"""

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any

from scipy.spatial.transform import Rotation

from lunar_rescue.arrays import Array
from lunar_rescue.physics.client import MOUND_FILE, Client, pb
from lunar_rescue.physics.quiet import decimal_points
from lunar_rescue.physics.simulation import RigidBody
from lunar_rescue.scenes.rocks import Rock
from lunar_rescue.scenes.suit import Limbs, Part, mass_properties, suit_parts
from lunar_rescue.scenes.terrain import Mound, Terrain, mounds

WORLD_LIFE = 512  # episodes
KINDS = {"box": pb.GEOM_BOX, "capsule": pb.GEOM_CAPSULE, "sphere": pb.GEOM_SPHERE}


class Bodies(Client):
    """A world with ground, to which the bodies of one episode after another are added.

    ``ground`` is the handle of the plane and ``relief`` that of the mounds, where the ground is rough; ``friction`` is
    the Coulomb coefficient between any two surfaces.
    """

    def _begin(self) -> None:
        """Add the ground to an empty world."""
        shape = self._client.createCollisionShape(pb.GEOM_PLANE)
        # Without a shape to be seen PyBullet makes one of each collision shape, which costs more than the body itself.
        speck = [(0.0, 0.0, 0.0), (1e-3, 0.0, 0.0), (0.0, 1e-3, 0.0)]
        self._unseen = int(self._client.createVisualShape(pb.GEOM_MESH, vertices=speck, indices=[0, 1, 2]))
        self.ground = int(self._client.createMultiBody(0, shape, self._unseen))
        self.relief: int | None = None
        self._shapes: dict[Any, int] = {}
        self._removable: list[int] = []
        self._episodes = 0
        self.friction = 0.8  # until an episode sets its own

    @property
    def needs_rebuild(self) -> bool:
        """Tell whether the world should be renewed before the next episode."""
        return self._episodes >= WORLD_LIFE

    def add_suit(self, limbs: Limbs, mass: float, offset: Array | None = None) -> RigidBody:
        """Make the astronaut's rigid body, far away; place it with ``place``; see the interface for ``offset``."""
        properties = mass_properties(limbs)
        shape = self._cached_shape(limbs, lambda: self._compound(suit_parts(limbs)))
        centre = properties.centre if offset is None else properties.centre + offset
        pose, axes = centre.tolist(), properties.axes.tolist()
        handle = self._client.createMultiBody(mass, shape, self._unseen, (0, 0, 50), (0, 0, 0, 1), pose, axes)
        self._client.changeDynamics(
            handle,
            -1,
            localInertiaDiagonal=(properties.inertia * mass).tolist(),
            linearDamping=0.0,
            angularDamping=0.0,
            spinningFriction=0.01,  # both small, they stop a rocking body as dust would (assumption) [m]
            rollingFriction=0.005,
        )
        self._set_friction(handle)
        self._removable.append(handle)
        return RigidBody(handle, _inverse_axes(limbs))

    def _compound(self, parts: tuple[Part, ...]) -> int:
        shape: int = self._client.createCollisionShapeArray(
            shapeTypes=[KINDS[p.kind] for p in parts],
            halfExtents=[p.size if p.kind == "box" else (1, 1, 1) for p in parts],
            radii=[0.1 if p.kind == "box" else p.size[0] for p in parts],
            lengths=[p.size[1] if p.kind == "capsule" else 0.1 for p in parts],
            collisionFramePositions=[p.position for p in parts],
            collisionFrameOrientations=[p.quaternion for p in parts],
        )
        return shape

    def _cached_shape(self, key: Any, make: Callable[[], int]) -> int:
        """Return a collision shape, which is built once in a world's life."""
        if key not in self._shapes:
            self._shapes[key] = make()
        return self._shapes[key]

    def add_rock(self, rock: Rock) -> int:
        """Add a rock, a fixed convex body."""
        key = rock.shape, rock.diameter, rock.height
        shape = self._cached_shape(key, lambda: self._hull(rock.corners()))
        return self._add_fixed(shape, rock.middle, rock.yaw)

    def add_hull(self, vertices: Array) -> int:
        """Add a fixed convex body, corners in the world (M, 3) [m]; its shape is not kept."""
        return self._add_fixed(self._hull(vertices), (0.0, 0.0, 0.0), 0.0)

    def _hull(self, corners: Array) -> int:
        return int(self._client.createCollisionShape(pb.GEOM_MESH, vertices=corners.tolist()))

    def add_relief(self, terrain: Terrain) -> int:
        """Add the mounds of a terrain as one fixed body."""
        field = mounds(terrain.relief, terrain.patch)
        shape = self._cached_shape(field, lambda: self._mounds(field))
        self.relief = self._add_fixed(shape, (terrain.x, terrain.y, 0.0), terrain.yaw)
        return self.relief

    def _mounds(self, field: tuple[Mound, ...]) -> int:
        with decimal_points():
            shape = self._client.createCollisionShapeArray(
                shapeTypes=[pb.GEOM_MESH] * len(field),
                fileNames=[str(MOUND_FILE)] * len(field),
                meshScales=[(m.along, m.across, m.height) for m in field],
                collisionFramePositions=[(m.x, m.y, 0.0) for m in field],
                collisionFrameOrientations=[_about_z(m.yaw) for m in field],
            )
        return int(shape)

    def _add_fixed(self, shape: int, position: tuple[float, float, float], yaw: float) -> int:
        handle = int(self._client.createMultiBody(0, shape, self._unseen, position, _about_z(yaw)))
        self._set_friction(handle)
        self._removable.append(handle)
        return handle

    def remove_bodies(self) -> None:
        """Remove all astronauts, rocks and mounds; an episode is over."""
        for handle in self._removable:
            self._client.removeBody(handle)
        self._removable.clear()
        self.relief = None
        self._episodes += 1

    def _set_friction(self, handle: int, link: int = -1) -> None:
        # Bullet multiplies the two surfaces' coefficients, so each has the wanted one's root. Regolith does not bounce.
        self._client.changeDynamics(handle, link, lateralFriction=math.sqrt(self.friction), restitution=0.0)


@lru_cache(maxsize=256)
def _inverse_axes(limbs: Limbs) -> Rotation:
    return Rotation.from_quat(mass_properties(limbs).axes).inv()


def _about_z(yaw: float) -> tuple[float, float, float, float]:
    """Return the quaternion x, y, z, w of a heading [rad]."""
    return 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)
