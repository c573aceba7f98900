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

import gymnasium
import imageio.v3 as iio
import numpy as np
import pytest

from lunar_rescue import LunarRescueEnv, sample_scene
from lunar_rescue.pictures import live as pace
from lunar_rescue.pictures.live import LiveView, viser_server
from reproduce.report import watch as module
from reproduce.report.film import replay
from reproduce.report.watch import watch
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


def test_a_human_sees_every_step_in_the_browser(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(pace, "CONTROL_STEP", 0.0)
    env = gymnasium.make("LunarRescueLift-v0", render_mode="human", max_episode_steps=2)
    inner = env.unwrapped
    assert isinstance(inner, LunarRescueEnv)
    _, info = env.reset(seed=1)
    (address,) = re.findall(r"^watch at (http://localhost:\d+)$", capsys.readouterr().err, re.M)
    assert "<html" in urllib.request.urlopen(address, timeout=10).read().decode() and info["task"] == "lift"
    assert inner._window is not None
    actors = inner._window._view._actors
    assert actors is not None
    for _ in range(2):
        env.step(np.ones(11, np.float32))
        assert actors._ends[0].position == pytest.approx(inner.episode.robot.ends[0])
    assert "failed by timeout" in actors._words.text and env.render() is None
    env.reset(seed=2)  # the same page goes on with another scene
    assert inner._window._view._actors is not actors and not capsys.readouterr().err
    env.close()
    with pytest.raises(OSError):
        urllib.request.urlopen(address, timeout=10)


def test_gymnasium_records_videos(tmp_path: Path) -> None:
    pytest.importorskip("moviepy", reason="needs the extra `video`, which is not in the lock")
    made = gymnasium.make("LunarRescueEasy-v0", render_mode="rgb_array", max_episode_steps=4)
    env = gymnasium.wrappers.RecordVideo(made, str(tmp_path), disable_logger=True)
    env.reset(seed=0)
    while not env.step(env.action_space.sample())[2]:
        pass
    env.close()
    (film,) = tmp_path.glob("*.mp4")
    assert len(iio.imread(film)) == 5  # the beginning and four steps


@pytest.mark.process
def test_watch_shows_so_many_rescues_and_says_how_they_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pace, "CONTROL_STEP", 0.0)
    for name in ("PAUSE", "PATIENCE"):
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
