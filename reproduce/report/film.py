"""One rescue as a film or a strip of pictures (F5)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lunar_rescue import LunarRescueEnv, Scene, sample_scene
from lunar_rescue.pictures.camera import SIZE, scene_camera
from lunar_rescue.pictures.overlay import draw_overlay
from lunar_rescue.pictures.rendering import Picture, Studio
from reproduce.experiments.evaluate import find_policy, run_episode
from reproduce.learning.policy import Actions, Observations, Policy
from reproduce.storage.errors import UserError
from reproduce.storage.files import write_atomically

FRAMES_PER_SECOND = 10  # real time: an action is held for 0.1 s
LAST_SECONDS = 1.5  # a film stays on its last picture so long
STRIP_PICTURES = 8
FORMATS = (".mp4", ".gif", ".png", ".html")
SIZE_RANGE = (128, 1920)  # px


class WatchedPolicy:
    """Acts as another policy does and calls a function after every choice, before it is acted out."""

    def __init__(self, policy: Any, see: Callable[[NDArray[Any] | None], None]) -> None:
        """Wrap a policy.

        Args:
            policy: Chooses the actions.
            see: Called with the policy's sub-goals in the base frame (2, 3) [m], or None where it has none.
        """
        self._policy, self._see = policy, see

    def prepare(self, scene: Scene) -> None:
        """Tell the other policy the scene, if it wants to know."""
        if hasattr(self._policy, "prepare"):
            self._policy.prepare(scene)

    def act(self, observations: Observations, starts: NDArray[np.bool_]) -> Actions:
        """See ``Policy.act``."""
        actions: Actions = self._policy.act(observations, starts)
        drawn = self.overlay().get("sub-goal")
        self._see(None if drawn is None else drawn[0])
        return actions

    def overlay(self) -> dict[str, NDArray[Any]]:
        """What the other policy draws."""
        drawn: dict[str, NDArray[Any]] = self._policy.overlay()
        return drawn


def load_policy_and_scene(where: str | Path, seed: int, posture: str | None, task: str | None) -> tuple[Policy, Scene]:
    """The policy and the scene of a rescue that is to be shown; see ``film``."""
    if seed < 0:
        raise UserError(f"seed: expected at least 0, got {seed}")
    _, policy = find_policy(where)
    return policy, sample_scene(seed, posture=posture, task=task)


def film(
    where: str | Path,
    seed: int,
    posture: str | None = None,
    task: str | None = None,
    *,
    overlay: bool = True,
    size: tuple[int, int] = SIZE,
) -> tuple[list[Picture], dict[str, Any]]:
    """Act one rescue out; return its pictures, one a step and one of the end, and how it ended.

    Args:
        where: Run folder, or a method that does not learn by its name.
        seed: Of the scene.
        posture: Draw the scene with this posture.
        task: Draw the scene with this task.
        overlay: Draw targets, sub-goals, mark points, distances and a caption.
        size: Width and height [px]; films want multiples of 16.
    """
    policy, scene = load_policy_and_scene(where, seed, posture, task)
    camera = scene_camera(scene, size)
    env, studio = LunarRescueEnv(), Studio()
    frames: list[Picture] = []

    def take(subgoals: NDArray[Any] | None = None, note: str = "") -> None:
        picture = studio.picture(env.episode, camera)
        frames.append(draw_overlay(picture, env.episode, camera, subgoals, note) if overlay else picture)

    try:
        row = run_episode(env, WatchedPolicy(policy, take), scene)
        take(note=ending(row))
    finally:
        env.close()
        studio.close()
    return frames, row


def ending(row: dict[str, Any]) -> str:
    """How a rescue ended, in words."""
    return "rescued" if row["is_success"] else f"failed by {str(row['failure']).replace('_', ' ')}"


def strip(frames: list[Picture], count: int = STRIP_PICTURES, columns: int = 4) -> Picture:
    """Some of the pictures, evenly spaced in time, side by side with a thin gap, read row by row."""
    chosen = [frames[i] for i in np.linspace(0, len(frames) - 1, count).round().astype(int)]
    chosen += [np.full_like(frames[0], 255)] * (-count % columns)
    framed = [np.pad(frame, ((0, 4), (0, 4), (0, 0)), constant_values=255) for frame in chosen]
    rows = [np.hstack(framed[i : i + columns]) for i in range(0, len(framed), columns)]
    return np.vstack(rows)[:-4, :-4]


def parse_size(text: str) -> tuple[int, int]:
    """Width and height [px] from text such as 720x528, both multiples of 16.

    Raises:
        UserError: On anything else.
    """
    parts = text.lower().split("x")
    low, high = SIZE_RANGE
    if len(parts) != 2 or not all(p.isdecimal() and low <= int(p) <= high and int(p) % 16 == 0 for p in parts):
        raise UserError(f"--size: expected WIDTHxHEIGHT, multiples of 16 from {low} to {high}; got {text!r}")
    return int(parts[0]), int(parts[1])


def replay(
    where: str | Path,
    seed: int,
    out: Path,
    posture: str | None = None,
    task: str | None = None,
    *,
    overlay: bool = True,
    size: tuple[int, int] = SIZE,
) -> dict[str, Any]:
    """Write one rescue to a file; its ending says the format. See ``film``."""
    if out.suffix not in FORMATS:
        raise UserError(f"--out: expected a name ending in {', '.join(FORMATS)}; got {out.name!r}")
    if out.suffix == ".html":
        from reproduce.report.viewer import record, write_replay

        recording = record(where, seed, posture, task)
        write_replay(recording, out)
        return recording.row
    frames, row = film(where, seed, posture, task, overlay=overlay, size=size)
    write_atomically(out, lambda path: _write(path, out.suffix, frames))
    return row


def _write(path: Path, kind: str, frames: list[Picture]) -> None:
    if kind == ".mp4":
        frames = frames + frames[-1:] * round(LAST_SECONDS * FRAMES_PER_SECOND)
        imageio.imwrite(path, np.stack(frames), extension=".mp4", plugin="FFMPEG", fps=FRAMES_PER_SECOND)
        return
    # One palette for all pictures and no dithering: what does not move stays the same and takes no room in a file.
    palette = _palette(strip(frames))
    if kind == ".png":
        _in(palette, strip(frames)).save(path, "PNG", optimize=True)
        return
    first, *rest = (_in(palette, frame) for frame in frames)
    each = 1000 // FRAMES_PER_SECOND
    durations = [each] * (len(frames) - 1) + [round(1000 * LAST_SECONDS)]
    first.save(path, "GIF", save_all=True, append_images=rest, duration=durations, loop=0)


def _palette(picture: Picture) -> Image.Image:
    """A palette of 256 colours in which the many greys of the ground leave room for arms, suit and overlay."""
    pixels = picture.reshape(-1, 3)
    vivid = np.ptp(pixels, axis=1) > 30
    chosen = np.concatenate([pixels[vivid], pixels[~vivid][::12]])
    return Image.fromarray(chosen[None]).quantize(256)


def _in(palette: Image.Image, picture: Picture) -> Image.Image:
    return Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE)
