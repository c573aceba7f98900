"""Sixteen environments in as many worker processes as there are cores, one message a worker a step.

Observations, rewards and reward terms travel through shared memory; only what happens at the end of an episode is sent
as a message. A scene's seed depends on the run's seed, the environment's index and the number of the episode alone.
"""

import multiprocessing
import os
import traceback
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.sharedctypes import RawArray
from typing import Any, NoReturn

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from lunar_rescue import rewards
from lunar_rescue.disturbances import randomised
from lunar_rescue.disturbed import DisturbedEnv
from lunar_rescue.env import OUTCOME, LunarRescueEnv
from lunar_rescue.observation import BOUND, SIZE
from lunar_rescue.physics.robot import JOINTS
from lunar_rescue.scenes.sampling import easy_scene
from lunar_rescue.scenes.splits import TRAIN
from reproduce.storage.processes import die_with_parent, start_fork_server

#: Names of the reward's terms in the order of the shared array.
TERMS = tuple(term.name for term in rewards.TERMS)
#: Return of an ended episode by the environment's own reward, AAPF included, whichever obstacle reward is trained with.
RETURN = "own_return"
Floats = NDArray[np.float32]
_STEP, _RESET, _CLOSE = b"s", b"r", b"c"
_SPAWN = multiprocessing.get_context("forkserver")


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


def _shared(shape: tuple[int, ...], raw: Any = None) -> tuple[Any, Floats]:
    raw = RawArray("f", int(np.prod(shape))) if raw is None else raw
    return raw, np.frombuffer(raw, dtype=np.float32).reshape(shape)


class _Worker:
    """One worker's share of the environments, on arrays that it shares with the others and the parent."""

    def __init__(self, raws: list[Any], indices: list[int], count: int, options: EnvOptions, seed: int) -> None:
        arrays = [_shared(shape, raw)[1] for shape, raw in zip(_shapes(count), raws, strict=True)]
        self._observations, self._actions, self._rewards, self._dones, self._terms = arrays
        self._envs = {index: options.make() for index in indices}
        self._options, self._seed = options, seed

    def serve(self, pipe: Connection) -> None:
        """Say that the environments are made, then answer commands until told to close."""
        pipe.send(None)
        while (command := pipe.recv_bytes()) != _CLOSE:
            if command == _STEP:
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
        self._observations[index], _ = self._envs[index].reset_flat(draw, _options(draw, self._options))
        self._episodes[index] += 1
        self._returns[index] = 0.0


def _work(pipe: Connection, *share: Any) -> None:
    """Serve a ``_Worker`` until told to close or until the parent is gone."""
    die_with_parent()
    try:
        _Worker(*share).serve(pipe)
    except (EOFError, BrokenPipeError, ConnectionResetError, KeyboardInterrupt):
        pass  # the parent is gone
    except Exception:  # sent to the parent, which raises it by name
        pipe.send(WorkerError(traceback.format_exc()))


def train_seed(run_seed: int, env: int, epoch: int, episode: int) -> int:
    """Draw a scene seed of the ``train`` split from the run's seed, the environment, the restart and the episode."""
    return int(np.random.default_rng([run_seed, env, epoch, episode]).integers(TRAIN.start, TRAIN.stop))


def _options(seed: int, options: EnvOptions) -> dict[str, Any]:
    if options.easy:
        return {"scene": easy_scene(seed)}
    return {"posture": options.postures[seed % len(options.postures)]} if options.postures else {}


def _shapes(count: int) -> list[tuple[int, ...]]:
    return [(count, SIZE), (count, JOINTS), (count,), (count,), (count, len(TERMS))]


class ClosedVecEnv(VecEnv):
    """A vectorised environment without access to single environments, which live elsewhere or do not exist."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return ``render_mode``, which SB3 asks for; no other attribute can be read."""
        return [None] * self.num_envs if attr_name == "render_mode" else self.refuse(attr_name)

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        """Say of each environment that it is not wrapped."""
        return [False] * self.num_envs

    def refuse(self, name: str, *args: Any, **kwargs: Any) -> NoReturn:
        """Refuse to set an attribute or to call a method of single environments."""
        raise AttributeError(f"{type(self).__name__}: single environments are out of reach; {name!r} is not available")

    set_attr: Any = refuse
    env_method: Any = refuse


class WorkerVecEnv(ClosedVecEnv):
    """SB3's vectorised environment over flat observations of ``LunarRescue-v0``.

    ``terms`` holds the reward terms of the last step, (n, len(TERMS)). ``epoch`` counts the times that a training began
    its episodes anew; set it before ``reset``.
    """

    def __init__(self, count: int, seed: int, options: EnvOptions | None = None, workers: int | None = None) -> None:
        """Start worker processes, one a core unless ``workers`` says how many, and wait until environments are made.

        All scenes follow from the run's ``seed``. Raises a ``WorkerError`` when a worker cannot make its environments.
        """
        if count < 1:
            raise ValueError(f"count: expected at least 1 environment, got {count!r}")
        workers = min(count, workers or len(os.sched_getaffinity(0)))
        self._raws, arrays = zip(*[_shared(shape) for shape in _shapes(count)], strict=True)
        self._observations, self._actions, self._rewards, self._dones, self.terms = arrays
        self._pipes: list[Any] = []
        self._processes: list[Any] = []
        self.epoch = 0
        acts = spaces.Box(-1.0, 1.0, (JOINTS,), np.float32)
        super().__init__(count, spaces.Box(-BOUND, BOUND, (SIZE,), np.float32), acts)
        start_fork_server()
        for part in np.array_split(np.arange(count), workers):
            ours, theirs = _SPAWN.Pipe()
            share = (list(self._raws), part.tolist(), count, options or EnvOptions({}), seed)
            process = _SPAWN.Process(target=_work, args=(theirs, *share), daemon=True)
            process.start()
            theirs.close()
            self._pipes.append(ours)
            self._processes.append(process)
        self._receive_all()

    def _receive_all(self) -> list[Any]:
        answers = []
        for index, pipe in enumerate(self._pipes):
            try:
                answers.append(pipe.recv())
            except (EOFError, ConnectionResetError):
                raise self._death(index) from None
            if isinstance(answers[-1], WorkerError):
                raise WorkerError(f"worker {index} of {len(self._pipes)} raised:\n{answers[-1]}")
        return answers

    def _send(self, message: bytes) -> None:
        for index, pipe in enumerate(self._pipes):
            try:
                pipe.send_bytes(message)
            except OSError:
                raise self._death(index) from None

    def _death(self, index: int) -> WorkerError:
        code = self._processes[index].exitcode
        return WorkerError(f"worker {index} of {len(self._pipes)} died (exit code {code})")

    def reset(self) -> Floats:
        """Begin new episodes everywhere; scenes follow from the run's seed and ``epoch``."""
        self._send(_RESET + str(self.epoch).encode())
        self._receive_all()
        return self._observations.copy()

    def step_async(self, actions: Floats) -> None:
        """Send the environments' actions (n, 11) and return without waiting."""
        self._actions[:] = actions
        self._send(_STEP)

    def step_wait(self) -> tuple[Floats, Floats, NDArray[np.bool_], list[dict[str, Any]]]:
        """Wait for all workers; an ended episode's last observation is in its info."""
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for ended in self._receive_all():
            for env, info in ended:
                infos[env] = info
        return self._observations.copy(), self._rewards.copy(), self._dones.astype(bool), infos

    def close(self) -> None:
        """Stop the workers; a second call does nothing."""
        for pipe in self._pipes:
            try:
                pipe.send_bytes(_CLOSE)
                pipe.close()
            except OSError:
                pass  # it is gone already
        for process in self._processes:
            process.join(timeout=5)
            if process.is_alive():
                process.kill()
        self._pipes, self._processes = [], []
