"""``reproduce watch``: rescues in the browser, in real time; it needs no display where it runs."""

from __future__ import annotations

import itertools
import socket
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from lunar_rescue import LunarRescueEnv, sample_scene
from lunar_rescue.physics.robot import CONTROL_STEP
from reproduce.report.acting import act_out, ending, load_policy_and_scene
from reproduce.report.actors import Actors, Spectator
from reproduce.report.viewer import viser_server
from reproduce.storage.errors import UserError

if TYPE_CHECKING:
    import viser

PAUSE = 2.0  # s, after each rescue
LAG = 0.5  # s, that a slow picture may be made up for by quicker ones after it
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


class LiveView:
    """Shows an episode as it goes on, one step a ``CONTROL_STEP`` on average."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server, self._spectator = server, Spectator()
        self._actors: Actors | None = None
        self._due = 0.0

    def show(self, episode: Any, subgoals: NDArray[Any] | None = None, words: str = "") -> None:
        """Show where everything is now, when it is time for it; see ``Spectator.look``."""
        time.sleep(max(0.0, self._due - time.monotonic()))
        self._due = max(self._due, time.monotonic() - LAG) + CONTROL_STEP
        moment, new = self._spectator.look(episode, subgoals, words)
        if new or self._actors is None:
            self._server.scene.reset()
            self._actors = Actors(self._server, episode.scene, self._spectator.robot, moment, subgoals is not None)
            self._due = time.monotonic() + CONTROL_STEP
        with self._server.atomic():
            self._actors.show(moment)

    def close(self) -> None:
        """Take the stage down; the server goes on."""
        self._spectator.close()
