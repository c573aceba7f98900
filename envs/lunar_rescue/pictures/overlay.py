"""What the rewards look at, drawn into a picture (F2): targets, sub-goals, mark points of rocks, and distances."""

from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from lunar_rescue.arrays import Array
from lunar_rescue.episode import Episode
from lunar_rescue.physics.robot import ARMS
from lunar_rescue.pictures.camera import Camera
from lunar_rescue.pictures.rendering import Picture
from lunar_rescue.pictures.stage_set import base_frame
from lunar_rescue.tasks import TARGET_RADIUS

Colour = tuple[int, int, int]

ARM_COLOURS: tuple[Colour, Colour] = ((90, 170, 255), (255, 160, 60))  # arm A, arm B
SUBGOAL_COLOUR: Colour = (110, 235, 120)
MARK_COLOUR: Colour = (235, 235, 235)
#: Colour of a distance to a mark point: red when touching, yellow on the way, faint when far [m].
NEAR_STOPS: tuple[float, ...] = (0.10, 0.25, 0.50)
NEAR_COLOURS: tuple[Colour, ...] = ((255, 60, 50), (255, 215, 70), (150, 170, 150))
PROCESSES = {1: "getting both arms under", 2: "raising"}


class Link(NamedTuple):
    """A joint and the mark point that is nearest to it."""

    joint: Array  # place of the joint (3,) [m]
    mark: Array  # place of the mark point (3,) [m]
    distance: float  # between them [m]


def nearest_links(points: Array, marks: Array) -> list[Link]:
    """Return for each rock the joint or end (12, 3) [m] and the one of its five marks (5 n, 3) [m] that are nearest."""
    links = []
    for rock in marks.reshape(-1, 5, 3):
        distances = np.linalg.norm(points[:, None] - rock[None], axis=-1)
        joint, mark = np.unravel_index(distances.argmin(), distances.shape)
        links.append(Link(points[joint], rock[mark], float(distances[joint, mark])))
    return links


def subgoals_in_scene(episode: Episode, subgoals: Array) -> Array:
    """Take sub-goals (2, 3) [m] from the robot's base frame, in which policies give them, to the scene."""
    origin, axes = base_frame(episode)
    return np.asarray(subgoals @ axes.T + origin)


def draw_overlay(
    picture: Picture, episode: Episode, camera: Camera, subgoals: Array | None = None, note: str = ""
) -> Picture:
    """Draw what the rewards look at into a picture of an episode.

    Rings are the target areas and dots the arm ends, joined by a line with the distance, blue for arm A and orange for
    arm B. Diamonds are sub-goals (of arm A and arm B in the robot's base frame, (2, 3) [m]), if the policy has any.
    Crosses are the rocks' mark points; a line leads from the nearest joint to each rock, red when near. ``picture``
    (height, width, 3) is what ``Studio.picture`` took of this episode with this camera, and the new one has its size;
    ``note`` is added to the caption, such as how the episode ended.
    """
    image = Image.fromarray(picture)
    pen = _Pen(ImageDraw.Draw(image, "RGBA"), camera)
    _draw_rocks(pen, episode)
    _draw_targets(pen, episode)
    if subgoals is not None and np.isfinite(subgoals).all():
        places = subgoals_in_scene(episode, subgoals)
        for end, place, colour in zip(episode.robot.ends, places, ARM_COLOURS, strict=True):
            pen.line(end, place, SUBGOAL_COLOUR, 150)
            pen.diamond(place, SUBGOAL_COLOUR, colour)
    _draw_caption(pen, caption(episode, note))
    return np.asarray(image, dtype=np.uint8)


def caption(episode: Episode, note: str = "") -> list[str]:
    """Return the two lines under a picture: task, step, process; distances to targets and the nearest rock."""
    e = episode
    first = f"{e.scene.task.replace('_', ' ')}, {e.scene.posture.replace('_', ' ')}   step {e.steps}   "
    first += note or f"process {e.process}: {PROCESSES[e.process]}"
    away = np.linalg.norm(e.robot.ends - e.targets(), axis=1)
    second = "   ".join(f"{arm.name} to target {d:.2f} m" for arm, d in zip(ARMS, away, strict=True))
    if len(e.marks):
        second += f"   joint to rock {min(link.distance for link in nearest_links(e.robot.points, e.marks)):.2f} m"
    return [first, second]


class _Pen:
    """Draws shapes given in the scene; nothing behind the camera."""

    def __init__(self, draw: ImageDraw.ImageDraw, camera: Camera) -> None:
        self.draw, self.camera, self.width = draw, camera, max(1, round(camera.size[1] / 352))
        self.text_size = 12 * self.width  # px
        self.font = ImageFont.load_default(self.text_size)

    def _at(self, points: Array) -> Array:
        seen = self.camera.project(np.atleast_2d(points))
        return seen[seen[:, 2] > self.camera.near]

    def line(self, start: Array, end: Array, colour: Colour, opacity: int = 230) -> None:
        seen = self._at(np.array([start, end]))
        if len(seen) == 2:
            self.draw.line([tuple(p) for p in seen[:, :2].tolist()], (*colour, opacity), self.width)

    def disc(self, place: Array, radius: float, colour: Colour, fill: int) -> None:
        """Draw a ball of some radius [m] as a ring, filled with some opacity."""
        for x, y, depth in self._at(place).tolist():
            r = max(radius * self.camera.pixels_per_metre(depth), 2.0 * self.width)
            self.draw.ellipse((x - r, y - r, x + r, y + r), (*colour, fill), (*colour, 255), self.width)

    def cross(self, place: Array, colour: Colour) -> None:
        size = 2 * self.width
        for x, y, _ in self._at(place).tolist():
            for lean in (-1, 1):
                self.draw.line((x - size, y - lean * size, x + size, y + lean * size), (*colour, 230), self.width)

    def diamond(self, place: Array, colour: Colour, edge: Colour) -> None:
        size = 5 * self.width
        for x, y, _ in self._at(place).tolist():
            corners = [(x - size, y), (x, y - size), (x + size, y), (x, y + size)]
            self.draw.polygon(corners, (*colour, 210), (*edge, 255))

    def text(self, place: Array, words: str, colour: Colour) -> None:
        for x, y, _ in self._at(place).tolist():
            corner = x + 5 * self.width, y - 16 * self.width
            left, top, right, bottom = self.draw.textbbox(corner, words, font=self.font)
            edge = 2 * self.width
            self.draw.rectangle((left - edge, top - edge, right + edge, bottom + edge), (0, 0, 0, 150))
            self.draw.text(corner, words, (*colour, 255), font=self.font)


def _draw_rocks(pen: _Pen, episode: Episode) -> None:
    for mark in episode.marks:
        pen.cross(mark, MARK_COLOUR)
    for link in nearest_links(episode.robot.points, episode.marks):
        if link.distance < 2 * NEAR_STOPS[-1]:
            colour = near_colour(link.distance)
            pen.line(link.joint, link.mark, colour, 210 if link.distance < NEAR_STOPS[-1] else 110)
            if link.distance < NEAR_STOPS[-1]:
                pen.text((link.joint + link.mark) / 2, f"{100 * link.distance:.0f} cm", colour)


def near_colour(distance: float) -> Colour:
    """Return the colour of a distance to a mark point [m]."""
    red, green, blue = (int(np.interp(distance, NEAR_STOPS, channel)) for channel in zip(*NEAR_COLOURS, strict=True))
    return red, green, blue


def _draw_targets(pen: _Pen, episode: Episode) -> None:
    for end, target, colour in zip(episode.robot.ends, episode.targets(), ARM_COLOURS, strict=True):
        away = float(np.linalg.norm(end - target))
        pen.disc(target, TARGET_RADIUS, colour, 60)
        pen.line(end, target, colour)
        pen.disc(end, 0.012, colour, 255)
        if away > TARGET_RADIUS:
            pen.text((end + target) / 2, f"{100 * away:.0f} cm", colour)


def _draw_caption(pen: _Pen, lines: list[str]) -> None:
    (width, height), step = pen.camera.size, 15 * pen.width
    top = height - step * len(lines) - 4 * pen.width
    pen.draw.rectangle((0, top, width, height), (0, 0, 0, 170))
    widest = max(map(pen.font.getlength, lines))
    size = pen.text_size * min(1.0, (width - 16 * pen.width) / widest)  # so that small pictures cut nothing off
    for index, line in enumerate(lines):
        place = (8 * pen.width, top + 2 * pen.width + index * step)
        pen.draw.text(place, line, (240, 240, 240), font=ImageFont.load_default(size))
