"""One rescue as a film or a strip of pictures (F5)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
from numpy.typing import NDArray

from lunar_rescue import LunarRescueEnv, sample_scene
from lunar_rescue.rendering import picture
from reproduce.errors import UserError
from reproduce.evaluation import find_policy, run_episode
from reproduce.files import write_atomically
from reproduce.policy import Actions, Observations

Picture = NDArray[np.uint8]
FRAMES_PER_SECOND = 10  # real time: an action is held for 0.1 s
STRIP_PICTURES = 8
FORMATS = (".mp4", ".gif", ".png")


class FilmingPolicy:
    """Acts as another policy does and keeps a picture before every action."""

    def __init__(self, policy: Any, take: Callable[[], Picture]) -> None:
        """Wrap a policy."""
        self._policy, self._take = policy, take
        self.frames: list[Picture] = []

    def act(self, observations: Observations, starts: NDArray[np.bool_]) -> Actions:
        """See ``Policy.act``."""
        self.frames.append(self._take())
        actions: Actions = self._policy.act(observations, starts)
        return actions

    def overlay(self) -> dict[str, NDArray[Any]]:
        """What the other policy draws."""
        drawn: dict[str, NDArray[Any]] = self._policy.overlay()
        return drawn


def film(
    where: str | Path, seed: int, posture: str | None = None, task: str | None = None
) -> tuple[list[Picture], dict[str, Any]]:
    """Act one rescue out; return its pictures and how it ended."""
    if seed < 0:
        raise UserError(f"seed: expected at least 0, got {seed}")
    _, policy = find_policy(where)
    scene = sample_scene(seed, posture=posture, task=task)
    env = LunarRescueEnv(render_mode="rgb_array")
    try:
        filming = FilmingPolicy(policy, lambda: picture(env.simulation, scene))
        row = run_episode(env, filming, scene)
        filming.frames.append(picture(env.simulation, scene))
    finally:
        env.close()
    return filming.frames, row


def strip(frames: list[Picture], count: int = STRIP_PICTURES, columns: int = 4) -> Picture:
    """Some of the pictures, evenly spaced in time, side by side."""
    chosen = [frames[i] for i in np.linspace(0, len(frames) - 1, count).round().astype(int)]
    rows = [np.hstack(chosen[i : i + columns]) for i in range(0, count, columns)]
    return np.vstack(rows)


def replay(
    where: str | Path, seed: int, out: Path, posture: str | None = None, task: str | None = None
) -> dict[str, Any]:
    """Write one rescue to a file; its ending says the format."""
    if out.suffix not in FORMATS:
        raise UserError(f"--out: expected a name ending in {', '.join(FORMATS)}; got {out.name!r}")
    frames, row = film(where, seed, posture, task)
    write_atomically(out, lambda path: _write(path, out.suffix, frames))
    return row


def _write(path: Path, kind: str, frames: list[Picture]) -> None:
    if kind == ".png":
        imageio.imwrite(path, strip(frames), extension=".png")
    elif kind == ".gif":
        imageio.imwrite(path, np.stack(frames), extension=".gif", duration=1000 // FRAMES_PER_SECOND, loop=0)
    else:
        imageio.imwrite(path, np.stack(frames), extension=".mp4", plugin="FFMPEG", fps=FRAMES_PER_SECOND)
