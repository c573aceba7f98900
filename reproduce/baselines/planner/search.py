"""Find variants of lifts and turns by random search: ``python -m reproduce.baselines.planner.search``.

Run it again when the physics changes. It begins with the variants that are listed and the script's, and draws more
around the best; one that does badly on the first scenes is dropped. A variant is better the more often it succeeds as
planned and under noise on the set-points, and the sooner: learners imitate what the planner does, and a turn that only
just succeeds cannot be imitated. What remains is put in the order in which each adds most scenes.
"""

from collections.abc import Iterator
from dataclasses import asdict
from functools import partial
from itertools import count, islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
import typer
from numpy.typing import NDArray

from lunar_rescue import LunarRescueEnv, Scene, sample_scene
from reproduce.baselines.planner.approach import ApproachPlanner, CollisionChecker
from reproduce.baselines.planner.rollout import Noise, Rollout, Trial
from reproduce.baselines.scripted import SCRIPT, VARIANTS, Variant, kind, load_way_points, vary
from reproduce.learning.actions import LARGEST_CHANGE
from reproduce.storage.files import check_writable, write_json
from reproduce.storage.processes import map_in_processes
from reproduce.storage.provenance import provenance

Array = NDArray[np.float64]

FIRST_SEED = 200_000  # training scenes
FIRST_SCENES, SCENES = 12, 60  # of a kind
CANDIDATES = 40  # of a kind, those that are listed included
BEHIND = 0.12  # a candidate may score so much less on the first scenes than the fourth best did there
BEST = 4  # variants around which others are drawn
LISTED = 16  # variants in the file, at most
DEVIATION = 0.2  # of the noise, in largest changes of a step
NOISY, STEP = 0.5, 0.002  # what a success under noise counts, and what a step costs, where a success counts 1
KINDS = ("lift prone", "lift supine", "turn_over prone", "turn_over side")


class Tried(NamedTuple):
    """How a variant did."""

    variant: Variant
    rescued: list[bool]  # as planned, a scene each
    scores: list[float]  # see ``NOISY`` and ``STEP``, a scene each


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


def _try_out(env: LunarRescueEnv, variant: Variant, scene: Scene, under: Trial, targets: Array) -> tuple[bool, float]:
    plain = Rollout(env, scene).rescue(under, variant, targets)
    noise = Noise(np.random.default_rng([scene.seed, 5]), DEVIATION * LARGEST_CHANGE)
    noisy = Rollout(env, scene, noise=noise).rescue(under, variant, targets)
    steps = len(plain.actions) - (under.under or 0)
    return plain.rescued, plain.rescued + NOISY * noisy.rescued - STEP * steps


def search(name: str, candidates: int, scenes: int) -> tuple[list[Variant], list[float]]:
    """Return variants of one kind, the most useful first, and each one's share of successes."""
    env, checker = LunarRescueEnv(), CollisionChecker()
    ready = list(islice(_arms_under(env, checker, name), scenes))
    rng = np.random.default_rng([FIRST_SEED, KINDS.index(name)])
    listed = [*load_way_points(VARIANTS).get(name, ()), load_way_points(SCRIPT)[name][0]]
    tried: list[Tried] = []
    for index in range(candidates):
        best = sorted(tried, key=lambda one: -float(np.mean(one.scores)))[:BEST]
        # Those that are listed come first, then others near the best.
        near = best[int(rng.integers(len(best)))].variant if index >= len(listed) else None
        candidate = vary(near, rng, float(rng.uniform(0.2, 0.9))) if near else listed[index]
        rows = [_try_out(env, candidate, *one) for one in ready[:FIRST_SCENES]]
        bar = min((float(np.mean(one.scores[:FIRST_SCENES])) for one in best), default=-np.inf) - BEHIND
        if near and np.mean([score for _, score in rows]) < bar:
            continue
        rows += [_try_out(env, candidate, *one) for one in ready[FIRST_SCENES:]]
        rescued, scores = zip(*rows, strict=True)
        tried.append(Tried(candidate, list(rescued), list(scores)))
    env.close()
    checker.close()
    order = _cover(np.array([one.scores for one in tried]), np.array([one.rescued for one in tried], dtype=float))
    return [tried[i].variant for i in order], [round(float(np.mean(tried[i].rescued)), 3) for i in order]


def _cover(scores: Array, success: Array) -> list[int]:
    """Order variants, rows of (variants, scenes): that of the best score first, then whichever adds most scenes."""
    order: list[int] = [int(scores.mean(axis=1).argmax())]
    # A scene that was solved often counts little, but counts: the physics of a new scene is not exactly an old one's.
    weight = np.where(success[order[0]] > 0, 0.1, 1.0)
    left = [index for index in range(len(success)) if index != order[0]]
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
    results = map_in_processes(partial(search, candidates=candidates, scenes=scenes), KINDS)
    for name, (variants, rates) in zip(KINDS, results, strict=True):
        shares[name] = rates
        points = [[asdict(point) for point in variant] for variant in variants]
        kinds[name] = [[{key: round(value, 3) for key, value in row.items()} for row in rows] for rows in points]
        print(name, shares[name], flush=True)
    how = (
        f"random search around the variants that were listed before, {candidates} candidates of a kind on {scenes} "
        f"training scenes each from seed {FIRST_SEED} on: the best first, then in the order in which each adds most"
    )
    write_json(out, {"how": how, "shares": shares, "kinds": kinds, "origin": origin})


if __name__ == "__main__":
    typer.run(main)
