"""Make demonstrations: the planner's rescues of training scenes, plain and under noise, in all processes.

Under noise the plan's tracker looks where the arms are in each step, so what it wants is right also where the noise has
led; those that still succeed are kept. A demonstration file is gone on with where it ends.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from lunar_rescue import sample_scene
from lunar_rescue.scenes.splits import TRAIN
from reproduce.baselines.planner.planner import RescuePlanner
from reproduce.baselines.planner.rollout import Noise
from reproduce.experiments.pool import map_scenes
from reproduce.learning.actions import LARGEST_CHANGE
from reproduce.learning.demonstrations import Demonstration, read_demonstrations, write_demonstrations
from reproduce.storage.errors import UserError
from reproduce.storage.files import check_writable, locked
from reproduce.storage.provenance import provenance

FIRST_SEED = 1_500_000_000  # of the training scenes that are demonstrated
#: Standard deviations of the noise on set-points, in largest changes of a step; each plan is tried under each, which
#: is cheap beside planning.
DEVIATIONS = (0.1, 0.15, 0.2, 0.3)
CHUNK = 400  # scenes after which the file is written; each chunk starts its processes anew
_PLANNER: list[RescuePlanner] = []


def _prepare() -> None:
    _PLANNER.append(RescuePlanner())


def demonstrate_scene(seed: int, planner: RescuePlanner, deviations: tuple[float, ...]) -> list[Demonstration]:
    """Return the rescues of one scene: as planned, then under noise of each deviation, as far as they succeed."""
    scene = sample_scene(seed)
    plan = planner.plan(scene)
    if not plan.rescued:
        return []
    rescues = [Demonstration(seed, plan.actions, plan.actions)]
    rng = np.random.default_rng([seed, 3])
    for deviation in deviations:
        trial = planner.disturbed(scene, plan, Noise(rng, deviation * LARGEST_CHANGE))
        if trial.rescued:
            rescues.append(Demonstration(seed, trial.actions, trial.wanted))
    return rescues


def _demonstrate(seed: int, deviations: tuple[float, ...]) -> list[Demonstration]:
    return demonstrate_scene(seed, _PLANNER[0], deviations)


def demonstrate(
    scenes: int,
    out: Path,
    *,
    first_seed: int = FIRST_SEED,
    deviations: tuple[float, ...] = DEVIATIONS,
    tell: Callable[[str], object] = print,
    quiet: bool = False,
    wait: bool = False,
) -> tuple[list[Demonstration], float]:
    """Demonstrate so many training scenes and write the rescues to a file, every ``CHUNK`` scenes.

    Returns the rescues and the seconds that they took to make, now or when the file was written.

    Args:
        scenes: Number of scenes.
        out: File to write; one that holds fewer scenes of the same kind is gone on with.
        first_seed: Seed of the first scene.
        deviations: Of the noise, see ``DEVIATIONS``.
        tell: Called with a line in the end.
        quiet: Whether to leave the progress bar out.
        wait: Whether to wait for another process that makes demonstrations in the same folder.

    Raises:
        UserError: On numbers out of range, a place that cannot be written, or a file of another kind.
    """
    _check(scenes, first_seed)
    check_writable(out)
    kind = {"first_seed": str(first_seed), "deviations": str(list(deviations))}
    with locked(out.parent, "demonstrations", wait=wait):
        rescues, done, seconds = _so_far(out, kind)
        for start in range(first_seed + done, first_seed + scenes, CHUNK):
            seeds = range(start, min(start + CHUNK, first_seed + scenes))
            begun = time.monotonic()
            rescues += _chunk(seeds, deviations, f"scenes {done + 1} to {done + len(seeds)}", quiet)
            done, seconds = done + len(seeds), seconds + time.monotonic() - begun
            about = {"scenes": str(done), "seconds": f"{seconds:.1f}", "origin": json.dumps(provenance())}
            write_demonstrations(out, rescues, {**kind, **about})
    tell(f"{out}: {len(rescues)} rescues of {done} scenes, made in {seconds / 60:.1f} minutes")
    return rescues, seconds


def _chunk(seeds: range, deviations: tuple[float, ...], title: str, quiet: bool) -> list[Demonstration]:
    job = partial(_demonstrate, deviations=deviations)
    return [rescue for more in map_scenes(job, seeds, _prepare, title=title, quiet=quiet) for rescue in more]


def _check(scenes: int, first_seed: int) -> None:
    if scenes < 1:
        raise UserError(f"scenes: expected at least 1, got {scenes}")
    if first_seed not in TRAIN or first_seed + scenes - 1 not in TRAIN:
        raise UserError(f"first seed: expected training scenes, {TRAIN.start} to {TRAIN.stop - 1}; got {first_seed}")


def _so_far(path: Path, kind: dict[str, str]) -> tuple[list[Demonstration], int, float]:
    """Return what a file holds already, of how many scenes, and the seconds that it took."""
    if not path.is_file():
        return [], 0, 0.0
    rescues, header = read_demonstrations(path)
    for key, expected in kind.items():
        if header.get(key) != expected:
            raise UserError(f"{path}: {key}: holds those of {header.get(key)}, not of {expected}; choose another --out")
    return rescues, int(header.get("scenes", 0)), float(header.get("seconds", 0.0))
