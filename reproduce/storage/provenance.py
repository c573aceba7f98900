"""Record where a result comes from: command, commit, versions, machine. Every file that a command writes carries it."""

import importlib.metadata
import os
import platform
import re
import shlex
import subprocess
import sys
from contextlib import suppress
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd

from lunar_rescue import ENVIRONMENT_VERSION
from reproduce.storage.files import locked, read_json, write_atomically, write_json
from reproduce.storage.paths import INSTALLED, ROOT

PACKAGES = ("pybullet", "torch", "stable-baselines3", "sb3-contrib", "gymnasium", "numpy", "lunar-rescue")
OPTIONAL = "mujoco"  # told where it is installed


def provenance() -> dict[str, Any]:
    """Return command, commit, versions, machine and time as plain data."""
    versions = {name: importlib.metadata.version(name) for name in PACKAGES}
    with suppress(importlib.metadata.PackageNotFoundError):
        versions[OPTIONAL] = importlib.metadata.version(OPTIONAL)
    return {
        "command": command_line(),
        "commit": commit(),
        "environment_version": ENVIRONMENT_VERSION,
        "packages": versions,
        "python": platform.python_version(),
        "machine": {"system": platform.system(), "processor": _processor(), "cores": len(os.sched_getaffinity(0))},
        "date": datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
    }


def record_origin(path: Path) -> None:
    """Note in ``origins.json`` beside a file which command made it, for formats that cannot carry it themselves."""
    register, origin = path.parent / "origins.json", provenance()
    with locked(path.parent, "register of origins", name=".origins.lock", wait=True):
        entries = read_json(register, "register of origins") if register.is_file() else {}
        write_json(register, {**entries, path.name: origin})


def write_table(path: Path, table: pd.DataFrame) -> Path:
    """Write a table as CSV, without its index, note its origin, and return its path."""
    write_atomically(path, partial(table.to_csv, index=False))
    record_origin(path)
    return path


def command_line() -> str:
    """Return the command as a user would type it in the checkout: no path of the machine's own."""
    name = Path(sys.argv[0]).name
    arguments = [argument.replace(f"{ROOT}{os.sep}", "") for argument in sys.argv[1:]]
    return shlex.join(["reproduce" if name in ("__main__.py", "reproduce") else name, *arguments])


def commit(root: Path = INSTALLED) -> str:
    """Return the checkout's commit.

    ``+changes`` follows where more than results and pages differ. ``unknown`` is what stands for no checkout: the
    package may be installed inside somebody else's repository, and git's variables may name another one.
    """
    if not (root / ".git").exists():
        return "unknown"
    environment = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}

    def git(*arguments: str) -> str:
        # Without the optional locks, a user's own `git add` never fails on ours.
        command = ["git", "--no-optional-locks", "-C", str(root), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True, env=environment).stdout.strip()

    try:
        edits = git("status", "--porcelain", "--untracked-files=no", "--", ":/", ":!/results", ":!/docs", ":!/*.md")
        return git("rev-parse", "HEAD") + ("+changes" if edits else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def _processor() -> str:
    path = Path("/proc/cpuinfo")
    name = re.search(r"^model name.*?:(.*)$", path.read_text(encoding="utf-8"), re.M) if path.exists() else None
    return name[1].strip() if name else platform.machine()
