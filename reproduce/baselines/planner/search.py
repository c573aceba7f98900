"""Find variants of lifts and turns by random search: ``python -m reproduce.baselines.planner.search``.

Run it again when the physics changes. Candidates are drawn around the script's way-points; a candidate that fails on
more than a few of the first scenes is dropped. Those that remain are put in the order in which each adds most scenes.
"""

from collections.abc import Iterator
from dataclasses import asdict
from itertools import count, islice
from pathlib import Path

import numpy as np
import typer
from numpy.typing import NDArray

from lunar_rescue import LunarRescueEnv, Scene, sample_scene
from reproduce.baselines.planner.approach import ApproachPlanner, CollisionChecker
from reproduce.baselines.planner.rollout import Rollout, Trial
from reproduce.baselines.scripted import SCRIPT, VARIANTS, Variant, kind, load_way_points, vary
from reproduce.storage.files import check_writable, write_json
from reproduce.storage.provenance import provenance

Array = NDArray[np.float64]

FIRST_SEED = 100_000  # training scenes
FIRST_SCENES, SCENES = 10, 60  # of a kind
CANDIDATES = 40  # of a kind
KEEP = 0.65  # a candidate must succeed on this share of the first scenes
LISTED = 16  # variants in the file, at most
KINDS = ("lift prone", "lift supine", "turn_over prone", "turn_over side")


def _arms_under(env: LunarRescueEnv, checker: CollisionChecker, name: str) -> Iterator[tuple[Scene, Trial, Array]]:
    """Yield scenes of one kind, each with a trial that got both arms under and the targets it was for."""
    for scene in map(sample_scene, count(FIRST_SEED)):
        if kind(scene) != name:
            continue
        env.reset_flat(options={"scene": scene})
        checker.set_scene(scene)
        approach = ApproachPlanner(checker, env, np.random.default_rng(scene.seed))
        way = next(approach.ways(), None)
        trial = Rollout(env, scene).approach(way.path) if way else None
        if trial is not None and trial.under is not None:
            yield scene, trial, approach.targets


def search(name: str, candidates: int, scenes: int) -> tuple[list[Variant], list[float]]:
    """Return variants of one kind, the most useful first, and each one's share of successes."""
    env, checker = LunarRescueEnv(), CollisionChecker()
    ready = list(islice(_arms_under(env, checker, name), scenes))

    def try_out(variant: Variant, where: slice) -> list[bool]:
        return [Rollout(env, scene).rescue(under, variant, targets).rescued for scene, under, targets in ready[where]]

    rng = np.random.default_rng([FIRST_SEED, KINDS.index(name)])
    base = best = load_way_points(SCRIPT)[name][0]
    variants: list[Variant] = []
    rows: list[list[bool]] = []
    most = 0.0
    for index in range(candidates):
        # Half of the candidates around the script's way-points, half around the best so far.
        candidate = base if index == 0 else vary(base if index % 2 else best, rng, float(rng.uniform(0.4, 1.3)))
        row = try_out(candidate, slice(FIRST_SCENES))
        if index and np.mean(row) < KEEP:
            continue
        row += try_out(candidate, slice(FIRST_SCENES, None))
        variants.append(candidate)
        rows.append(row)
        if np.mean(row) > most:
            best, most = candidate, float(np.mean(row))
    env.close()
    checker.close()
    order = _cover(np.array(rows, dtype=float))
    return [variants[i] for i in order], [round(float(np.mean(rows[i])), 3) for i in order]


def _cover(success: Array) -> list[int]:
    """Order the rows of (variants, scenes): the best first, then whichever adds most to what is covered."""
    order: list[int] = []
    # A scene that was solved often counts little, but counts: the physics of a new scene is not exactly an old one's.
    weight = np.ones(success.shape[1])
    left = list(range(len(success)))
    while left and len(order) < LISTED:
        best = max(left, key=lambda i: (float(success[i] @ weight), -i))
        order.append(best)
        left.remove(best)
        weight = weight * np.where(success[best] > 0, 0.1, 1.0)
    return order


def main(out: Path = VARIANTS, candidates: int = CANDIDATES, scenes: int = SCENES) -> None:
    """Search all kinds, with so many candidates and scenes of each, and write the file."""
    check_writable(out)
    origin = provenance()  # of the code that runs, whatever is edited meanwhile
    kinds, shares = {}, {}
    for name in KINDS:
        variants, shares[name] = search(name, candidates, scenes)
        points = [[asdict(point) for point in variant] for variant in variants]
        kinds[name] = [[{key: round(value, 3) for key, value in row.items()} for row in rows] for rows in points]
        print(name, shares[name], flush=True)
    how = (
        f"random search around the way-points of method scripted, {candidates} candidates of a kind on {scenes} "
        f"training scenes each from seed {FIRST_SEED} on, then in the order in which each adds most"
    )
    write_json(out, {"how": how, "shares": shares, "kinds": kinds, "origin": origin})


if __name__ == "__main__":
    typer.run(main)
