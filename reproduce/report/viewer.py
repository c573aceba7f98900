"""One rescue in three dimensions, as one HTML page that needs no network: viser's player with the recorded motion."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import closing, contextmanager, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lunar_rescue import LunarRescueEnv, Scene
from lunar_rescue.pictures.stage import VisualShape
from reproduce.report.acting import FRAMES_PER_SECOND, LAST_SECONDS, act_out, load_policy_and_scene
from reproduce.report.actors import Actors, Moment, Spectator
from reproduce.storage.errors import UserError
from reproduce.storage.files import write_text

if TYPE_CHECKING:
    import viser

BEGIN = 0.3  # s that the first picture stays
LARGEST = 5_000_000  # bytes of a page; what is larger nobody waits for


@dataclass(frozen=True)
class Recording:
    """A rescue that was acted out, with everything that is needed to show it."""

    scene: Scene
    robot: list[VisualShape]  # what of the robot is seen
    moments: list[Moment]  # one a step and one of the end
    row: dict[str, Any]  # how it ended, as from ``run_episode``


def record(where: str | Path, seed: int, posture: str | None = None, task: str | None = None) -> Recording:
    """Act one rescue out and note where everything is; see ``acting.load_policy_and_scene``."""
    policy, scene = load_policy_and_scene(where, seed, posture, task)
    moments: list[Moment] = []
    with closing(LunarRescueEnv()) as env, closing(Spectator()) as spectator:
        row = act_out(env, policy, scene, lambda *what: moments.append(spectator.look(env.episode, *what)[0]))
    return Recording(scene, spectator.robot, moments, row)


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


def write_replay(recording: Recording, out: Path) -> None:
    """Write the page of a recording, unless it would be larger than ``LARGEST``."""
    first, *rest = recording.moments
    with viser_server() as server:
        serializer = server.get_scene_serializer()
        subgoals = any(moment.subgoals is not None for moment in recording.moments)
        actors = Actors(server, recording.scene, recording.robot, first, subgoals)
        actors.show(first)
        serializer.insert_sleep(BEGIN)
        for moment in rest:
            actors.show(moment)
            serializer.insert_sleep(1.0 / FRAMES_PER_SECOND)
        serializer.insert_sleep(LAST_SECONDS)
        page = serializer.as_html(dark_mode=True)
    if len(page) > LARGEST:
        raise UserError(f"{out}: the replay would take {len(page)} bytes, more than {LARGEST}")
    write_text(out, page)
