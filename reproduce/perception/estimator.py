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
from lunar_rescue.pictures.head import Sight
from lunar_rescue.scenes.postures import Posture, postures
from lunar_rescue.scenes.rocks import MAX_ROCKS
from lunar_rescue.scenes.scene import TASKS
from lunar_rescue.scenes.targets import approach_sides
from lunar_rescue.seeing import UP, SeeingEnv
from reproduce.perception.network import OWN, Embedding, EmbeddingSpec, Seen, State, picture_input
from reproduce.storage.paths import RESULTS
from reproduce.storage.policies import load_networks

FOLDER = RESULTS / "perception"
LEVEL = "embedding"  # name of the network in the files of weights
SURE = 0.5  # probability from which on a cell is taken to hold a rock
APART = 0.09  # m, two rocks are no nearer to each other
LOWEST = 0.03  # m, targets lie no lower


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
    """Return tops [m], radius [m] and probability of the rocks in a map of cells (5, ROWS, COLUMNS), (m, 5)."""
    rows = rocks.reshape(5, -1).T
    rows = np.column_stack([rows[:, 1:], 1 / (1 + np.exp(-rows[:, 0]))])
    found: list[Any] = []
    for row in rows[np.argsort(-rows[:, 4])]:
        if row[4] < SURE or len(found) == MAX_ROCKS:
            break
        if all(np.hypot(*(row[:2] - other[:2])) > APART for other in found):
            found.append(row)
    return np.array(found, np.float32).reshape(-1, 5)


class Estimator:
    """Fills the state vector of one episode at a time from pictures and the robot's own sensors.

    Attributes:
        seen: What the network made of the last picture.
        belief: Logarithms of the odds of the 20 postures, from all pictures of the episode (20,).
    """

    def __init__(self, network: Embedding) -> None:
        """Begin with no episode; ``network`` is used as it is."""
        self.network = network
        self.belief: Floats
        self.seen: Seen
        self._state: State | None = None
        self._inwards: Array

    @property
    def posture(self) -> Posture:
        """Return the posture that is most likely now."""
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
        odds = th.log_softmax(self.seen.posture[0], dim=0).numpy()
        self.belief = odds if start else self.belief + odds
        geometry, rotation, centre = self._body(own, start)
        out = own.copy()
        out[SLICES["P_P"]] = self._fill_body(geometry, rotation, centre)
        targets = geometry.targets @ rotation.T + centre
        targets[:, 2] = np.maximum(targets[:, 2], LOWEST)
        if start:
            self._order = [0, 1] if targets[0, 1] > targets[1, 1] else [1, 0]
            self._begin(self.seen, targets)
        ways = (geometry.way_in[:, None] * self._inwards)[self._order]
        targets = targets[self._order]
        ends = np.stack([own[SLICES[key]][15:18] for key in ("P_A", "P_B")])
        out[SLICES["P_G"]] = np.concatenate([targets, targets - ends, targets + ways - ends]).ravel()
        out[SLICES["P_E"]], out[UP.stop : SLICES["P_T"].stop] = self._rocks.ravel(), self._ground
        return out.clip(-BOUND, BOUND).astype(np.float32)

    def _body(self, own: Floats, start: bool) -> tuple[BodyGeometry, Array, Array]:
        """Return the geometry of the likely posture, and the body's rotation and centre of gravity."""
        task = TASKS[int(own[SLICES["I"]].argmax())]
        posture = next(kinds()[i] for i in np.argsort(-self.belief) if task in kinds()[i].tasks)
        sides = approach_sides(posture)
        geometry = body_geometry(posture, sides[0], task)
        points = self.seen.points[0].numpy().astype(np.float64)
        weights = np.exp(-self.seen.spread[0].numpy().astype(np.float64))
        model = np.concatenate([np.zeros((1, 3)), geometry.keypoints])
        if start:
            centre, rotation = fit_resting_body(points, weights, model, posture)
            along = rotation[:2, 2] / np.linalg.norm(rotation[:2, 2])
            left = np.array([-along[1], along[0], 0.0])  # of a head along +x
            self._side = sides[0] if len(sides) == 1 else (1 if -centre @ left > 0 else -1)
            self._inwards = self._side * left
        else:
            centre, rotation = fit_body(points, weights, model)
        return body_geometry(posture, self._side if self._side in sides else sides[0], task), rotation, centre

    def _fill_body(self, geometry: BodyGeometry, rotation: Array, centre: Array) -> Array:
        skeleton = geometry.keypoints @ rotation.T + centre
        motion = self.seen.motion[0].numpy().ravel()
        return np.concatenate([centre, rotation[:, 0], rotation[:, 1], motion, skeleton.ravel()])

    def _begin(self, seen: Seen, targets: Array) -> None:
        """Note rocks and ground, which stay as they are first seen."""
        found = read_rocks(seen.rocks[0].numpy())
        nearest = np.argsort(np.hypot(*(found[:, :2] - targets[:, :2].mean(axis=0)).T))
        self._rocks = np.zeros((MAX_ROCKS, 5))
        self._rocks[: len(found), :4], self._rocks[: len(found), 4] = found[nearest, :4], 1.0
        self._ground = seen.ground[0, : 2 * GROUND_POINTS].numpy()


class EstimatedEnv(SeeingEnv):
    """``SeeingEnv`` whose flat observations are what the embedding estimates, so that any policy can act on them."""

    def __init__(self, network: Embedding | None = None, **arguments: Any) -> None:
        """Connect to the simulator; without a network, that of ``results/perception`` is loaded."""
        self.estimator = Estimator(network or load_embedding())
        super().__init__(**arguments)

    def _observe(self, action: Array) -> Floats:
        own = super()._observe(action)
        return self.estimator.fill(self.sight, own, self.episode.steps == 0)
