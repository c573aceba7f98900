"""Labelled pictures: first ones of many scenes, and those of policies' rollouts, some on the embedding's estimates."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load_file, save_file
from scipy.spatial.distance import cdist

from lunar_rescue import sample_scene
from lunar_rescue.arrays import Floats
from lunar_rescue.observation import SLICES
from lunar_rescue.scenes.postures import postures
from lunar_rescue.scenes.rocks import MAX_ROCKS
from lunar_rescue.seeing import SeeingEnv
from reproduce.learning.policy import Policy, begin_episode
from reproduce.storage.files import write_atomically

IN_VIEW = 4  # px, a rock that shows fewer is not expected to be found
OUT_OF_VIEW = -1000.0  # px, stands for the place of such a rock
NOISE = 0.15  # standard deviation of the noise on actions in every other rollout, so that frames are of mistakes, too


@dataclass(frozen=True)
class Frames:
    """Pictures in the order of time, with what they show."""

    colour: NDArray[np.uint8]  # (n, HEIGHT, WIDTH, 3)
    depth: NDArray[np.uint16]  # (n, HEIGHT, WIDTH) [mm]
    truth: Floats  # flat observations (n, SIZE)
    spots: Floats  # where the rocks are in the picture, in the observation's order (n, MAX_ROCKS, 2) [px]
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
        rock_spots(env)[None],
        np.array([number]),
        np.array([e.steps == 0]),
    )


def rock_spots(env: SeeingEnv) -> Floats:
    """Return where rocks are seen (MAX_ROCKS, 2) [px], in the observation's order: the pixel in the middle of each."""
    e, spots = env.episode, np.full((MAX_ROCKS, 2), OUT_OF_VIEW, np.float32)
    if not e.scene.rocks:
        return spots
    rows = env.truth[SLICES["P_E"]].reshape(MAX_ROCKS, 5)[: len(e.scene.rocks), :3]
    order = cdist(rows, e.observer.to_base(e.marks[::5])).argmin(axis=1)
    for row, rock in enumerate(order):
        seen = np.argwhere(env.head.parts == 3 + rock)[:, ::-1]
        if len(seen) >= IN_VIEW:
            spots[row] = seen[np.linalg.norm(seen - seen.mean(axis=0), axis=1).argmin()] + 0.5
    return spots


def first_frames(env: SeeingEnv, seeds: Iterable[int]) -> Frames:
    """Return the first picture of each scene."""
    frames = []
    for seed in seeds:
        env.reset_flat(options={"scene": sample_scene(seed)})
        frames.append(label(env))
    return joined(frames)


def rollouts(env: SeeingEnv, policies: Sequence[Policy], seeds: Iterable[int]) -> Frames:
    """Return all pictures of a rescue in each scene, by policies in turn; every other time with noise on the actions.

    In an environment that estimates states the policies act on its estimates, else on the true ones.
    """
    frames = []
    for number, seed in enumerate(seeds):
        policy, rng = policies[number // 2 % len(policies)], np.random.default_rng([seed, 21])
        observation, done = begin_episode(env, policy, sample_scene(seed)), False
        while not done:
            frames.append(label(env))
            seen = observation if observation[SLICES["P_P"]].any() else env.truth
            action = policy.act(seen[None], np.array([env.episode.steps == 0]))[0]
            action = action + (NOISE * rng.standard_normal(action.shape) if number % 2 else 0.0)
            observation, _, terminated, truncated, _ = env.step_flat(action)
            done = terminated or truncated
    return joined(frames)
