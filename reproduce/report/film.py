"""One rescue as a film or a strip of pictures (F5)."""

from contextlib import closing
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lunar_rescue import LunarRescueEnv
from lunar_rescue.pictures.camera import SIZE, scene_camera
from lunar_rescue.pictures.overlay import draw_overlay
from lunar_rescue.pictures.rendering import Picture, Studio
from reproduce.report.acting import FRAMES_PER_SECOND, LAST_SECONDS, act_out, load_policy_and_scene
from reproduce.storage.files import write_atomically

STRIP_PICTURES = 8


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

    The first four arguments are those of ``acting.load_policy_and_scene``; ``overlay`` draws targets, sub-goals, mark
    points, distances and a caption; ``size`` is width and height [px], for films multiples of 16.
    """
    policy, scene = load_policy_and_scene(where, seed, posture, task)
    camera = scene_camera(scene, size)
    env, studio = LunarRescueEnv(), Studio()
    frames: list[Picture] = []

    def take(subgoals: NDArray[Any] | None, note: str) -> None:
        picture = studio.picture(env.episode, camera)
        frames.append(draw_overlay(picture, env.episode, camera, subgoals, note) if overlay else picture)

    with closing(env), closing(studio):
        row = act_out(env, policy, scene, take)
    return frames, row


def strip(frames: list[Picture], count: int = STRIP_PICTURES, columns: int = 4) -> Picture:
    """Some of the pictures, evenly spaced in time, side by side with a thin gap, read row by row."""
    chosen = [frames[i] for i in np.linspace(0, len(frames) - 1, count).round().astype(int)]
    chosen += [np.full_like(frames[0], 255)] * (-count % columns)
    framed = [np.pad(frame, ((0, 4), (0, 4), (0, 0)), constant_values=255) for frame in chosen]
    rows = [np.hstack(framed[i : i + columns]) for i in range(0, len(framed), columns)]
    return np.vstack(rows)[:-4, :-4]


def write_film(frames: list[Picture], out: Path) -> None:
    """Write pictures as a film (.mp4, .gif) or as a strip (.png), as the file's ending says."""
    write_atomically(out, lambda path: _write(path, out.suffix.lower(), frames))


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
