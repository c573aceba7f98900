"""Rescues in three dimensions, each one HTML page that needs no network: viser's player with the recorded motion.

The report has a success and a failure of each method, and every posture.
"""

from __future__ import annotations

import html
import re
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import torch as th

from lunar_rescue import Scene, sample_scene
from lunar_rescue.physics.engines import DEFAULT
from lunar_rescue.physics.robot import CONTROL_STEP
from lunar_rescue.pictures.actors import Actors, Moment, Spectator
from lunar_rescue.pictures.camera import scene_camera
from lunar_rescue.pictures.live import viser_server
from lunar_rescue.pictures.rendering import Picture, Studio
from lunar_rescue.pictures.stage import VisualShape
from lunar_rescue.scenes.postures import postures
from reproduce.analysis.runs import Run
from reproduce.analysis.two_layers import best_two_layers
from reproduce.experiments.evaluate import put_into
from reproduce.experiments.methods import METHODS
from reproduce.report.acting import FRAMES_PER_SECOND, LAST_SECONDS, act_out, ending, load_policy_and_scene
from reproduce.storage.errors import UserError
from reproduce.storage.files import write_text
from reproduce.storage.processes import map_in_processes

BEGIN = 0.3  # s that the first picture stays
MOST_SCENES = 3000  # looked through for a posture
LARGEST = 5_000_000  # bytes of a page; what is larger nobody waits for
THUMBNAIL = (320, 240)  # px
#: What stands over a replay: what its colours mean, and the way back.
_LEGEND = (
    "Balls that shine through: target areas, blue for arm A, orange for arm B; green: sub-goals. Lines: arm ends to "
    "targets, joints to the nearest rocks, red when near. Drag to turn, scroll to come nearer."
)
_LEGEND_STYLE = (
    "position:fixed;left:8px;top:8px;z-index:9;max-width:min(20rem,60vw);padding:.4rem .6rem;border-radius:.3rem;"
    "background:rgba(0,0,0,.6);color:#eee;font:12px/1.4 sans-serif"
)
_BACK = 'href="javascript:history.back()" style="color:#9cf"'


@dataclass(frozen=True)
class Recording:
    """A rescue that was acted out, with everything that is needed to show it."""

    scene: Scene
    robot: list[VisualShape]  # what of the robot is seen
    moments: list[Moment]  # one a step and one of the end
    row: dict[str, Any]  # how it ended, as from ``run_episode``
    end: Picture  # what the end looked like, of size ``THUMBNAIL``


def record(
    where: str | Path, seed: int, posture: str | None = None, task: str | None = None, simulator: str = DEFAULT
) -> Recording:
    """Act one rescue out and note where everything is; see ``acting.load_policy_and_scene``."""
    policy, scene = load_policy_and_scene(where, seed, posture, task)
    moments: list[Moment] = []
    with closing(put_into(simulator, policy)) as env, closing(Spectator()) as spectator, closing(Studio()) as studio:
        row = act_out(env, policy, scene, lambda *what: moments.append(spectator.look(env.episode, *what)[0]))
        end = studio.picture(env.episode, scene_camera(scene, THUMBNAIL))
    return Recording(scene, spectator.robot, moments, row, end)


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
        page = _with_legend(serializer.as_html(dark_mode=True), recording)
    if len(page) > LARGEST:
        raise UserError(f"{out}: the replay would take {len(page)} bytes, more than {LARGEST}")
    write_text(out, page)


def _with_legend(page: str, recording: Recording) -> str:
    """Give Viser's page a title of its own, what its colours mean, and a way back."""
    scene = recording.scene
    title = html.escape(f"{scene.task}, {scene.posture}: {ending(recording.row)}".replace("_", " "))
    legend = f'<div style="{_LEGEND_STYLE}"><b>{title}</b><br>{_LEGEND} <a {_BACK}>back</a></div>'
    page = re.sub(r"<title>[^<]*</title>", lambda _: f"<title>{title}</title>", page, count=1)
    head, body, rest = page.rpartition("</body>")
    return head + legend + body + rest if body else page + legend


@dataclass(frozen=True)
class Clip:
    """One replay of the report's page of replays."""

    group: str  # heading that it belongs to
    label: str  # what the reader clicks on
    where: str  # run folder, or a method's name
    seed: int  # of the scene
    file: str  # name of its page

    @property
    def thumbnail(self) -> str:
        """The name of the picture of its end, beside the page."""
        return f"{Path(self.file).stem}.jpg"


def choose_clips(runs: list[Run]) -> list[Clip]:
    """Choose a success and a failure of each evaluated run, and a scene of each posture.

    Postures are shown by the two layers that rescue most often, or by the script where no run has two layers.
    """
    clips = []
    for run, rows in ((run, rows) for run in runs if (rows := run.rows()) is not None):
        title = METHODS[run.method].title + (f", seed {run.seed}" if run.origin else "")
        for success, word in ((True, "success"), (False, "failure")):
            for seed in rows["seed"][rows["success"] == success].head(1).tolist():
                name = f"{run.method}-{run.seed}-{word}.html"
                clips.append(Clip(title, f"{word}: scene {seed}", _where(run), seed, name))
    best = best_two_layers(runs)
    where, who = (_where(best), METHODS[best.method].title) if best else ("scripted", METHODS["scripted"].title)
    missing = set(postures())
    for seed in range(MOST_SCENES):
        scene = sample_scene(seed)
        if scene.posture in missing:
            missing.discard(scene.posture)
            label = f"{scene.posture.replace('_', ' ')} ({scene.task.replace('_', ' ')}, scene {seed})"
            clips.append(Clip(f"The 20 postures, {who}", label, where, seed, f"posture-{scene.posture}.html"))
        if not missing:
            break
    return clips


def _where(run: Run) -> str:
    return str(run.folder) if run.origin else run.method


def make_clips(clips: list[Clip], folder: Path) -> dict[Clip, str]:
    """Write the replays' pages; return how each one ended, in words."""
    folder.mkdir(parents=True, exist_ok=True)
    endings = map_in_processes(partial(_make, folder=folder), clips, prepare=th.set_num_threads, arguments=(1,))
    return dict(zip(clips, endings, strict=True))


def _make(clip: Clip, folder: Path) -> str:
    recording = record(clip.where, clip.seed)
    write_replay(recording, folder / clip.file)
    imageio.imwrite(folder / clip.thumbnail, recording.end, quality=80)
    return f"{ending(recording.row)} after {recording.row['steps'] * CONTROL_STEP:.1f} s"
