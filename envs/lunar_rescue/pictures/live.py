"""An episode in the browser as it goes on, in real time: ``reproduce watch`` and ``render_mode="human"``."""

from __future__ import annotations

import io
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, redirect_stdout
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from lunar_rescue.physics.robot import CONTROL_STEP
from lunar_rescue.pictures.actors import Actors, Spectator

if TYPE_CHECKING:
    import viser

LAG = 0.5  # s, that a slow picture may be made up for by quicker ones after it


@contextmanager
def viser_server(port: int = 0) -> Iterator[viser.ViserServer]:
    """Serve viser's page on this machine alone, without its announcements; port 0 takes a free one."""
    import viser  # takes a second, and only this wants it

    with redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host="127.0.0.1", port=port, verbose=False)
    try:
        yield server
    finally:
        with redirect_stdout(io.StringIO()):
            server.stop()


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


class Window:
    """A live view with a page of its own, on a free port of this machine."""

    def __init__(self) -> None:
        with ExitStack() as stack:
            server = stack.enter_context(viser_server())
            self._view = LiveView(server)
            stack.callback(self._view.close)
            self.address = f"http://localhost:{server.get_port()}"
            self.show, self._stack = self._view.show, stack.pop_all()

    def close(self) -> None:
        """Close the page; a second call does nothing."""
        self._stack.close()
