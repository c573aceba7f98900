"""From what the network sees to the whole state vector s_t, as the environment would fill it, and an environment so."""

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from scipy.spatial.transform import Rotation

from lunar_rescue.arrays import Array, Floats
from lunar_rescue.observation import BOUND, GROUND_POINTS, SLICES
from lunar_rescue.physics.astronaut import BodyGeometry, body_geometry
from lunar_rescue.physics.robot import INITIAL, WINDOW
from lunar_rescue.pictures.head import Sight
from lunar_rescue.scenes.postures import Posture, postures
from lunar_rescue.scenes.rocks import MAX_ROCKS
from lunar_rescue.scenes.scene import TASKS
from lunar_rescue.scenes.targets import approach_sides
from lunar_rescue.seeing import UP, SeeingEnv
from reproduce.learning.actions import ANGLES
from reproduce.perception.network import (
    MIDDLE,
    OWN,
    SQUARE,
    Embedding,
    EmbeddingSpec,
    Seen,
    State,
    moved,
    picture_input,
)
from reproduce.perception.refining import RESTING, Pose, body_points, refine, suit_surface
from reproduce.storage.paths import RESULTS
from reproduce.storage.policies import load_networks

FOLDER = RESULTS / "perception"
LEVEL = "embedding"  # name of the network in the files of weights
# Both are set so that precision and recall are equal on 1,500 training scenes that no training looks at.
SHOWN = 0.25  # share of a square from which on it counts as one that shows a rock
FEWEST = 1.6  # px, of a rock that is taken for one
APART = 0.15  # m, what is said of rocks no further apart is said of one
LOOKS = [(right, down) for right in range(-2, 3) for down in range(-2, 3)]  # px, moves of a picture looked at for rocks
LOWEST = 0.03  # m, targets lie no lower
TRIED = 3  # postures, the likeliest, whose suits are put onto the first picture
LOST = 0.15  # misfit from which on the network is asked where the body is; the right posture's is nearly always less
FIT = 20.0  # what a perfect fit adds to the logarithm of a posture's odds, beside the worst


@lru_cache(maxsize=1)
def kinds() -> tuple[Posture, ...]:
    """Return the 20 postures in the order of the network's classes."""
    return tuple(postures().values())


def load_embedding(folder: Path = FOLDER) -> Embedding:
    """Read a trained network.

    Raises:
        UserError: Where weights are missing, or are not of this network.
    """
    network = load_networks(folder, {LEVEL: (len(OWN), len(postures()))}, EmbeddingSpec)[LEVEL]
    assert isinstance(network, Embedding)
    return network


def fit_body(points: Array, weights: Array, model: Array) -> tuple[Array, Array]:
    """Return place (3,) and rotation (3, 3) that bring a rigid body's points (n, 3) [m] nearest to seen ones (n, 3)."""
    share = weights / weights.sum()
    middle, own = share @ points, share @ model
    rotation = Rotation.align_vectors(points - middle, model - own, weights)[0].as_matrix()
    return middle - rotation @ own, rotation


def fit_resting_body(points: Array, weights: Array, model: Array, posture: Posture) -> tuple[Array, Array]:
    """Return the same of a body that lies at rest: its height and how it lies are known, place and heading are not."""
    rest = posture.rest_rotation().as_matrix()
    lying, share = model @ rest.T, weights / weights.sum()
    seen, known = points[:, :2] - share @ points[:, :2], lying[:, :2] - share @ lying[:, :2]
    sine = float((weights * (known[:, 0] * seen[:, 1] - known[:, 1] * seen[:, 0])).sum())
    cosine = float((weights * (known * seen).sum(axis=1)).sum())
    turn = Rotation.from_euler("z", np.arctan2(sine, cosine)).as_matrix()
    place = share @ points - turn @ (share @ lying)
    return np.array([place[0], place[1], posture.rest.height]), turn @ rest


def read_rocks(rocks: Floats) -> Floats:
    """Return tops [m], radius [m] and pixels of the rocks in maps of squares (k, 5, HEIGHT / 2, WIDTH / 2), (m, 5).

    Squares that show a rock are one rock's where they say that its top is in the same place, in any of the k maps.
    """
    odds, rows = 1 / (1 + np.exp(-rocks[:, 0].ravel())), rocks[:, 1:].transpose(0, 2, 3, 1).reshape(-1, 4)
    rows, odds = rows[odds > SHOWN], odds[odds > SHOWN]
    found: list[Any] = []
    while len(rows) and len(found) < MAX_ROCKS:
        own = np.hypot(*(rows[:, :2] - rows[odds.argmax(), :2]).T) < APART
        pixels = SQUARE**2 * odds[own].sum() / len(rocks)
        if pixels > FEWEST:
            found.append([*np.average(rows[own], axis=0, weights=odds[own]), pixels])
        rows, odds = rows[~own], odds[~own]
    return np.array(found, np.float32).reshape(-1, 5)


class Estimator:
    """Fills the state vector of one episode at a time from pictures and the robot's own sensors.

    Attributes:
        seen: What the network made of the last picture.
        belief: Logarithms of the odds of the 20 postures (20,), from the first picture: a suit that is rigid keeps its
            posture, and nothing hides it yet.
    """

    def __init__(self, network: Embedding) -> None:
        """Begin with no episode; ``network`` is used as it is."""
        self.network = network
        self.belief: Floats
        self.seen: Seen
        self._state: State | None = None
        self._inwards: Array
        self._pose: Pose

    @property
    def posture(self) -> Posture:
        """Return the posture that is most likely."""
        return kinds()[int(self.belief.argmax())]

    @th.no_grad()
    def fill(self, sight: Sight, own: Floats, start: bool) -> Floats:
        """Return the flat observation (SIZE,) for a picture.

        Args:
            sight: What the head camera sees.
            own: Flat observation (SIZE,) with what the robot's own sensors tell.
            start: Whether an episode begins with this picture.

        Raises:
            ValueError: On a picture of another shape or type.
        """
        pictures = picture_input(sight.colour[None], sight.depth[None], own[None])
        self.seen, self._state = self.network(
            pictures, th.from_numpy(own[None, OWN]), 1, None if start else self._state
        )
        geometry, rotation, centre = self._body(own, start, _points(pictures, sight))
        out = own.copy()
        out[SLICES["P_P"]] = self._fill_body(geometry, rotation, centre)
        targets = geometry.targets @ rotation.T + centre
        targets[:, 2] = np.maximum(targets[:, 2], LOWEST)
        if start:
            self._order = [0, 1] if targets[0, 1] > targets[1, 1] else [1, 0]
            self._begin(pictures, own, targets)
        ways = (geometry.way_in[:, None] * self._inwards)[self._order]
        targets = targets[self._order]
        ends = np.stack([own[SLICES[key]][15:18] for key in ("P_A", "P_B")])
        out[SLICES["P_G"]] = np.concatenate([targets, targets - ends, targets + ways - ends]).ravel()
        out[SLICES["P_E"]], out[UP.stop : SLICES["P_T"].stop] = self._rocks.ravel(), self._ground
        return out.clip(-BOUND, BOUND).astype(np.float32)

    def _body(self, own: Floats, start: bool, points: Array) -> tuple[BodyGeometry, Array, Array]:
        """Return the geometry of the likely posture, and the body's rotation and centre of gravity."""
        task, angles = TASKS[int(own[SLICES["I"]].argmax())], INITIAL + WINDOW * own[ANGLES].astype(np.float64)
        if start:
            self._recognise(task, points, angles)
            self._choose_side()
        else:
            self._follow(task, points, angles)
        return body_geometry(self.posture, self._side, task), self._pose.rotation, self._pose.centre

    def _recognise(self, task: str, points: Array, angles: Array) -> None:
        """Find the posture, and with it the pose, among the likeliest that have a task, by how well they fit."""
        odds = th.log_softmax(self.seen.posture[0], dim=0).numpy()
        fits = np.array([0.0 if task in kind.tasks else -FIT for kind in kinds()], np.float32)
        poses = {}
        for index in np.argsort(-(odds + FIT * fits))[:TRIED]:
            posture = kinds()[index]
            rough = self._rough(posture, task, True)
            seen = body_points(points, angles, rough.centre)
            poses[index], cost = refine(rough, seen, suit_surface(posture.limbs), RESTING)
            fits[index] += 1.0 - cost
        self.belief = odds + FIT * fits
        self._pose = poses[int(self.belief.argmax())]

    def _choose_side(self) -> None:
        """Note from which side the robot comes, and which way is in, as the body lies now."""
        sides, (centre, rotation) = approach_sides(self.posture), self._pose
        along = rotation[:2, 2] / np.linalg.norm(rotation[:2, 2])
        left = np.array([-along[1], along[0], 0.0])  # of a head along +x
        self._side = sides[0] if len(sides) == 1 else (1 if -centre @ left > 0 else -1)
        self._inwards = self._side * left

    def _follow(self, task: str, points: Array, angles: Array) -> None:
        """Find the pose from the one before, and from the network's where that does not go well."""
        surface = suit_surface(self.posture.limbs)
        self._pose, misfit = refine(self._pose, body_points(points, angles, self._pose.centre), surface)
        if misfit > LOST:
            rough = self._rough(self.posture, task, False)
            other = refine(rough, body_points(points, angles, rough.centre), surface)
            self._pose = min(other, (self._pose, misfit), key=lambda one: one[1])[0]

    def _rough(self, posture: Posture, task: str, start: bool) -> Pose:
        """Return the pose in which a body of this posture is nearest to the points that the network sees."""
        geometry = body_geometry(posture, approach_sides(posture)[0], task)
        points = self.seen.points[0].numpy().astype(np.float64)
        weights = np.exp(-self.seen.spread[0].numpy().astype(np.float64))
        model = np.concatenate([np.zeros((1, 3)), geometry.keypoints])
        if start:
            return Pose(*fit_resting_body(points, weights, model, posture))
        return Pose(*fit_body(points, weights, model))

    def _fill_body(self, geometry: BodyGeometry, rotation: Array, centre: Array) -> Array:
        skeleton = geometry.keypoints @ rotation.T + centre
        motion = self.seen.motion[0].numpy().ravel()
        return np.concatenate([centre, rotation[:, 0], rotation[:, 1], motion, skeleton.ravel()])

    def _begin(self, pictures: th.Tensor, own: Floats, targets: Array) -> None:
        """Note ground and rocks, for which the picture is looked at several times; they stay as they are seen first."""
        looks = th.cat([moved(pictures, *by) for by in LOOKS])
        seen, _ = self.network(looks, th.from_numpy(own[None, OWN]).expand(len(looks), -1), 1, None)
        found = read_rocks(seen.rocks.numpy())
        nearest = np.argsort(np.hypot(*(found[:, :2] - targets[:, :2].mean(axis=0)).T))
        self._rocks = np.zeros((MAX_ROCKS, 5))
        self._rocks[: len(found), :4], self._rocks[: len(found), 4] = found[nearest, :4], 1.0
        self._ground = self.seen.ground[0, : 2 * GROUND_POINTS].numpy()


def _points(pictures: th.Tensor, sight: Sight) -> Array:
    """Return where every other pixel of every other row lies in the base frame, where something is (n, 3) [m]."""
    points = pictures[0, :3, ::2, ::2].flatten(1).T.numpy().astype(np.float64) + MIDDLE
    return np.asarray(points[sight.depth[::2, ::2].ravel() > 0])


class EstimatedEnv(SeeingEnv):
    """``SeeingEnv`` whose flat observations are what the embedding estimates, so that any policy can act on them."""

    def __init__(self, network: Embedding | None = None, **arguments: Any) -> None:
        """Connect to the simulator; without a network, that of ``results/perception`` is loaded."""
        self.estimator = Estimator(network or load_embedding())
        super().__init__(**arguments)

    def _observe(self, action: Array) -> Floats:
        own = super()._observe(action)
        return self.estimator.fill(self.sight, own, self.episode.steps == 0)
