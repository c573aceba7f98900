"""Sixteen environments in as many worker processes as there are cores, one message a worker a step."""

import multiprocessing
import os
from typing import Any, NoReturn

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from lunar_rescue.observation import BOUND, SIZE
from lunar_rescue.physics.robot import JOINTS
from reproduce.learning.worker_process import (
    CLOSE,
    RESET,
    STEP,
    EnvOptions,
    Floats,
    WorkerError,
    shapes,
    shared,
    work,
)
from reproduce.storage.processes import signals_held, start_fork_server

_FORK_SERVER = multiprocessing.get_context("forkserver")


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
        self._raws, arrays = zip(*[shared(shape) for shape in shapes(count)], strict=True)
        self._observations, self._actions, self._rewards, self._dones, self.terms = arrays
        self._pipes: list[Any] = []
        self._processes: list[Any] = []
        self.epoch = 0
        acts = spaces.Box(-1.0, 1.0, (JOINTS,), np.float32)
        super().__init__(count, spaces.Box(-BOUND, BOUND, (SIZE,), np.float32), acts)
        with signals_held():  # an interruption would leave workers half made
            self._start(workers, (options or EnvOptions({}), seed))
        self._receive_all()

    def _start(self, workers: int, how: tuple[EnvOptions, int]) -> None:
        start_fork_server(work.__module__)
        for part in np.array_split(np.arange(self.num_envs), workers):
            ours, theirs = _FORK_SERVER.Pipe()
            share = (list(self._raws), part.tolist(), self.num_envs, *how)
            process = _FORK_SERVER.Process(target=work, args=(theirs, *share), daemon=True)
            process.start()
            theirs.close()
            self._pipes.append(ours)
            self._processes.append(process)

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
        self._send(RESET + str(self.epoch).encode())
        self._receive_all()
        return self._observations.copy()

    def step_async(self, actions: Floats) -> None:
        """Send the environments' actions (n, 11) and return without waiting."""
        self._actions[:] = actions
        self._send(STEP)

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
                pipe.send_bytes(CLOSE)
                pipe.close()
            except OSError:
                pass  # it is gone already
        for process in self._processes:
            process.join(timeout=5)
            if process.is_alive():
                process.kill()
        self._pipes, self._processes = [], []
