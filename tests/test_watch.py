"""Rescues in the browser, and in files."""

from __future__ import annotations

import re
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import numpy as np
import pytest

from lunar_rescue import LunarRescueEnv, sample_scene
from reproduce.report import watch as module
from reproduce.report.film import replay
from reproduce.report.viewer import viser_server
from reproduce.report.watch import LiveView, watch
from reproduce.storage.errors import UserError


def test_the_live_view_follows_an_episode_and_changes_the_scene() -> None:
    env = LunarRescueEnv()
    with viser_server() as server:
        live = LiveView(server)
        env.reset(options={"scene": sample_scene(1_000)})
        live.show(env.episode)
        assert live._actors is not None
        suit, arm = live._actors._suit, live._actors._ends[0]
        before = arm.position.copy()
        begun = time.monotonic()
        for _ in range(3):
            env.step(np.ones(11, np.float32))
            live.show(env.episode, words="nearly there")
        assert time.monotonic() - begun > 0.25, "real time: a step takes 0.1 s"
        assert "nearly there" in live._actors._words.text
        assert arm.position == pytest.approx(env.episode.robot.ends[0]) and arm.position != pytest.approx(before)
        env.reset(options={"scene": sample_scene(1_001)})
        live.show(env.episode)
        assert live._actors._suit is not suit
        live.close()
    env.close()


def test_watch_shows_so_many_rescues_and_says_how_they_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("PAUSE", "PATIENCE", "CONTROL_STEP"):
        monkeypatch.setattr(module, name, 0.0)
    lines: list[str] = []

    def tell(line: str) -> None:
        if line.startswith("watch at "):
            (address,) = re.findall(r"http://\S+", line)
            page = urllib.request.urlopen(address, timeout=10).read().decode()
            assert "<html" in page and "iser" in page
        lines.append(line)

    watch("random", 3, rescues=1, port=0, tell=tell)
    assert len(lines) == 2 and re.match(r"scene 3, .*: (rescued|failed by \w+)", lines[1])


def test_watch_refuses_what_makes_no_sense() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        for arguments, word in (
            ({"seed": -1}, "seed"),
            ({"seed": 0, "rescues": -1}, "--rescues"),
            ({"seed": 0, "port": 99_999}, "--port"),
            ({"seed": 0, "port": port}, f"--port: {port}"),
            ({"seed": 0, "posture": "sitting"}, "posture"),
        ):
            with pytest.raises((UserError, ValueError), match=word):
                watch("scripted", tell=lambda _: None, **{"port": 0, **arguments})


@pytest.mark.process
def test_ctrl_c_ends_watch_in_one_line() -> None:
    command = [sys.executable, "-m", "reproduce", "watch", "scripted", "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stderr is not None
        assert "watch at http://" in process.stdout.readline()
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=20) == 130
        assert len(process.stderr.read().strip().splitlines()) == 1


@pytest.mark.process
def test_a_replay_takes_endings_in_capitals_and_checks_the_place_first(tmp_path: Path) -> None:
    row = replay("random", 3, tmp_path / "X.PNG", size=(128, 128))
    assert (tmp_path / "X.PNG").stat().st_size > 1000 and "success" in row
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match="cannot be written"):
        replay("random", 3, tmp_path / "file" / "x.png")
    with pytest.raises(UserError, match="--out"):
        replay("random", 3, tmp_path / "x.bmp")
