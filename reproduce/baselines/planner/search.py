"""Find variants of lifts and turns by random search on training scenes.

``python -m reproduce.baselines.planner.search`` makes them.

Run it again when the physics changes. Candidates are drawn around the script's way-points; a candidate that fails on
more than a few of the first scenes is dropped. Those that remain are put in the order in which each adds most scenes.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lunar_rescue import LunarRescueEnv, Scene, sample_scene
from reproduce.baselines.planner.approach import ApproachPlanner
from reproduce.baselines.planner.collision import CollisionChecker
from reproduce.baselines.planner.rollout import Rollout, Trial
from reproduce.baselines.planner.variants import DATA_FILE, Variant, as_data, kind, scripted_variant, vary
from reproduce.baselines.scripted import THEN
from reproduce.storage.files import write_json
from reproduce.storage.provenance import provenance

Array = NDArray[np.float64]

FIRST_SEED = 3_100_000  # training scenes
FIRST_SCENES, SCENES = 10, 60  # of a kind
CANDIDATES = 40  # of a kind
KEEP = 0.65  # a candidate must succeed on this share of the first scenes
LISTED = 16  # variants in the file, at most


class _Bench:
    """Scenes of one kind with both arms under, on which variants are tried."""

    def __init__(self, env: LunarRescueEnv, checker: CollisionChecker, name: str, count: int) -> None:
        self._env = env
        self._ready: list[tuple[Scene, Trial, Array]] = []
        seed = FIRST_SEED
        while len(self._ready) < count:
            scene = sample_scene(seed)
            seed += 1
            if kind(scene) == name:
                self._add(checker, scene)

    def _add(self, checker: CollisionChecker, scene: Scene) -> None:
        self._env.reset_flat(options={"scene": scene})
        checker.set_scene(scene)
        approach = ApproachPlanner(checker, self._env, np.random.default_rng(scene.seed))
        way = next(approach.ways(), None)
        trial = Rollout(self._env, scene).approach(way.path) if way else None
        if trial is not None and trial.under is not None:
            self._ready.append((scene, trial, approach.targets))

    def try_out(self, variant: Variant, begin: int, end: int) -> list[bool]:
        return [
            Rollout(self._env, scene).rescue(trial, variant, targets).rescued
            for scene, trial, targets in self._ready[begin:end]
        ]


def search(name: str, candidates: int, scenes: int) -> tuple[list[Variant], list[float]]:
    """Variants of one kind, the most useful first, and each one's share of successes."""
    env, checker = LunarRescueEnv(), CollisionChecker()
    bench = _Bench(env, checker, name, scenes)
    rng = np.random.default_rng([FIRST_SEED, sorted(THEN).index(name)])
    base = scripted_variant(name)
    kept: list[Variant] = []
    rows: list[list[bool]] = []
    best, most = base, 0.0
    for index in range(candidates):
        # Half of the candidates around the script's way-points, half around the best so far.
        candidate = base if index == 0 else vary(base if index % 2 else best, rng, float(rng.uniform(0.4, 1.3)))
        row = bench.try_out(candidate, 0, FIRST_SCENES)
        if index and np.mean(row) < KEEP:
            continue
        row += bench.try_out(candidate, FIRST_SCENES, scenes)
        kept.append(candidate)
        rows.append(row)
        if np.mean(row) > most:
            best, most = candidate, float(np.mean(row))
    env.close()
    checker.close()
    order = _cover(np.array(rows, dtype=float))
    return [kept[i] for i in order], [round(float(np.mean(rows[i])), 3) for i in order]


def _cover(success: Array) -> list[int]:
    """Order of the rows of (variants, scenes): the best first, then whichever adds most to what is covered."""
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


def main() -> None:
    """Search all kinds and write the file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=DATA_FILE)
    parser.add_argument("--candidates", type=int, default=CANDIDATES)
    parser.add_argument("--scenes", type=int, default=SCENES)
    chosen = parser.parse_args()
    origin = provenance()  # of the code that runs, whatever is edited meanwhile
    kinds, shares = {}, {}
    for name in sorted(THEN):
        variants, shares[name] = search(name, chosen.candidates, chosen.scenes)
        kinds[name] = [as_data(variant) for variant in variants]
        print(name, shares[name], flush=True)
    how = (
        f"random search around the way-points of method scripted, {chosen.candidates} candidates of a kind on "
        f"{chosen.scenes} training scenes each from seed {FIRST_SEED} on, then in the order in which each adds most"
    )
    write_json(chosen.out, {"how": how, "shares": shares, "kinds": kinds, "origin": origin})


if __name__ == "__main__":
    main()
