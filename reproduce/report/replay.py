"""``reproduce replay``: one rescue as a film, a strip of pictures or a page in three dimensions (F5)."""

from pathlib import Path
from typing import Any

from lunar_rescue.pictures.camera import SIZE
from reproduce.report.film import film, write_film
from reproduce.report.viewer import record, write_replay
from reproduce.storage.errors import UserError
from reproduce.storage.files import check_writable

FORMATS = (".mp4", ".gif", ".png", ".html")
SIZE_RANGE = (128, 1920)  # px


def parse_size(text: str) -> tuple[int, int]:
    """Read width and height [px] from text such as 720x528, both multiples of 16.

    Raises:
        UserError: On anything else.
    """
    parts, (low, high) = text.lower().split("x"), SIZE_RANGE
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
    """Write one rescue to a file whose ending says the format; return how it ended.

    Arguments are those of ``film``. Raises ``UserError`` before the rescue where the file could not be written.
    """
    kind = out.suffix.lower()
    if kind not in FORMATS:
        raise UserError(f"--out: expected a name ending in {', '.join(FORMATS)}; got {out.name!r}")
    check_writable(out)
    if kind == ".html":
        recording = record(where, seed, posture, task)
        write_replay(recording, out)
        return recording.row
    frames, row = film(where, seed, posture, task, overlay=overlay, size=size)
    write_film(frames, out)
    return row
