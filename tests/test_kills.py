"""A training that is killed or interrupted at any moment, and gone on with, ends in the weights of one that was not."""

from __future__ import annotations

import hashlib
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import call, without_progress  # type: ignore[import-not-found]
from sessions import alive, nobody_left, wait_for  # type: ignore[import-not-found]  # pytest puts this folder on the path
from small_training import SEED, SMALL  # type: ignore[import-not-found]

from reproduce.experiments import train as training
from reproduce.experiments.methods import METHODS
from reproduce.experiments.presets import PRESETS
from reproduce.storage.checkpoint import save_checkpoint
from reproduce.storage.paths import CHECKPOINT

SCRIPT = Path(__file__).parent / "small_training.py"
KILLS = 20


class Stop(Exception):
    """Raised in place of a kill."""


def _start(folder: Path) -> subprocess.Popen[str]:
    command = [sys.executable, str(SCRIPT), str(folder)]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)


def _finish(folder: Path) -> None:
    process = _start(folder)
    _, said = process.communicate(timeout=120)
    assert process.returncode == 0, said


def _digest(folder: Path) -> str:
    return hashlib.sha256((folder / "policy.safetensors").read_bytes()).hexdigest()


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, float]:
    """Weights of a training that nobody disturbs, and how long one takes."""
    folder, begun = tmp_path_factory.mktemp("kills") / "whole", time.monotonic()
    _finish(folder)
    return _digest(folder), time.monotonic() - begun


@pytest.mark.slow
def test_twenty_kills_at_random_moments_change_nothing(whole: tuple[str, float], tmp_path: Path) -> None:
    expected, lasted = whole
    begun = time.monotonic()
    _finish(tmp_path / "again")
    assert _digest(tmp_path / "again") == expected
    lasted = min(lasted, time.monotonic() - begun)  # the first one may have been held up
    rng = np.random.default_rng(0)
    interrupted = resumed = 0
    for number in range(KILLS):
        folder = tmp_path / str(number)
        process = _start(folder)
        time.sleep(float(rng.uniform(0.2, 0.98)) * lasted)
        interrupted += process.poll() is None
        process.kill()
        process.communicate()
        assert nobody_left(process.pid), "workers outlived a training that was killed"
        resumed += (folder / CHECKPOINT).is_file()
        if not (folder / "policy.json").is_file():  # else it had ended before the kill
            _finish(folder)
        assert _digest(folder) == expected, number
    assert interrupted >= KILLS - 2 and resumed >= KILLS // 4  # else nothing was tested


@pytest.mark.process
@pytest.mark.parametrize(
    ("number", "whole_group", "awaited"),
    [
        pytest.param(signal.SIGINT, True, CHECKPOINT, id="Ctrl-C"),
        pytest.param(
            signal.SIGINT, True, "config.json", id="Ctrl-C before the first checkpoint", marks=pytest.mark.slow
        ),
        pytest.param(signal.SIGTERM, True, CHECKPOINT, id="timeout", marks=pytest.mark.slow),
        pytest.param(signal.SIGTERM, False, CHECKPOINT, id="SIGTERM", marks=pytest.mark.slow),
        pytest.param(signal.SIGHUP, True, CHECKPOINT, id="a closed terminal", marks=pytest.mark.slow),
    ],
)
def test_an_interrupted_training_says_how_to_go_on_and_does(
    number: int, whole_group: bool, awaited: str, whole: tuple[str, float], tmp_path: Path
) -> None:
    process = _start(tmp_path / "run")
    assert wait_for((tmp_path / "run" / awaited).is_file)  # it is well under way then
    assert len(alive(process.pid)) > 1
    (os.killpg if whole_group else os.kill)(process.pid, number)
    _, said = process.communicate(timeout=30)
    assert process.returncode == 128 + number
    assert nobody_left(process.pid)
    lines = without_progress(said)
    where = r"update \d+" if awaited == CHECKPOINT else "(update 2|the beginning)"
    assert len(lines) == 1, said
    assert re.fullmatch(rf"reproduce: .*/run: interrupted after update \d+; --resume .* goes on from {where}", lines[0])
    assert not (tmp_path / "run" / "policy.json").exists()
    _finish(tmp_path / "run")
    assert _digest(tmp_path / "run") == whole[0]


@pytest.mark.process
def test_a_second_training_in_one_folder_is_refused_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = _start(tmp_path / "run")
    assert wait_for((tmp_path / "run" / "config.json").is_file)
    first.send_signal(signal.SIGSTOP)  # else it may have ended before the second one begins
    before = (tmp_path / "run" / "config.json").stat().st_mtime_ns
    second = call("train", "ppo_lstm", "--preset", "smoke", "--out", str(tmp_path / "run"))
    assert second.code == 2 and "run: run folder is in use by another process" in second.err
    assert len(second.err.splitlines()) == 1
    assert (tmp_path / "run" / "config.json").stat().st_mtime_ns == before
    first.kill()
    first.communicate()
    assert nobody_left(first.pid)

    def save_and_stop(*args: Any) -> None:
        save_checkpoint(*args)
        raise Stop

    monkeypatch.setattr(training, "save_checkpoint", save_and_stop)
    monkeypatch.setitem(PRESETS, "smoke", PRESETS["smoke"] | SMALL)
    method = METHODS["hrl_dcs"]
    with pytest.raises(Stop):  # the lock went with the process that held it
        training.train(method, method.config("smoke"), SEED, tmp_path / "run", "smoke", resume=True, quiet=True)
    assert (tmp_path / "run" / CHECKPOINT).is_file()
