"""PyBullet's window, in which an episode can be watched and turned round with the mouse; it needs a display."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lunar_rescue.physics.client import pb
from lunar_rescue.pictures import regolith
from lunar_rescue.pictures.camera import scene_camera
from lunar_rescue.pictures.overlay import (
    ARM_COLOURS,
    MARK_COLOUR,
    SUBGOAL_COLOUR,
    Colour,
    caption,
    near_colour,
    nearest_links,
    subgoals_in_scene,
)
from lunar_rescue.pictures.rendering import ground_mesh
from lunar_rescue.pictures.stage import Stage
from lunar_rescue.pictures.stage_set import StageSet

if TYPE_CHECKING:
    from lunar_rescue.episode import Episode

Array = NDArray[np.float64]
PROBE_SECONDS = 30.0
DRAW_EVERY = 4  # steps; each line takes the window a frame, and the robot should move in real time
CLOSER = 0.7  # the window's field of view is wider than a picture's


def why_no_window() -> str | None:
    """The reason why no window can be opened here, or None where one can.

    PyBullet ends the whole process where it finds no display, so another process tries first.
    """
    if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        return "no display: neither DISPLAY nor WAYLAND_DISPLAY is set"
    attempt = "from lunar_rescue.pictures.window import WindowStage; WindowStage().close()"
    try:
        done = subprocess.run([sys.executable, "-c", attempt], capture_output=True, timeout=PROBE_SECONDS, check=False)
    except subprocess.TimeoutExpired:
        return f"PyBullet's window did not open within {PROBE_SECONDS:g} s"
    if done.returncode == 0:
        return None
    return f"PyBullet's window does not open on display {os.environ.get('DISPLAY', '')!r} (needs X with OpenGL 3.3)"


class WindowStage(Stage):
    """A stage that is seen in PyBullet's window."""

    def __init__(self) -> None:
        super().__init__(pb.GUI)
        self._client.configureDebugVisualizer(pb.COV_ENABLE_GUI, 0)
        self._client.configureDebugVisualizer(rgbBackground=(0, 0, 0))
        self._client.configureDebugVisualizer(lightPosition=(6, -8, 9), shadowMapResolution=4096)
        self._drawn: list[int] = []
        self._words: list[int] = []
        self._points = -1

    @property
    def is_open(self) -> bool:
        """Whether there is still a window to draw in."""
        return self._client is not None and bool(self._client.isConnected())

    def clear(self) -> None:
        """Take everything away; handles begin anew."""
        super().clear()
        self._drawn, self._words, self._points = [], [], -1

    def aim(self, target: Array, distance: float, yaw: float, pitch: float) -> None:
        """Point the window's camera; angles [deg], distance [m]."""
        self._client.resetDebugVisualizerCamera(distance, yaw, pitch, target.tolist())

    def draw(
        self,
        lines: list[tuple[Array, Array, tuple[float, ...]]],
        points: tuple[Array, Array],
        words: list[str],
        place: Array,
    ) -> None:
        """Draw into the window, instead of what the last call drew; every item costs the window a frame.

        Args:
            lines: Start (3,), end (3,) [m] and colour of each.
            points: Places (n, 3) [m] and colours (n, 3).
            words: Lines of text.
            place: Where the first of them begins (3,) [m].
        """
        self._points = self._client.addUserDebugPoints(
            points[0].tolist(), points[1].tolist(), 5.0, replaceItemUniqueId=self._points
        )
        drawn = self._drawn + [-1] * (len(lines) - len(self._drawn))
        for index, (start, end, colour) in enumerate(lines):
            drawn[index] = self._client.addUserDebugLine(
                start.tolist(), end.tolist(), colour, 3.0, replaceItemUniqueId=drawn[index]
            )
        for item in drawn[len(lines) :]:
            self._client.removeUserDebugItem(item)
        self._drawn = drawn[: len(lines)]
        below = np.array([0.0, 0.0, 0.09])
        self._words += [-1] * (len(words) - len(self._words))
        for index, line in enumerate(words):
            self._words[index] = self._client.addUserDebugText(
                line, (place - index * below).tolist(), (1, 1, 1), 1.1, replaceItemUniqueId=self._words[index]
            )


class Window:
    """Shows episodes in PyBullet's window; make one only where ``why_no_window`` gives no reason against it."""

    def __init__(self) -> None:
        """Open the window."""
        self._stage = WindowStage()
        self._set = StageSet(self._stage)

    @property
    def is_open(self) -> bool:
        """Whether somebody can still see it."""
        return self._stage.is_open

    def close(self) -> None:
        """Close the window."""
        self._set.close()

    def show(self, episode: Episode, subgoals: Array | None = None, note: str = "") -> None:
        """Show an episode as it is now, with targets, mark points and distances.

        Args:
            episode: The episode.
            subgoals: Of arm A and arm B in the robot's base frame (2, 3) [m], if the policy has any.
            note: Added to the caption.
        """
        stage, camera = self._stage, scene_camera(episode.scene)
        turn = np.array(camera.upright)
        middle = turn @ np.array(camera.target)
        if self._set.show(episode, upright=turn):
            mesh = ground_mesh(episode.scene, camera)
            stage.add_mesh((mesh.vertices @ turn.T, mesh.normals @ turn.T, mesh.faces, regolith.GREY))
            stage.aim(middle, CLOSER * camera.distance, camera.yaw, camera.pitch)
        if episode.steps % DRAW_EVERY and not note:
            return
        left = np.array([-np.cos(np.radians(camera.yaw)), -np.sin(np.radians(camera.yaw)), 0.0])
        lines = [(turn @ start, turn @ end, colour) for start, end, colour in _lines(episode, subgoals)]
        places, colours = _points(episode, subgoals)
        stage.draw(lines, (places @ turn.T, colours), caption(episode, note), middle + left + [0.0, 0.0, 1.1])


def _lines(episode: Episode, subgoals: Array | None) -> list[tuple[Array, Array, tuple[float, ...]]]:
    """Lines (start, end, colour in [0, 1]): arm ends to targets and sub-goals, and the nearest joint to a rock."""
    ends = episode.robot.ends
    lines: list[tuple[Array, Array, Colour]] = list(zip(ends, episode.targets(), ARM_COLOURS, strict=True))
    links = nearest_links(episode.robot.points, episode.marks)
    for link in sorted(links, key=lambda link: link.distance)[:1]:
        lines.append((link.joint, link.mark, near_colour(link.distance)))
    if subgoals is not None:
        lines += [(e, s, SUBGOAL_COLOUR) for e, s in zip(ends, subgoals_in_scene(episode, subgoals), strict=True)]
    return [(start, end, tuple(c / 255 for c in colour)) for start, end, colour in lines]


def _points(episode: Episode, subgoals: Array | None) -> tuple[Array, Array]:
    """Targets, sub-goals and mark points (n, 3) [m] with colours in [0, 1] (n, 3)."""
    places, colours = [episode.targets(), episode.marks], [*ARM_COLOURS, *[MARK_COLOUR] * len(episode.marks)]
    if subgoals is not None:
        places.append(subgoals_in_scene(episode, subgoals))
        colours += [SUBGOAL_COLOUR] * 2
    return np.concatenate(places), np.array(colours) / 255
