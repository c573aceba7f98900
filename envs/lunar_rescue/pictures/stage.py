"""Bodies that are only seen, in a client of their own that never steps: no picture can change what happens."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lunar_rescue.arrays import Array, Floats
from lunar_rescue.physics.client import Client, pb
from lunar_rescue.pictures.camera import Camera

#: Geometries of ``Stage.visual_shapes``.
_SHAPES = {getattr(pb, f"GEOM_{kind.upper()}"): kind for kind in ("sphere", "box", "cylinder", "capsule", "mesh")}
#: What PyBullet wants to know of each link that lies at its base and is only seen.
_FIXED_LINK = {
    **dict.fromkeys(("linkMasses", "linkParentIndices"), 0),
    **dict.fromkeys(("linkPositions", "linkInertialFramePositions"), (0.0, 0.0, 0.0)),
    **dict.fromkeys(("linkOrientations", "linkInertialFrameOrientations"), (0.0, 0.0, 0.0, 1.0)),
    "linkCollisionShapeIndices": -1,
    "linkJointTypes": pb.JOINT_FIXED,
    "linkJointAxis": (0.0, 0.0, 1.0),
}


class VisualShape(NamedTuple):
    """One shape of a link."""

    link: int  # its index, -1 for the base
    kind: str  # sphere, box, cylinder, capsule or mesh
    size: tuple[float, float, float]  # of a box; length, radius of a cylinder or capsule; radius of a sphere [m]
    position: tuple[float, float, float]  # in the link's frame [m]
    quaternion: tuple[float, float, float, float]  # in the link's frame, x y z w
    colour: tuple[float, float, float]  # red, green, blue from 0 to 1


class Stage(Client):
    """A world of bodies that pictures are taken of; nothing in it moves by itself."""

    def add_mesh(self, *pieces: tuple[Array, Array, NDArray[np.int64], tuple[float, ...]]) -> int:
        """Add one body of triangles; each piece has corners (V, 3) [m], normals (V, 3), indices (F, 3) and a colour.

        The first piece is the body's base, each other one a link of it.
        """
        first, *rest = [
            self._client.createVisualShape(
                pb.GEOM_MESH,
                vertices=vertices.tolist(),
                indices=faces.ravel().tolist(),
                normals=normals.tolist(),
                uvs=[(0.0, 0.0)] * len(vertices),
                rgbaColor=(*colour, 1.0),
                specularColor=(0, 0, 0),
            )
            for vertices, normals, faces, colour in pieces
        ]
        links = {name: [value] * len(rest) for name, value in _FIXED_LINK.items()}
        return int(self._client.createMultiBody(0, -1, first, linkVisualShapeIndices=rest, **links))

    def add_robot(self, path: Path) -> tuple[int, dict[str, int], dict[int, tuple[float, ...]]]:
        """Load a robot file; return its handle, the joints' indices by name and the links' colours by index."""
        handle = self._load_urdf(path)
        rows = [self._client.getJointInfo(handle, i) for i in range(self._client.getNumJoints(handle))]
        colours = {int(row[1]): tuple(row[7][:3]) for row in self._client.getVisualShapeData(handle)}
        return handle, {row[1].decode(): row[0] for row in rows}, colours

    def visual_shapes(self, handle: int) -> list[VisualShape]:
        """Return every shape of a body that is seen."""
        return [
            VisualShape(int(row[1]), _SHAPES[row[2]], tuple(row[3]), tuple(row[5]), tuple(row[6]), tuple(row[7][:3]))
            for row in self._client.getVisualShapeData(handle)
        ]

    def link_poses(self, handle: int) -> dict[int, tuple[Array, Array]]:
        """Return place (3,) [m] and quaternion (4,), x y z w, of each link's frame; -1 is the base."""
        links = range(self._client.getNumJoints(handle))
        poses = {-1: self._client.getBasePositionAndOrientation(handle)}
        states = self._client.getLinkStates(handle, list(links), computeForwardKinematics=True)
        poses |= {link: state[4:6] for link, state in zip(links, states, strict=True)}
        return {link: (np.array(place), np.array(turn)) for link, (place, turn) in poses.items()}

    def paint(self, handle: int, link: int, colour: tuple[float, ...]) -> None:
        """Give one link (-1 is the base) another colour."""
        self._client.changeVisualShape(handle, link, rgbaColor=(*colour, 1.0))

    def clear(self) -> None:
        """Take everything away; handles begin anew."""
        self._client.resetSimulation()

    def place(self, handle: int, position: Array, quaternion: Array) -> None:
        """Put a body at a position (3,) [m] with a quaternion x, y, z, w."""
        self._client.resetBasePositionAndOrientation(handle, position.tolist(), quaternion.tolist())

    def turn_joints(self, handle: int, joints: list[int], angles: Array) -> None:
        """Set the angles of these joints (n,) [rad]."""
        self._client.resetJointStatesMultiDof(handle, joints, [(a,) for a in angles.tolist()], [(0.0,)] * len(joints))

    def look(self, camera: Camera, sun: Camera) -> tuple[Floats, Floats, NDArray[np.int64]]:
        """Return what a camera sees by the software renderer, all (height, width), lit from where another one stands.

        First the cosine between surface and light (of what is white), then depth in [0, 1], then the body seen with its
        link in the upper bits, -1 for nothing.
        """
        width, height = camera.size
        _, _, colours, depth, bodies = self._client.getCameraImage(
            width,
            height,
            camera.view.T.ravel().tolist(),
            camera.projection.T.ravel().tolist(),
            renderer=pb.ER_TINY_RENDERER,
            flags=pb.ER_SEGMENTATION_MASK_OBJECT_AND_LINKINDEX,
            shadow=0,
            lightDirection=sun.towards.tolist(),
            lightAmbientCoeff=0.0,
            lightDiffuseCoeff=1.0,
            lightSpecularCoeff=0.0,
        )
        shade = (np.reshape(colours, (height, width, 4))[:, :, 0] / 255).astype(np.float32)
        return shade, np.reshape(depth, (height, width)), np.reshape(bodies, (height, width))
