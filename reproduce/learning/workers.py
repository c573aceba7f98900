"""Sixteen environments in as many worker processes as there are cores, one message a worker a step.

Observations, rewards and reward terms travel through shared memory; only what happens at the end of an episode is sent
as a message. A scene's seed depends on the run's seed, the environment's index and the number of the episode alone.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import traceback
from collections.abc import Sequence
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from multiprocessing.sharedctypes import RawArray
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from lunar_rescue import Scene, rewards, sample_scene
from lunar_rescue.env import OUTCOME, LunarRescueEnv
from lunar_rescue.observation import BOUND, SIZE
from lunar_rescue.physics.robot import JOINTS
from lunar_rescue.scenes.scene import MASS_RANGE
from reproduce.learning.splits import train_seed

#: Names of the reward's terms in the order of the shared array.
TERMS = tuple(term.name for term in rewards.TERMS)
#: Return of an ended episode by the environment's own reward, AAPF included, whichever obstacle reward is trained with.
RETURN = "own_return"
EASY_POSTURE = "left_side_stride"
_STEP, _RESET, _CLOSE = b"s", b"r", b"c"
_SPAWN = multiprocessing.get_context("forkserver")


class WorkerError(RuntimeError):
    """A worker process stopped or raised; the message says which and why."""


@dataclass(frozen=True)
class EnvOptions:
    """How each environment is made.

    Attributes:
        arguments: Keyword arguments of ``LunarRescueEnv``.
        postures: Postures to draw from; empty means all.
        easy: Whether all scenes are those of ``easy_scene``.
    """

    arguments: dict[str, Any]
    postures: tuple[str, ...] = ()
    easy: bool = False


def _shared(shape: tuple[int, ...], raw: Any = None) -> tuple[Any, NDArray[np.float32]]:
    raw = RawArray("f", int(np.prod(shape))) if raw is None else raw
    return raw, np.frombuffer(raw, dtype=np.float32).reshape(shape)


def _work(
    pipe: Connection, raws: list[Any], count: int, first: int, indices: range, options: EnvOptions, seed: int
) -> None:
    """Step this worker's share of the environments until told to close."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's business; it closes the pipe
    try:
        observations, actions, summed, dones, terms = (
            _shared(shape, raw)[1] for shape, raw in zip(_shapes(count), raws, strict=True)
        )
        envs = [LunarRescueEnv(**options.arguments) for _ in indices]
        episodes = [0] * len(envs)
        totals = [0.0] * len(envs)
        epoch = 0

        def begin(slot: int) -> None:
            draw = train_seed(seed, first + slot, epoch, episodes[slot])
            chosen = _options(draw, options)
            observations[indices[slot]], _ = envs[slot].reset_flat(draw, chosen)
            episodes[slot] += 1
            totals[slot] = 0.0

        pipe.send(None)
        while True:
            command = pipe.recv_bytes()
            if command == _STEP:
                ended: list[tuple[int, dict[str, Any]]] = []
                for slot, index in enumerate(indices):
                    vector, reward, terminated, truncated, info = envs[slot].step_flat(actions[index])
                    summed[index] = reward
                    terms[index] = [info["reward_terms"][name] for name in TERMS]
                    totals[slot] += reward - info["reward_terms"]["obstacle_avoidance"] + info["aapf"]
                    dones[index] = float(terminated or truncated)
                    if terminated or truncated:
                        final = _final_info(info, vector, truncated and not terminated)
                        ended.append((index, {**final, RETURN: totals[slot]}))
                        begin(slot)
                    else:
                        observations[index] = vector
                pipe.send(ended)
            elif command[:1] == _RESET:
                epoch = int(command[1:])
                for slot in range(len(envs)):
                    episodes[slot] = 0
                    begin(slot)
                pipe.send(None)
            else:
                break
    except (EOFError, BrokenPipeError, ConnectionResetError, KeyboardInterrupt):
        pass  # the parent is gone
    except Exception:  # sent to the parent, which raises it by name
        pipe.send(WorkerError(traceback.format_exc()))


def easy_scene(seed: int) -> Scene:
    """One posture, no rocks, the lightest astronaut: where a method must learn that learns at all."""
    return replace(sample_scene(seed, posture=EASY_POSTURE), rocks=(), mass=MASS_RANGE[0])


def _options(seed: int, options: EnvOptions) -> dict[str, Any]:
    if options.easy:
        return {"scene": easy_scene(seed)}
    return {"posture": options.postures[seed % len(options.postures)]} if options.postures else {}


def _final_info(info: dict[str, Any], vector: NDArray[np.float32], truncated: bool) -> dict[str, Any]:
    return {**{k: info[k] for k in OUTCOME}, "terminal_observation": vector, "TimeLimit.truncated": truncated}


def _shapes(count: int) -> list[tuple[int, ...]]:
    return [(count, SIZE), (count, JOINTS), (count,), (count,), (count, len(TERMS))]


class WorkerVecEnv(VecEnv):
    """SB3's vectorised environment over flat observations of ``LunarRescue-v0``.

    Attributes:
        terms: Reward terms of the last step, (n, len(TERMS)).
        epoch: Counts the times that a training began its episodes anew; set it before ``reset``.
    """

    def __init__(self, count: int, seed: int, options: EnvOptions | None = None, workers: int | None = None) -> None:
        """Start the workers.

        Args:
            count: Number of environments.
            seed: Of the run; scenes follow from it.
            options: How environments are made.
            workers: Worker processes; None is one a core.
        """
        if count < 1:
            raise ValueError(f"count: expected at least 1 environment, got {count!r}")
        workers = min(count, workers or len(os.sched_getaffinity(0)))
        self._raws, arrays = zip(*[_shared(shape) for shape in _shapes(count)], strict=True)
        self._observations, self._actions, self._rewards, self._dones, self.terms = arrays
        self._pipes: list[Any] = []
        self._processes: list[Any] = []
        self.render_mode = None
        self.epoch = 0
        super().__init__(
            count,
            spaces.Box(-BOUND, BOUND, (SIZE,), np.float32),
            spaces.Box(-1.0, 1.0, (JOINTS,), np.float32),
        )
        for part in np.array_split(np.arange(count), workers):
            self._start(range(int(part[0]), int(part[-1]) + 1), count, options or EnvOptions({}), seed)
        for index in range(len(self._pipes)):
            self._receive(index)

    def _start(self, indices: range, count: int, options: EnvOptions, seed: int) -> None:
        ours, theirs = _SPAWN.Pipe()
        arguments = (theirs, list(self._raws), count, indices[0], indices, options, seed)
        process = _SPAWN.Process(target=_work, args=arguments, daemon=True)
        process.start()
        theirs.close()
        self._pipes.append(ours)
        self._processes.append(process)

    def _receive(self, index: int) -> Any:
        try:
            answer = self._pipes[index].recv()
        except (EOFError, ConnectionResetError):
            code = self._processes[index].exitcode
            raise WorkerError(f"worker {index} of {len(self._pipes)} died (exit code {code})") from None
        if isinstance(answer, WorkerError):
            raise WorkerError(f"worker {index} of {len(self._pipes)} raised:\n{answer}")
        return answer

    def _send(self, message: bytes) -> None:
        for index, pipe in enumerate(self._pipes):
            try:
                pipe.send_bytes(message)
            except (BrokenPipeError, OSError):
                code = self._processes[index].exitcode
                raise WorkerError(f"worker {index} of {len(self._pipes)} died (exit code {code})") from None

    def reset(self) -> NDArray[np.float32]:
        """Begin new episodes everywhere; scenes follow from the run's seed and ``epoch``."""
        self._send(_RESET + str(self.epoch).encode())
        for index in range(len(self._pipes)):
            self._receive(index)
        return self._observations.copy()

    def step_async(self, actions: NDArray[np.float32]) -> None:
        """Send actions (n, 11)."""
        self._actions[:] = actions
        self._send(_STEP)

    def step_wait(
        self,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Wait for all workers; an ended episode's last observation is in its info."""
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for index in range(len(self._pipes)):
            for env, info in self._receive(index):
                infos[env] = info
        return self._observations.copy(), self._rewards.copy(), self._dones.astype(bool), infos

    def close(self) -> None:
        """Stop the workers; a second call does nothing."""
        for pipe in self._pipes:
            try:
                pipe.send_bytes(_CLOSE)
                pipe.close()
            except (BrokenPipeError, OSError):
                pass
        for process in self._processes:
            process.join(timeout=5)
            if process.is_alive():
                process.terminate()
        self._pipes, self._processes = [], []

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Only ``render_mode``, which SB3 asks for."""
        if attr_name == "render_mode":
            return [None] * self.num_envs
        raise AttributeError(f"WorkerVecEnv: environments live in workers; {attr_name!r} is not available")

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Not available: environments live in workers."""
        raise AttributeError(f"WorkerVecEnv: environments live in workers; {attr_name!r} cannot be set")

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Not available: environments live in workers."""
        raise AttributeError(f"WorkerVecEnv: environments live in workers; {method_name!r} cannot be called")

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        """No environment is wrapped."""
        return [False] * self.num_envs

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seeds are fixed when the workers start; SB3 calls this and expects a list."""
        return [None] * self.num_envs
