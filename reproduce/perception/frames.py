"""Labelled pictures: those of policies' rollouts, some on the embedding's estimates, and those of many other scenes.

Rollouts take time and show few scenes. So arms and body of many others are put where rollouts have brought theirs, and
looked at without any physics.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load_file, save_file
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from lunar_rescue import sample_scene
from lunar_rescue.arrays import Array, Floats
from lunar_rescue.observation import SLICES
from lunar_rescue.physics.astronaut import AstronautState
from lunar_rescue.pictures.stage_set import base_frame
from lunar_rescue.scenes.postures import postures
from lunar_rescue.scenes.rocks import MAX_ROCKS
from lunar_rescue.seeing import SeeingEnv
from reproduce.learning.actions import ANGLES
from reproduce.learning.policy import Policy, begin_episode
from reproduce.storage.files import write_atomically

IN_VIEW = 4  # px, a rock that shows fewer is not expected to be found
NOISE = 0.15  # standard deviation of the noise on actions in every other rollout, so that frames are of mistakes, too
#: How else than in a rollout the body lies in a picture without physics: standard deviations of its place [m] and of
#: its attitude [rad], and the share that is rolled about its length by any angle.
MOVED, TURNED, ROLLED = 0.05, np.radians(12.0), 0.3
LOWEST = 0.1  # m, its key points lie no lower
_SENSORS = np.r_[SLICES["P_A"], SLICES["P_B"], SLICES["P_W"]]
_ANGLES = np.flatnonzero(np.isin(_SENSORS, ANGLES))  # of these sensors


@dataclass(frozen=True)
class Frames:
    """Pictures in the order of time, with what they show."""

    colour: NDArray[np.uint8]  # (n, HEIGHT, WIDTH, 3)
    depth: NDArray[np.uint16]  # (n, HEIGHT, WIDTH) [mm]
    truth: Floats  # flat observations (n, SIZE)
    rocks: NDArray[np.uint8]  # which rock a pixel shows, from 1 in the observation's order, or 0 (n, HEIGHT, WIDTH)
    posture: NDArray[np.int64]  # number of the posture of the 20, -1 of any other (n,)
    start: NDArray[np.bool_]  # whether an episode begins here (n,)

    def __len__(self) -> int:
        """Return how many pictures there are."""
        return len(self.start)

    def rows(self, index: NDArray[np.int64]) -> "Frames":
        """Return the pictures of these numbers, in their order."""
        return Frames(*(getattr(self, field.name)[index] for field in fields(self)))

    def save(self, path: Path) -> None:
        """Write them to a safetensors file."""
        tensors = {field.name: np.ascontiguousarray(getattr(self, field.name)) for field in fields(self)}
        write_atomically(path, lambda temporary: save_file(tensors, temporary))

    @classmethod
    def load(cls, path: Path) -> "Frames":
        """Read the file that ``save`` wrote."""
        return cls(**load_file(path))


def joined(parts: Sequence[Frames]) -> Frames:
    """Return several lots of pictures as one."""
    return Frames(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(Frames)))


def label(env: SeeingEnv) -> Frames:
    """Return what an environment's camera sees now, with its labels, as one frame."""
    e = env.episode
    number = list(postures()).index(e.scene.posture) if e.scene.posture in postures() else -1
    return Frames(
        env.sight.colour[None],
        env.sight.depth[None],
        env.truth[None],
        rocks_shown(env)[None],
        np.array([number]),
        np.array([e.steps == 0]),
    )


def rocks_shown(env: SeeingEnv) -> NDArray[np.uint8]:
    """Return which rock each pixel shows, from 1 in the observation's order, or 0 for none (HEIGHT, WIDTH)."""
    e, parts = env.episode, env.head.parts
    if not e.scene.rocks:
        return np.zeros(parts.shape, np.uint8)
    rows = env.truth[SLICES["P_E"]].reshape(MAX_ROCKS, 5)[: len(e.scene.rocks), :3]
    order = cdist(e.observer.to_base(e.marks[::5]), rows).argmin(axis=1)
    return np.concatenate([[0, 0, 0], 1 + order]).astype(np.uint8)[parts]


def rocks_in_view(env: SeeingEnv) -> NDArray[np.bool_]:
    """Return which of the rocks (MAX_ROCKS,), in the observation's order, show enough to be found."""
    return np.bincount(rocks_shown(env).ravel(), minlength=MAX_ROCKS + 1)[1:] >= IN_VIEW


def rotation_of(observations: Floats) -> Array:
    """Return the body's axes front, left and head in columns (..., 3, 3), of flat observations (..., SIZE)."""
    bodies = observations[..., SLICES["P_P"]].astype(np.float64)
    front, left = bodies[..., 3:6], bodies[..., 6:9]
    return np.stack([front, left, np.cross(front, left)], axis=-1)


@dataclass(frozen=True)
class Moves:
    """What rollouts did: the robot's sensors, and how the body lay beside how it lay at first, in the base frame."""

    sensors: Floats  # P_A, P_B and P_W of flat observations (n, 45)
    turns: Array  # from the attitude at first (n, 3, 3)
    shifts: Array  # of the centre of gravity from where it was at first (n, 3) [m]

    @classmethod
    def of(cls, rescues: Frames) -> "Moves":
        """Take them from pictures of rollouts."""
        centres, attitudes = rescues.truth[:, SLICES["P_P"]][:, :3].astype(np.float64), rotation_of(rescues.truth)
        first = np.maximum.accumulate(np.where(rescues.start, np.arange(len(rescues)), 0))
        turns = attitudes @ attitudes[first].transpose(0, 2, 1)
        return cls(rescues.truth[:, _SENSORS], turns, centres - centres[first])


def scattered(env: SeeingEnv, seeds: Iterable[int], moves: Moves | None = None, later: int = 0) -> Frames:
    """Return the first picture of each scene and then ``later`` ones after moves that are drawn by the scene's seed."""
    frames = []
    for seed in seeds:
        env.reset_flat(options={"scene": sample_scene(seed)})
        frames.append(label(env))
        if moves is not None:
            start, rng = env.episode.body, np.random.default_rng([seed, 22])
            frames += [_moved(env, start, moves, rng) for _ in range(later)]
    return joined(frames)


def _moved(env: SeeingEnv, start: AstronautState, moves: Moves, rng: np.random.Generator) -> Frames:
    """Put arms and body where a rollout had them, the body a little elsewhere, and return the picture of it."""
    e, index = env.episode, rng.integers(len(moves.sensors))
    (_, axes), sensors = base_frame(e), moves.sensors[index]
    turn = Rotation.from_rotvec(rng.normal(0.0, TURNED, 3)) * Rotation.from_matrix(moves.turns[index])
    if rng.random() < ROLLED:
        turn = turn * Rotation.from_rotvec(rng.uniform(-np.pi, np.pi) * (start.rotation[:, 2] @ axes))
    rotation = axes @ turn.as_matrix() @ axes.T @ start.rotation
    centre = start.centre + axes @ (moves.shifts[index] + rng.normal(0.0, MOVED, 3))
    body = replace(start, centre=centre, rotation=rotation)
    centre[2] += max(0.0, LOWEST - e.astronaut.keypoints(body)[:, 2].min())
    angles = env.robot.initial + env.robot.window * sensors[_ANGLES]
    e.body, e.robot, e.steps = body, replace(e.robot, angles=angles), e.steps + 1
    env.look()
    env.truth[_SENSORS] = sensors
    return label(env)


def rollouts(env: SeeingEnv, policies: Sequence[Policy], seeds: Iterable[int]) -> Frames:
    """Return all pictures of a rescue in each scene, by policies in turn; every other time with noise on the actions.

    Whose turn it is follows from the scene's seed. In an environment that estimates states the policies act on its
    estimates, else on the true ones.
    """
    frames = []
    for seed in seeds:
        policy, rng = policies[seed // 2 % len(policies)], np.random.default_rng([seed, 21])
        observation, done = begin_episode(env, policy, sample_scene(seed)), False
        while not done:
            frames.append(label(env))
            seen = observation if observation[SLICES["P_P"]].any() else env.truth
            action = policy.act(seen[None], np.array([env.episode.steps == 0]))[0]
            action = action + (NOISE * rng.standard_normal(action.shape) if seed % 2 else 0.0)
            observation, _, terminated, truncated, _ = env.step_flat(action)
            done = terminated or truncated
    return joined(frames)
