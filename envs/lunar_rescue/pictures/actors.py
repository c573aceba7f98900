"""A rescue as a scene of viser's: what stands in it and what moves, for the live view and for replays in a file."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lunar_rescue.pictures import shapes
from lunar_rescue.pictures.camera import scene_camera
from lunar_rescue.pictures.overlay import (
    ARM_COLOURS,
    MARK_COLOUR,
    NEAR_STOPS,
    SUBGOAL_COLOUR,
    Link,
    caption,
    near_colour,
    nearest_links,
    subgoals_in_scene,
)
from lunar_rescue.pictures.stage import Stage, VisualShape
from lunar_rescue.pictures.stage_set import StageSet, suit_pose
from lunar_rescue.scenes.rocks import rock_marks
from lunar_rescue.scenes.scene import Scene
from lunar_rescue.tasks import TARGET_RADIUS

if TYPE_CHECKING:
    import viser

    from lunar_rescue.episode import Episode

Array = NDArray[np.float64]

GROUND_HALF, GROUND_POINTS = 2.4, 97  # m, points a side
REGOLITH = (0.42, 0.41, 0.39)
BACKGROUND = (8, 9, 12)
FIELD_OF_VIEW = np.radians(42.0)
FAR_AWAY = np.full(3, -50.0)  # m, where things are put that are not to be seen


@dataclass(frozen=True)
class Moment:
    """Say where everything is after one step: places [m] and quaternions, x y z w, in the scene."""

    links: dict[int, tuple[Array, Array]]  # place and quaternion of each link's frame
    suit: tuple[Array, Array]  # place and quaternion of the suit's meshes
    ends: Array  # arm ends (2, 3)
    targets: Array  # target areas (2, 3)
    subgoals: Array | None  # (2, 3)
    near: list[tuple[Array, tuple[int, int, int]]]  # for each rock the line (2, 3) to the nearest joint, and its colour
    words: str  # caption


class Spectator:
    """Look at an episode and tell where everything is; a stage of its own computes the links' poses."""

    def __init__(self) -> None:
        self._stage = StageSet(Stage())
        self.robot: list[VisualShape] = []

    def look(self, episode: Episode, subgoals: NDArray[Any] | None = None, words: str = "") -> tuple[Moment, bool]:
        """Return the moment and whether it is the first of another scene.

        ``subgoals`` are those of arm A and arm B in the base frame (2, 3) [m], if the policy has any; ``words`` are
        added to the caption.
        """
        new = self._stage.show(episode)
        if new:
            self.robot = self._stage.stage.visual_shapes(self._stage.robot)
        links = nearest_links(episode.robot.points, episode.marks) if len(episode.marks) else []
        has_subgoals = subgoals is not None and np.isfinite(subgoals).all()
        moment = Moment(
            self._stage.stage.link_poses(self._stage.robot),
            suit_pose(episode),
            episode.robot.ends.copy(),
            episode.targets().copy(),
            subgoals_in_scene(episode, np.asarray(subgoals)) if has_subgoals else None,
            [(_line(link), near_colour(link.distance)) for link in links],
            "\n".join(caption(episode, words)),
        )
        return moment, new

    def close(self) -> None:
        """Take the stage down; a second call does nothing."""
        self._stage.close()


def _line(link: Link) -> Array:
    """Return the line (2, 3) [m] from a joint to a rock, out of sight where they are far from each other."""
    return np.stack([link.joint, link.mark] if link.distance < 2 * NEAR_STOPS[-1] else [FAR_AWAY, FAR_AWAY])


class Actors:
    """What stands in the scene, and what moves."""

    def __init__(
        self, server: viser.ViserServer, scene: Scene, robot: list[VisualShape], first: Moment, subgoals: bool
    ) -> None:
        """Put everything into a server's empty scene, where it is in the ``first`` moment.

        ``robot`` is what of the robot is seen; ``subgoals`` says whether there are any to be shown.
        """
        self._scene = server.scene
        camera: Any = server.initial_camera
        view = scene_camera(scene)  # as of the pictures of ``reproduce replay``
        camera.position, camera.look_at, camera.up = view.eye, np.array(view.target), scene.terrain.up()
        camera.fov = FIELD_OF_VIEW
        self._light(scene)
        self._stand(scene)
        self._links = self._robot(robot)
        self._suit = self._scene.add_frame("/astronaut", show_axes=False)
        for index, (colour, mesh) in enumerate(shapes.suit_shapes(scene.model.limbs).items()):
            self._mesh(f"/astronaut/part{index}", mesh.vertices, mesh.faces, colour)
        self._ends = self._balls("ends", 0.02, ARM_COLOURS, subdivisions=2)
        self._targets = self._balls("targets", TARGET_RADIUS, ARM_COLOURS, opacity=0.35, cast_shadow=False)
        colours = (SUBGOAL_COLOUR,) * 2 if subgoals else ()
        self._subgoals = self._balls("subgoals", 0.035, colours, subdivisions=1, flat_shading=True)
        looks: dict[str, Any] = {"thickness": 2.0, "thickness_units": "screen"}
        self._lines = self._scene.add_line_segments("/distances", *_segments(first), **looks)
        above = scene.terrain.height(scene.base_x, scene.base_y)
        place = np.array([scene.base_x, scene.base_y, float(above) + 1.15])
        self._words = self._scene.add_label("/caption", first.words, position=place, anchor="bottom-center")

    def show(self, moment: Moment) -> None:
        """Move everything to where it is at a moment."""
        poses = [(self._suit, moment.suit), *((self._links[n], p) for n, p in moment.links.items() if n in self._links)]
        for actor, (place, quaternion) in poses:
            actor.position, actor.wxyz = place, np.roll(quaternion, 1)
        # The last moment has no sub-goals: they stay where they were.
        places = [*moment.ends, *moment.targets, *(() if moment.subgoals is None else moment.subgoals)]
        for ball, place in zip([*self._ends, *self._targets, *self._subgoals], places, strict=False):
            ball.position = place
        self._lines.points, self._lines.colors = _segments(moment)
        self._words.text = moment.words

    def _balls(self, name: str, radius: float, colours: Iterable[Any], **looks: Any) -> list[Any]:
        return [self._scene.add_icosphere(f"/{name}/{i}", radius, c, **looks) for i, c in enumerate(colours)]

    def _mesh(self, name: str, vertices: Array, faces: NDArray[np.int64], colour: tuple[float, ...]) -> None:
        corners, triangles = vertices.astype(np.float32), faces.astype(np.uint32)
        self._scene.add_mesh_simple(name, corners, triangles, color=np.array(colour), side="double")

    def _light(self, scene: Scene) -> None:
        # Nothing casts shadows: at this size the player's shadow maps are coarser than what they fall on.
        self._scene.configure_environment_map(None)
        self._scene.configure_default_lights(enabled=False)
        yaw = np.degrees(scene.base_yaw)
        # The sun stands low beside the robot, as in the pictures; what the ground throws back lights the far sides.
        for name, turn, height, strength in (("sun", -40.0, 33.0, 2.6), ("back", 140.0, 40.0, 0.7)):
            azimuth, up = np.radians(yaw + turn), np.radians(height)
            place = 10.0 * np.array([np.cos(azimuth) * np.cos(up), np.sin(azimuth) * np.cos(up), np.sin(up)])
            self._scene.add_light_directional(f"/light/{name}", intensity=strength, position=tuple(place.tolist()))
        self._scene.add_light_ambient("/light/ground", intensity=0.5)

    def _stand(self, scene: Scene) -> None:
        """Set up what never moves: sky, ground, rocks and their mark points."""
        self._scene.set_up_direction(tuple(scene.terrain.up()))
        self._scene.set_background_image(np.full((2, 2, 3), BACKGROUND, np.uint8), format="png")
        line = np.linspace(-GROUND_HALF, GROUND_HALF, GROUND_POINTS)
        middle = np.array([scene.base_x + scene.astronaut_x, scene.base_y + scene.astronaut_y]) / 2
        x, y = np.meshgrid(middle[0] + line, middle[1] + line)
        ground = np.stack([x, y, scene.terrain.height(x, y)], axis=-1).reshape(-1, 3)
        self._mesh("/ground", ground, shapes.lattice(GROUND_POINTS, GROUND_POINTS), REGOLITH)
        for index, rock in enumerate(scene.rocks):
            solid = shapes.hull(rock.vertices())
            self._mesh(f"/rocks/{index}", solid.vertices, solid.faces, shapes.BASALT)
        if scene.rocks:
            marks = rock_marks(scene.rocks).reshape(-1, 3).astype(np.float32)
            self._scene.add_point_cloud("/marks", marks, MARK_COLOUR, point_size=0.012, point_shape="circle")

    def _robot(self, robot: list[VisualShape]) -> dict[int, Any]:
        """Add the robot's shapes, each below the frame of its link, and return the frames by link."""
        names = {link: f"/robot/link{link}" for link in dict.fromkeys(shape.link for shape in robot)}
        frames = {link: self._scene.add_frame(name, show_axes=False) for link, name in names.items()}
        for index, shape in enumerate(robot):
            solid = _solid(shape)
            vertices = Rotation.from_quat(shape.quaternion).apply(solid.vertices) + shape.position
            self._mesh(f"{names[shape.link]}/shape{index}", vertices, np.asarray(solid.faces), shape.colour)
        return frames


def _segments(moment: Moment) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return lines (n, 2, 3) [m] from ends to targets and from joints to rocks, and their colours (n, 2, 3)."""
    lines = [*np.stack([moment.ends, moment.targets], axis=1), *(line for line, _ in moment.near)]
    colours = [*ARM_COLOURS, *(colour for _, colour in moment.near)]
    return np.array(lines, np.float32), np.repeat(np.array(colours, np.uint8)[:, None], 2, axis=1)


def _solid(shape: VisualShape) -> trimesh.Trimesh:
    length, radius, _ = shape.size
    match shape.kind:
        case "box":
            return trimesh.creation.box(shape.size)
        case "cylinder":
            return trimesh.creation.cylinder(radius, length, sections=24)
        case "capsule":
            solid = trimesh.creation.capsule(length, radius, count=[16, 12])
            solid.vertices -= solid.bounds.mean(axis=0)  # some versions begin it at one end
            return solid
        case "sphere":
            return trimesh.creation.icosphere(2, radius=shape.size[0])
    raise ValueError(f"robot file: a replay cannot draw a {shape.kind}")
