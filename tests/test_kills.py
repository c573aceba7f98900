"""A training that is killed at any moment, and gone on with, ends in the weights of one that was not."""

from __future__ import annotations

import hashlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from sessions import alive  # type: ignore[import-not-found]  # pytest puts this folder on the path

from reproduce.storage.checkpoint import NAME

SCRIPT = Path(__file__).parent / "small_training.py"
KILLS = 20


def _start(folder: Path) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, str(SCRIPT), str(folder)], start_new_session=True)


def _digest(folder: Path) -> str:
    return hashlib.sha256((folder / "policy.safetensors").read_bytes()).hexdigest()


def _wait_for_nobody(session: int, seconds: float = 20.0) -> list[int]:
    end = time.monotonic() + seconds
    while alive(session) and time.monotonic() < end:
        time.sleep(0.1)
    return alive(session)


@pytest.mark.slow
def test_twenty_kills_at_random_moments_change_nothing(tmp_path: Path) -> None:
    lasted = np.inf  # the shorter of two, as the first one may have been held up
    for name in ("whole", "again"):
        begun = time.monotonic()
        assert _start(tmp_path / name).wait(timeout=120) == 0
        lasted = min(lasted, time.monotonic() - begun)
    expected = _digest(tmp_path / "whole")
    assert _digest(tmp_path / "again") == expected
    rng = np.random.default_rng(0)
    interrupted = resumed = 0
    for number in range(KILLS):
        folder = tmp_path / str(number)
        process = _start(folder)
        time.sleep(float(rng.uniform(0.2, 0.98)) * lasted)
        interrupted += process.poll() is None
        process.kill()
        process.wait()
        assert not _wait_for_nobody(process.pid), "workers outlived a training that was killed"
        resumed += (folder / NAME).is_file()
        if not (folder / "policy.json").is_file():  # else it had ended before the kill
            assert _start(folder).wait(timeout=120) == 0
        assert _digest(folder) == expected, number
    assert interrupted >= KILLS - 2 and resumed >= KILLS // 4  # else nothing was tested


@pytest.mark.slow
def test_ctrl_c_leaves_no_process(tmp_path: Path) -> None:
    process = _start(tmp_path / "run")
    end = time.monotonic() + 60.0
    while not (tmp_path / "run" / NAME).is_file() and time.monotonic() < end:  # it is well under way then
        time.sleep(0.05)
    assert len(alive(process.pid)) > 1
    os.killpg(process.pid, signal.SIGINT)
    assert process.wait(timeout=30) != 0
    assert not _wait_for_nobody(process.pid)
