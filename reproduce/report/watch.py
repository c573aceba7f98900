"""``reproduce watch``: rescues in the browser, in real time; it needs no display where it runs."""

from __future__ import annotations

import itertools
import socket
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

from lunar_rescue import LunarRescueEnv, sample_scene
from lunar_rescue.pictures.live import LiveView, viser_server
from reproduce.report.acting import act_out, ending, load_policy_and_scene
from reproduce.storage.errors import UserError

PAUSE = 2.0  # s, after each rescue
PATIENCE = 60.0  # s, that the first rescue waits for somebody to open the page


def watch(
    where: str | Path,
    seed: int,
    rescues: int = 0,
    posture: str | None = None,
    task: str | None = None,
    port: int = 8080,
    tell: Callable[[str], None] = print,
) -> None:
    """Play rescues one after another in the browser, from the scene of ``seed`` on, until interrupted.

    ``where`` is a run folder or a method that does not learn; ``seed`` is the first scene's; 0 ``rescues`` never end,
    and ``port`` 0 is a free one. ``tell`` is called with the page's address, then with a line about each rescue.
    """
    if rescues < 0:
        raise UserError(f"--rescues: expected at least 0, got {rescues}")
    try:  # viser would take the next port without a word
        socket.create_server(("127.0.0.1", port)).close()
    except (OSError, OverflowError) as error:
        raise UserError(f"--port: {port} cannot be served on: {error}") from None
    policy, _ = load_policy_and_scene(where, seed, posture, task)
    with viser_server(port) as server, closing(LunarRescueEnv()) as env, closing(LiveView(server)) as live:
        tell(f"watch at http://localhost:{server.get_port()} (Ctrl-C ends it)")
        end = time.monotonic() + PATIENCE
        while not server.get_clients() and time.monotonic() < end:
            time.sleep(0.1)
        for number in itertools.count(seed) if rescues == 0 else range(seed, seed + rescues):
            scene = sample_scene(number, posture=posture, task=task)
            row = act_out(env, policy, scene, lambda *what: live.show(env.episode, *what))
            tell(f"scene {number}, {row['task']} {row['posture']}: {ending(row)} after {row['steps']} steps")
            time.sleep(PAUSE)
