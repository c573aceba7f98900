"""Measure speed, every figure with what it is compared to in the same run.

On a machine that others use too, two figures taken one after the other cannot be compared. The environment part
therefore goes in rounds: in each, episodes on every kind of ground and of the peer in turn, then all cores. Rates are
medians of the rounds, ratios are made within a round, and the first round, in which caches fill, does not count.

The peer is ``PandaReach-v3`` of panda-gym, also PyBullet, which is not in the lock: ``pip install -e .[peers]`` (or
``make bench-peers``). Without it the range that is handed down for it is given, under a name that says so.
"""

from __future__ import annotations

import itertools
import os
import time
from collections.abc import Callable, Iterable
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from statistics import fmean, median
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from lunar_rescue import LunarRescueEnv, sample_scene
from lunar_rescue.physics.engines import DEFAULT
from lunar_rescue.physics.quiet import no_greeting
from lunar_rescue.physics.robot import JOINTS
from lunar_rescue.tasks import MAX_STEPS
from reproduce.bench.training import measure_training
from reproduce.experiments.evaluate import evaluate
from reproduce.learning.workers import WorkerVecEnv
from reproduce.storage.errors import UserError
from reproduce.storage.paths import COMMITTED, REFERENCE
from reproduce.storage.provenance import provenance

ROUNDS = 9  # besides the first, which fills caches
STEPS = 1000  # at least, of a kind of ground, and of the peer, in a round
FIRST_SEED = 0  # of the scenes; the training split, where nothing is tested
ALL_ENVS = 16  # environments on all cores, for MAX_STEPS steps a round: most end together, once in so many steps
LOOKED_AT = 64  # scenes drawn to see which kinds of ground there are
HOLD = 10  # steps for which a random action is held, so that the arms get somewhere
TESTS = 1000
PEER = "PandaReach-v3"
SECOND = "mujoco"  # the other simulator, where it is installed
#: Steps a second of one process of the peer, as handed down with this project's requirements; no publication found.
PEER_PUBLISHED = [330, 530]
#: What keys of a kind of ground end with; smooth ground has the plain names.
ENDINGS = {"smooth": "", "rough": "_rough"}


@dataclass
class Tally:
    """Times and counts of one kind of ground, or of the peer, in one round."""

    steps: int = 0  # steps that were taken
    resets: int = 0  # resets before them
    stepping: float = 0.0  # time of the steps [s]
    resetting: float = 0.0  # time of the resets [s]
    inside: float = 0.0  # PyBullet's part of the time of the steps [s]

    @property
    def rate(self) -> float:
        """Return steps a second, without resets."""
        return self.steps / self.stepping


Round = dict[str, Tally]


def measure(part: str = "all", rounds: int = ROUNDS, steps: int = STEPS) -> dict[str, Any]:
    """Return the figures of ``bench --json``, flat, of a part of ``PARTS`` or of ``"all"``.

    The environment part has so many rounds that count, with at least so many steps of each kind of ground.
    """
    if part != "all" and part not in PARTS:
        raise UserError(f"--part: expected one of {', '.join([*PARTS, 'all'])}; got {part!r}")
    load = os.getloadavg()[0]  # others' work, before ours begins
    figures: dict[str, Any] = {}
    for name, run in PARTS.items():
        if part in (name, "all"):
            figures |= run(rounds, steps)
    return {**figures, "cores": len(os.sched_getaffinity(0)), "load_before": round(load, 2), "origin": provenance()}


def measure_environments(rounds: int, steps: int) -> dict[str, Any]:
    """Measure one process on each kind of ground, the peer, and sixteen environments on all cores, in alternation."""
    kinds = {sample_scene(FIRST_SEED + i).terrain.kind for i in range(LOOKED_AT)} & set(ENDINGS)
    rng, tallies, everywhere = np.random.default_rng(0), [], []
    with ExitStack() as stack:
        ours, peer = our_episodes(stack), peer_episodes(stack)
        second = our_episodes(stack, SECOND) if find_spec(SECOND) else None
        venv = stack.enter_context(closing(WorkerVecEnv(ALL_ENVS, seed=0)))
        venv.reset()
        for _ in range(rounds + 1):
            tallies.append(run_round(ours, peer, kinds, steps))
            if second:
                tallies[-1][SECOND] = run_second(second, steps)
            everywhere.append(_all_environments(venv, rng))
    rate = round(median(everywhere[1:]), 1)
    return {**environment_figures(tallies[1:]), "env_steps_per_s_all": rate, "rounds": rounds}


def run_round(ours: Episodes, peer: Episodes | None, kinds: Iterable[str], steps: int) -> Round:
    """Run whole episodes until each kind of ground has its steps; the peer keeps up, so that all share the noise."""
    tallies, peers = {kind: Tally() for kind in kinds}, Tally()

    def of_its_ground(info: dict[str, Any]) -> Tally | None:
        tally = tallies.get(info["scene"].terrain.kind)
        return tally if tally is not None and tally.steps < steps else None

    while any(tally.steps < steps for tally in tallies.values()):
        ours.next(of_its_ground)
        while peer and peers.steps < max(tally.steps for tally in tallies.values()):
            peer.next(lambda info: peers)
    return {**tallies, PEER: peers} if peer else tallies


def run_second(episodes: Episodes, steps: int) -> Tally:
    """Run whole episodes on smooth ground in the second simulator, as many steps as in the first."""
    tally = Tally()
    while tally.steps < steps:
        episodes.next(lambda info: tally if info["scene"].terrain.kind == "smooth" else None)
    return tally


class Episodes:
    """Episodes of random actions in one environment, timed from outside."""

    def __init__(
        self, reset: Callable[[], Any], step: Callable[[Any], Any], sample: Callable[[], Any], hold: int, longest: int
    ) -> None:
        self._reset, self._step, self._sample, self._hold, self._longest = reset, step, sample, hold, longest
        self.inside = 0.0  # time that this environment's physics took since the last reset [s]

    def next(self, tally_of: Callable[[dict[str, Any]], Tally | None]) -> None:
        """Run an episode into the tally that its reset's info asks for, or none.

        A scene is drawn within the time of the reset, as in training; only then is its ground known.
        """
        start = time.perf_counter()
        _, info = self._reset()
        resetting = time.perf_counter() - start
        tally = tally_of(info)
        if tally is None:
            return
        tally.resetting, tally.resets = tally.resetting + resetting, tally.resets + 1
        self.inside, over, number = 0.0, False, 0
        while not over and number < self._longest:
            if number % self._hold == 0:
                action = self._sample()
            start = time.perf_counter()
            *_, terminated, truncated, _ = self._step(action)
            tally.stepping += time.perf_counter() - start
            number, over = number + 1, terminated or truncated
        tally.steps, tally.inside = tally.steps + number, tally.inside + self.inside


def our_episodes(stack: ExitStack, simulator: str = DEFAULT) -> Episodes:
    """Return episodes of consecutive seeds with everything on; ``stack`` closes the environment."""
    env = stack.enter_context(closing(LunarRescueEnv(simulator=simulator)))
    seeds, rng, advance = itertools.count(FIRST_SEED), np.random.default_rng(0), env.simulation.advance

    def advance_and_time(substeps: int) -> None:
        start = time.perf_counter()
        advance(substeps)
        episodes.inside += time.perf_counter() - start

    env.simulation.advance = advance_and_time  # type: ignore[method-assign]
    reset, sample = (lambda: env.reset_flat(next(seeds))), partial(rng.uniform, -1, 1, JOINTS)
    episodes = Episodes(reset, env.step_flat, sample, HOLD, MAX_STEPS)
    return episodes


def peer_episodes(stack: ExitStack) -> Episodes | None:
    """Return the peer's episodes if panda-gym is installed; ``stack`` closes the environment."""
    try:
        import panda_gym  # noqa: F401
    except ImportError:
        return None
    with no_greeting():
        env = stack.enter_context(closing(gymnasium.make(PEER)))
    return bare_episodes(env.unwrapped, gymnasium.spec(PEER).max_episode_steps or 50)


def bare_episodes(env: gymnasium.Env[Any, Any], longest: int) -> Episodes:
    """Return episodes of an environment without Gymnasium's wrappers, as ours is measured, and its own step limit."""
    env.action_space.seed(0)
    return Episodes(env.reset, env.step, env.action_space.sample, 1, longest)


def _all_environments(venv: WorkerVecEnv, rng: np.random.Generator) -> float:
    """Return steps a second of all environments together, resets included, as a training sees them."""
    actions: NDArray[np.float32]
    start = time.perf_counter()
    for step in range(MAX_STEPS):
        if step % HOLD == 0:
            actions = rng.uniform(-1, 1, (venv.num_envs, JOINTS)).astype(np.float32)
        venv.step(actions)
    return MAX_STEPS * venv.num_envs / (time.perf_counter() - start)


def environment_figures(rounds: list[Round]) -> dict[str, Any]:
    """Return medians of the rounds' rates and ratios; keys of a kind of ground that was not met are left out."""
    figures: dict[str, Any] = {}
    for kind, ending in ENDINGS.items():
        if tallies := [tallies[kind] for tallies in rounds if kind in tallies]:
            figures |= _figures("env", ending, tallies)
            figures[f"share_in_physics{ending}"] = round(median(t.inside / t.stepping for t in tallies), 3)
            figures[f"scenes{ending or '_smooth'}"] = sum(t.resets for t in tallies)
    figures |= _ratios("rough_over_smooth", rounds, "rough", "smooth")
    if seconds := [tallies[SECOND] for tallies in rounds if SECOND in tallies]:
        figures[f"env_steps_per_s_{SECOND}_1"] = round(median(t.rate for t in seconds), 1)
        figures |= _ratios(f"{SECOND}_over_pybullet", rounds, SECOND, "smooth")
    peers = [tallies[PEER] for tallies in rounds if PEER in tallies]
    if not peers:
        return {**figures, "peer_published_steps_per_s": PEER_PUBLISHED}
    figures |= {"peer": PEER, **_figures("peer", "", peers)}
    figures |= _ratios("env_over_peer", rounds, "smooth", PEER)
    return figures | _ratios("rough_over_peer", rounds, "rough", PEER)


def _figures(name: str, ending: str, tallies: list[Tally]) -> dict[str, Any]:
    """Return rates and the length of a reset in mean steps, the peer's under names of its own."""
    prefix = "peer_" if name == "peer" else ""
    with_resets = median(t.steps / (t.stepping + t.resetting) for t in tallies)
    return {
        f"{name}_steps_per_s{ending}_1": round(median(t.rate for t in tallies), 1),
        f"{name}_steps_per_s{ending}_1_with_resets": round(with_resets, 1),
        # Resets differ from scene to scene, so theirs is a mean; numerator and denominator share a round's noise.
        f"{prefix}reset_in_steps{ending}": round(fmean(t.resetting / t.resets * t.rate for t in tallies), 2),
    }


def _ratios(name: str, rounds: list[Round], above: str, below: str) -> dict[str, Any]:
    """Return the ratio of two rates in each round, and their median."""
    ratios = [tallies[above].rate / tallies[below].rate for tallies in rounds if {above, below} <= tallies.keys()]
    return {name: round(median(ratios), 3), f"{name}_rounds": [round(r, 3) for r in ratios]} if ratios else {}


def measure_tests(rounds: int, steps: int) -> dict[str, Any]:
    """Measure how long 1000 tests of the first HRL-DCS reference policy take; nothing where there is none."""
    policies = sorted((COMMITTED / REFERENCE / "hrl_dcs").glob("seed*/policy.json"))
    return {"tests_1000_s": round(evaluate(str(policies[0].parent), TESTS)["seconds"], 1)} if policies else {}


#: What ``bench --part`` knows, in the order in which it is run.
PARTS: dict[str, Callable[[int, int], dict[str, Any]]] = {
    "env": measure_environments,
    "training": measure_training,
    "tests": measure_tests,
}
