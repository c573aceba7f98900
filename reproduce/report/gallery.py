"""The report's 3D replays: a success and a failure of each method, and every posture."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch as th

from lunar_rescue import sample_scene
from lunar_rescue.physics.robot import CONTROL_STEP
from lunar_rescue.scenes.postures import postures
from reproduce.analysis.runs import Run
from reproduce.experiments.methods import METHODS
from reproduce.report.acting import ending
from reproduce.report.viewer import record, write_replay
from reproduce.storage.processes import map_in_processes

MOST_SCENES = 3000  # looked through for a posture


@dataclass(frozen=True)
class Clip:
    """One replay of the report's page of replays."""

    group: str  # heading that it belongs to
    label: str  # what the reader clicks on
    where: str  # run folder, or a method's name
    seed: int  # of the scene
    file: str  # name of its page


def choose_clips(runs: list[Run]) -> list[Clip]:
    """Choose a success and a failure of each evaluated run, and a rescue of each posture by HRL-DCS, or the script."""
    clips = []
    for run, rows in ((run, rows) for run in runs if (rows := run.rows()) is not None):
        title = METHODS[run.method].title + (f", seed {run.seed}" if run.origin else "")
        for success, word in ((True, "success"), (False, "failure")):
            for seed in rows["seed"][rows["success"] == success].head(1).tolist():
                name = f"{run.method}-{run.seed}-{word}.html"
                clips.append(Clip(title, f"{word}: scene {seed}", _where(run), seed, name))
    shown = next((run for run in runs if run.method == "hrl_dcs" and run.origin), None)
    where, who = (_where(shown), METHODS["hrl_dcs"].title) if shown else ("scripted", METHODS["scripted"].title)
    wanted = set(postures())
    for seed in range(MOST_SCENES):
        scene = sample_scene(seed)
        if scene.posture in wanted:
            wanted.discard(scene.posture)
            label = f"{scene.posture.replace('_', ' ')} ({scene.task.replace('_', ' ')}, scene {seed})"
            clips.append(Clip(f"The 20 postures, {who}", label, where, seed, f"posture-{scene.posture}.html"))
        if not wanted:
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
    return f"{ending(recording.row)} after {recording.row['steps'] * CONTROL_STEP:.1f} s"
