"""Processes of a session, as tests that kill them want to see."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path


def alive(session: int) -> list[int]:
    """Processes of a session that still run, the oldest first."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text().rsplit(")", 1)[1].split()
            except (OSError, IndexError):
                continue
            if int(fields[3]) == session and fields[0] != "Z":
                found.append(int(entry.name))
    return sorted(found)


def wait_for(condition: Callable[[], bool], seconds: float = 60.0) -> bool:
    """Wait until something is so; return whether it came to be within that time."""
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.05)
    return condition()


def nobody_left(session: int, seconds: float = 20.0) -> bool:
    """Wait until no process of a session runs any more; return whether that came to be."""
    return wait_for(lambda: not alive(session), seconds)
