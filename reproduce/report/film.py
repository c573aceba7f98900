"""``reproduce replay``: one rescue as a film, a strip of pictures or a page in three dimensions (F5)."""

from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lunar_rescue.physics.engines import DEFAULT
from lunar_rescue.pictures.camera import SIZE, scene_camera
from lunar_rescue.pictures.overlay import draw_overlay
from lunar_rescue.pictures.rendering import Picture, Studio
from reproduce.experiments.evaluate import put_into
from reproduce.report.acting import FRAMES_PER_SECOND, LAST_SECONDS, act_out, load_policy_and_scene
from reproduce.report.formats import parse_format
from reproduce.report.viewer import record, write_replay
from reproduce.storage.files import check_writable, write_atomically

STRIP_PICTURES = 8


def replay(
    where: str | Path,
    seed: int,
    out: Path,
    posture: str | None = None,
    task: str | None = None,
    *,
    overlay: bool = True,
    size: tuple[int, int] = SIZE,
    simulator: str = DEFAULT,
) -> dict[str, Any]:
    """Write one rescue to a file whose ending says the format; return how it ended.

    Arguments are those of ``film``. Raises ``UserError`` before the rescue where the file could not be written.
    """
    kind = parse_format(out)
    check_writable(out)
    if kind == ".html":
        recording = record(where, seed, posture, task, simulator)
        write_replay(recording, out)
        return recording.row
    frames, row = film(where, seed, posture, task, overlay=overlay, size=size, simulator=simulator)
    write_atomically(out, partial(_write, kind=kind, frames=frames))
    return row


def film(
    where: str | Path,
    seed: int,
    posture: str | None = None,
    task: str | None = None,
    *,
    overlay: bool = True,
    size: tuple[int, int] = SIZE,
    simulator: str = DEFAULT,
) -> tuple[list[Picture], dict[str, Any]]:
    """Act one rescue out; return its pictures, one a step and one of the end, and how it ended.

    The first four arguments are those of ``acting.load_policy_and_scene``; ``overlay`` draws targets, sub-goals, mark
    points, distances and a caption; ``size`` is width and height [px], for films multiples of 16; ``simulator`` is
    where it happens, pictures are PyBullet's.
    """
    policy, scene = load_policy_and_scene(where, seed, posture, task)
    camera = scene_camera(scene, size)
    frames: list[Picture] = []
    with closing(put_into(simulator, policy)) as env, closing(Studio()) as studio:

        def take(subgoals: NDArray[Any] | None, note: str) -> None:
            picture = studio.picture(env.episode, camera)
            frames.append(draw_overlay(picture, env.episode, camera, subgoals, note) if overlay else picture)

        return frames, act_out(env, policy, scene, take)


def strip(frames: list[Picture], count: int = STRIP_PICTURES, columns: int = 4) -> Picture:
    """Some of the pictures, evenly spaced in time, side by side with a thin gap, read row by row."""
    moments = [frames[i] for i in np.linspace(0, len(frames) - 1, count).round().astype(int)]
    moments += [np.full_like(frames[0], 255)] * (-count % columns)
    tiles = [np.pad(frame, ((0, 4), (0, 4), (0, 0)), constant_values=255) for frame in moments]
    rows = [np.hstack(tiles[i : i + columns]) for i in range(0, len(tiles), columns)]
    return np.vstack(rows)[:-4, :-4]


def _write(path: Path, kind: str, frames: list[Picture]) -> None:
    """Write pictures as a film (.mp4, .gif) or as a strip (.png)."""
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
    durations = [1000 // FRAMES_PER_SECOND] * len(rest) + [round(1000 * LAST_SECONDS)]
    first.save(path, "GIF", save_all=True, append_images=rest, duration=durations, loop=0)


def _palette(picture: Picture) -> Image.Image:
    """A palette of 256 colours in which the many greys of the ground leave room for arms, suit and overlay."""
    pixels = picture.reshape(-1, 3)
    vivid = np.ptp(pixels, axis=1) > 30
    sample = np.concatenate([pixels[vivid], pixels[~vivid][::12]])
    return Image.fromarray(sample[None]).quantize(256)


def _in(palette: Image.Image, picture: Picture) -> Image.Image:
    return Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE)
