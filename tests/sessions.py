"""Processes of a session, as tests that kill them want to see."""

from __future__ import annotations

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
