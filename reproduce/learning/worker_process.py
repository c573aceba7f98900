"""A worker process with its share of the environments; it needs neither PyTorch nor Stable-Baselines3.

Observations, rewards and reward terms travel through shared memory; only what happens at the end of an episode is sent
as a message. A scene's seed depends on the run's seed, the environment's index and the number of the episode alone.
"""

import traceback
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.sharedctypes import RawArray
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lunar_rescue import rewards
from lunar_rescue.disturbances import randomised
from lunar_rescue.disturbed import DisturbedEnv
from lunar_rescue.env import OUTCOME, LunarRescueEnv
from lunar_rescue.observation import SIZE
from lunar_rescue.physics.robot import JOINTS
from lunar_rescue.scenes.sampling import easy_scene
from lunar_rescue.scenes.splits import TRAIN
from reproduce.storage.processes import die_with_parent

#: Names of the reward's terms in the order of the shared array.
TERMS = tuple(term.name for term in rewards.TERMS)
#: Return of an ended episode by the environment's own reward, AAPF included, whichever obstacle reward is trained with.
RETURN = "own_return"
Floats = NDArray[np.float32]
STEP, RESET, CLOSE = b"s", b"r", b"c"


class WorkerError(RuntimeError):
    """A worker process stopped or raised; the message says which and why."""


@dataclass(frozen=True)
class EnvOptions:
    """How the environments of all workers are made and which scenes they show."""

    arguments: dict[str, Any]  # keyword arguments of ``LunarRescueEnv``
    postures: tuple[str, ...] = ()  # to draw from; empty means all
    easy: bool = False  # whether every scene is one of ``easy_scene``
    randomise: bool = False  # whether each episode's physics are drawn anew, see ``disturbances.randomised``

    def make(self) -> LunarRescueEnv:
        """Make one environment."""
        return DisturbedEnv(randomised, **self.arguments) if self.randomise else LunarRescueEnv(**self.arguments)


def shared(shape: tuple[int, ...], raw: Any = None) -> tuple[Any, Floats]:
    """Return shared memory, new unless there is some already, and an array of this shape on it."""
    raw = RawArray("f", int(np.prod(shape))) if raw is None else raw
    return raw, np.frombuffer(raw, dtype=np.float32).reshape(shape)


class Worker:
    """One worker's share of the environments, on arrays that it shares with the others and the parent."""

    def __init__(self, raws: list[Any], indices: list[int], count: int, options: EnvOptions, seed: int) -> None:
        arrays = [shared(shape, raw)[1] for shape, raw in zip(shapes(count), raws, strict=True)]
        self._observations, self._actions, self._rewards, self._dones, self._terms = arrays
        self._envs = {index: options.make() for index in indices}
        self._options, self._seed = options, seed

    def serve(self, pipe: Connection) -> None:
        """Say that the environments are made, then answer commands until told to close."""
        pipe.send(None)
        while (command := pipe.recv_bytes()) != CLOSE:
            if command == STEP:
                # Index and final info of those whose episode ended.
                pipe.send([(index, final) for index in self._envs if (final := self._step(index))])
            else:
                self.reset(int(command[1:]))
                pipe.send(None)

    def reset(self, epoch: int) -> None:
        """Begin the first episodes of an epoch."""
        self._epoch, self._episodes, self._returns = epoch, dict.fromkeys(self._envs, 0), dict.fromkeys(self._envs, 0.0)
        for index in self._envs:
            self._begin(index)

    def _step(self, index: int) -> dict[str, Any] | None:
        vector, reward, terminated, truncated, info = self._envs[index].step_flat(self._actions[index])
        terms = info["reward_terms"]
        self._rewards[index], self._terms[index] = reward, [terms[name] for name in TERMS]
        self._returns[index] += reward - terms["obstacle_avoidance"] + info["aapf"]
        self._dones[index] = float(terminated or truncated)
        if not (terminated or truncated):
            self._observations[index] = vector
            return None
        outcome = {name: info[name] for name in OUTCOME} | {RETURN: self._returns[index]}
        self._begin(index)
        return {**outcome, "terminal_observation": vector, "TimeLimit.truncated": truncated and not terminated}

    def _begin(self, index: int) -> None:
        draw = train_seed(self._seed, index, self._epoch, self._episodes[index])
        self._observations[index], _ = self._envs[index].reset_flat(draw, scene_options(draw, self._options))
        self._episodes[index] += 1
        self._returns[index] = 0.0


def work(pipe: Connection, *share: Any) -> None:
    """Serve a ``Worker`` until told to close or until the parent is gone."""
    die_with_parent()
    try:
        Worker(*share).serve(pipe)
    except (EOFError, BrokenPipeError, ConnectionResetError, KeyboardInterrupt):
        pass  # the parent is gone
    except Exception:  # sent to the parent, which raises it by name
        pipe.send(WorkerError(traceback.format_exc()))


def train_seed(run_seed: int, env: int, epoch: int, episode: int) -> int:
    """Draw a scene seed of the ``train`` split from the run's seed, the environment, the restart and the episode."""
    return int(np.random.default_rng([run_seed, env, epoch, episode]).integers(TRAIN.start, TRAIN.stop))


def scene_options(seed: int, options: EnvOptions) -> dict[str, Any]:
    """Return what ``reset`` is told of the scene with this seed: an easy one, a posture of the list, or nothing."""
    if options.easy:
        return {"scene": easy_scene(seed)}
    return {"posture": options.postures[seed % len(options.postures)]} if options.postures else {}


def shapes(count: int) -> list[tuple[int, ...]]:
    """Return the shapes of shared observations, actions, rewards, ends of episodes and reward terms."""
    return [(count, SIZE), (count, JOINTS), (count,), (count,), (count, len(TERMS))]
