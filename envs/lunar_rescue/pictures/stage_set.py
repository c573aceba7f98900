"""The bodies of a scene on a stage, moved as the episode goes."""

import tempfile
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

from lunar_rescue.arrays import Array
from lunar_rescue.episode import Episode
from lunar_rescue.physics.client import DATA, ROBOT_FILE
from lunar_rescue.physics.robot import JOINT_NAMES
from lunar_rescue.pictures import shapes
from lunar_rescue.pictures.stage import Stage
from lunar_rescue.scenes.scene import Scene
from lunar_rescue.scenes.suit import mass_properties

DETAILS_FILE = DATA / "robot_details.urdf"  # links of the robot that are only seen
GAMMA = 2.2  # from brightness to what screens expect


def base_frame(episode: Episode) -> tuple[Array, Array]:
    """Return origin (3,) [m] and axes (3, 3), in columns, of the robot's base in the scene."""
    origin = episode.observer.to_base(np.zeros((1, 3)))
    axes = (episode.observer.to_base(np.eye(3)) - origin).T
    return -axes.T @ origin[0], axes.T


class StageSet:
    """The bodies of a scene on a stage, moved as the episode goes."""

    def __init__(self, stage: Stage, coarse: bool = False) -> None:
        """Prepare the robot's file for a stage on which nothing stands yet.

        For small pictures, ``coarse`` leaves out the robot's details and draws the suit with fewer triangles.
        """
        self.stage = stage
        self._detail = shapes.COARSE if coarse else shapes.FINE
        self._scene: Scene | None = None
        self._folder = tempfile.TemporaryDirectory(prefix="lunar_rescue_")
        self._robot_file = Path(self._folder.name) / "robot.urdf"
        robot = ElementTree.parse(ROBOT_FILE)
        if not coarse:
            robot.getroot().extend(ElementTree.parse(DETAILS_FILE).getroot())
        robot.write(self._robot_file)

    def close(self) -> None:
        """Disconnect the stage and remove its files."""
        self.stage.close()
        self._folder.cleanup()

    def show(self, episode: Episode, colour: shapes.Colour | None = None) -> bool:
        """Put everything where it is, in its own colours or all in one; return whether the scene is new."""
        new = episode.scene is not self._scene
        if new:
            self._build(episode.scene, colour)
            self._scene = episode.scene
            origin, axes = base_frame(episode)
            self.stage.place(self.robot, origin, Rotation.from_matrix(axes).as_quat())
        self.stage.turn_joints(self.robot, self._joints, episode.robot.angles)
        self.stage.place(self.suit, *suit_pose(episode))
        return new

    def _build(self, scene: Scene, colour: shapes.Colour | None) -> None:
        self.stage.clear()
        self.robot, joints, links = self.stage.add_robot(self._robot_file)
        self._joints = [joints[name] for name in JOINT_NAMES]
        suit = shapes.suit_shapes(scene.model.limbs, self._detail)
        self.suit = self._add(suit, colour)
        self.stones = [self._add({shapes.BASALT: shapes.hull(rock.vertices())}, colour) for rock in scene.rocks]
        self.colours = np.ones((max([self.robot, self.suit, *self.stones]) + 1, len(joints) + 1, 3), np.float32)
        for link, own in links.items():
            self.colours[self.robot, link + 1] = own
            self.stage.paint(self.robot, link, colour or own)
        self.colours[self.suit, : len(suit)] = list(suit)
        self.colours[self.stones] = shapes.BASALT
        self.colours **= GAMMA
        self.rocky = np.isin(np.arange(len(self.colours)), self.stones)

    def _add(self, meshes: dict[shapes.Colour, shapes.Mesh], colour: shapes.Colour | None) -> int:
        return self.stage.add_mesh(*((*mesh, colour or own) for own, mesh in meshes.items()))


def suit_pose(episode: Episode) -> tuple[Array, Array]:
    """Return place (3,) [m] and quaternion, x, y, z, w, of the suit's meshes."""
    rotation = episode.body.rotation
    centre = episode.body.centre - rotation @ mass_properties(episode.scene.model.limbs).centre
    return centre, Rotation.from_matrix(rotation).as_quat()
