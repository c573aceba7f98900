"""Where a result comes from: command, commit, versions, machine. Every file that a command writes carries it."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import shlex
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from lunar_rescue import ENVIRONMENT_VERSION
from reproduce.storage.files import read_json, write_json

PACKAGES = ("pybullet", "torch", "stable-baselines3", "sb3-contrib", "gymnasium", "numpy", "lunar-rescue")


def provenance() -> dict[str, Any]:
    """Command, commit, versions, machine and time, as plain data."""
    return {
        "command": command_line(),
        "commit": commit(),
        "environment_version": ENVIRONMENT_VERSION,
        "packages": {name: importlib.metadata.version(name) for name in PACKAGES},
        "python": platform.python_version(),
        "machine": {
            "system": platform.system(),
            "processor": _processor(),
            "cores": len(os.sched_getaffinity(0)),
        },
        "date": datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
    }


def record_origin(path: Path) -> None:
    """Note in ``origins.json`` beside a file which command made it, for formats that cannot carry it themselves."""
    register = path.parent / "origins.json"
    known = read_json(register, "register of origins") if register.is_file() else {}
    write_json(register, {**known, path.name: provenance()})


def command_line() -> str:
    """The command as a user would type it in the checkout: no path of the machine's own."""
    name = Path(sys.argv[0]).name
    root = f"{Path(__file__).resolve().parents[2]}{os.sep}"
    arguments = [argument.replace(root, "") for argument in sys.argv[1:]]
    return shlex.join(["reproduce" if name in ("__main__.py", "reproduce") else name, *arguments])


def commit() -> str:
    """Commit of the checkout; ``+changes`` where more than results and pages differ, ``unknown`` outside one."""
    root = Path(__file__).resolve().parents[2]

    def git(*arguments: str) -> str:
        done = subprocess.run(["git", "-C", str(root), *arguments], capture_output=True, text=True, check=True)
        return done.stdout.strip()

    try:
        changed = git("status", "--porcelain", "--untracked-files=no", "--", ":/", ":!/results", ":!/docs", ":!/*.md")
        return git("rev-parse", "HEAD") + ("+changes" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.machine()
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()
