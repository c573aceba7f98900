"""What ``reproduce replay`` can write, checked before anything large is imported."""

from pathlib import Path

from reproduce.storage.errors import UserError

FORMATS = (".mp4", ".gif", ".png", ".html")
SIZE_RANGE = (128, 1920)  # px


def parse_format(out: Path) -> str:
    """Return the ending of a file's name, which says the format, in small letters."""
    kind = out.suffix.lower()
    if kind not in FORMATS:
        raise UserError(f"--out: expected a name ending in {', '.join(FORMATS)}; got {out.name!r}")
    return kind


def parse_size(text: str) -> tuple[int, int]:
    """Read width and height [px] from text such as 720x528, both multiples of 16."""
    parts, (low, high) = text.lower().split("x"), SIZE_RANGE
    if len(parts) != 2 or not all(p.isdecimal() and low <= int(p) <= high and int(p) % 16 == 0 for p in parts):
        raise UserError(f"--size: expected WIDTHxHEIGHT, multiples of 16 from {low} to {high}; got {text!r}")
    return int(parts[0]), int(parts[1])
