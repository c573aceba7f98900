"""Speed, measured: every figure with what it is compared to in the same run.

On a machine that others use too, two figures taken one after the other cannot be compared. The environment part
therefore goes in rounds: in each, episodes on every kind of ground and of the peer in turn, then all cores. Rates are
medians of the rounds, ratios are made within a round, and the first round, in which caches fill, does not count.

The peer is ``PandaReach-v3`` of panda-gym, also PyBullet, which is not in the lock: ``pip install -e .[peers]`` (or
``make bench-peers``). Without it the range that is handed down for it is given, under a name that says so.
"""

from __future__ import annotations

import itertools
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean, median
from typing import Any

import gymnasium
import numpy as np
from sb3_contrib import RecurrentPPO

from lunar_rescue import LunarRescueEnv, sample_scene
from lunar_rescue.physics.quiet import no_greeting
from lunar_rescue.physics.robot import JOINTS
from lunar_rescue.tasks import MAX_STEPS
from reproduce.bench.profiling import measure_methods, measure_profile
from reproduce.bench.stock import StockTraining, copy_rollout
from reproduce.experiments.grounds import measure_grounds
from reproduce.experiments.methods import METHODS
from reproduce.experiments.soak import FIRST_SEED
from reproduce.experiments.train import train
from reproduce.hrl_dcs.training import make_learner
from reproduce.learning.config import PRESETS, LearnerConfig, TrainingConfig
from reproduce.learning.training import OnlySpaces
from reproduce.learning.workers import WorkerVecEnv
from reproduce.storage.errors import UserError
from reproduce.storage.provenance import provenance

STOCK_UPDATES, LEARNER_ROUNDS = 3, 3
#: Transitions a minibatch at which learners are compared; the stock one loops over time for each minibatch, so the
#: smaller they are the slower it is. The headline figure is at the default of ``LearnerConfig``.
BATCHES, BATCH = (128, 512, 1024), LearnerConfig().batch_size
ROUNDS = 9  # besides the first, which fills caches
STEPS = 1000  # at least, of a kind of ground, and of the peer, in a round
ALL_ENVS = 16  # environments on all cores, for MAX_STEPS steps a round: most end together, once in so many steps
LOOKED_AT = 64  # scenes drawn to see which kinds of ground there are
HOLD = 10  # steps for which a random action is held, so that the arms get somewhere
PEER = "PandaReach-v3"
#: Steps a second of one process of the peer, as handed down with this project's requirements; no publication found.
PEER_PUBLISHED = [330, 530]
#: What keys of a kind of ground end with; smooth ground has the plain names.
ENDINGS = {"smooth": "", "rough": "_rough"}


@dataclass
class Tally:
    """Time and counts of one kind of ground, or of the peer, in one round [s]."""

    steps: int = 0
    resets: int = 0
    stepping: float = 0.0
    resetting: float = 0.0
    inside: float = 0.0  # of stepping, PyBullet's part

    @property
    def rate(self) -> float:
        """Steps a second, without resets."""
        return self.steps / self.stepping

    @property
    def rate_with_resets(self) -> float:
        """Steps a second, all in."""
        return self.steps / (self.stepping + self.resetting)

    @property
    def share_in_physics(self) -> float:
        """Share of the stepping time inside PyBullet's step."""
        return self.inside / self.stepping

    @property
    def reset_in_steps(self) -> float:
        """Time of a mean reset over that of a mean step."""
        return (self.resetting / self.resets) * self.rate


Round = dict[str, Tally]


def measure(part: str = "all", rounds: int = ROUNDS, steps: int = STEPS) -> dict[str, Any]:
    """The figures of ``bench --json``, flat.

    Args:
        part: A name of ``PARTS``, or ``"all"``.
        rounds: Rounds of the environment part that count.
        steps: Least number of steps of a kind in a round.

    Raises:
        UserError: On an unknown part.
    """
    if part != "all" and part not in PARTS:
        raise UserError(f"--part: expected one of {', '.join([*PARTS, 'all'])}; got {part!r}")
    load = os.getloadavg()[0]  # others' work, before ours begins
    figures: dict[str, Any] = {}
    for name, run in PARTS.items():
        if part in (name, "all"):
            figures |= run(rounds, steps)
    return {**figures, "cores": len(os.sched_getaffinity(0)), "load_before": round(load, 2), "origin": provenance()}


# -- environment -------------------------------------------------------------------------------------------------------
def measure_environments(rounds: int, steps: int) -> dict[str, Any]:
    """One process on each kind of ground, the peer, and sixteen environments on all cores, in alternation."""
    kinds = {sample_scene(FIRST_SEED + i).terrain.kind for i in range(LOOKED_AT)} & set(ENDINGS)
    rng = np.random.default_rng(0)
    done: list[Round] = []
    everywhere: list[float] = []
    with ExitStack() as stack:
        ours, peer = _Ours(stack), _peer(stack)
        venv = stack.enter_context(closing(WorkerVecEnv(ALL_ENVS, seed=0)))
        venv.reset()
        for _ in range(rounds + 1):
            done.append(_round(ours, peer, kinds, steps))
            everywhere.append(_all_environments(venv, rng))
    return {
        **environment_figures(done[1:]),
        "env_steps_per_s_all": round(median(everywhere[1:]), 1),
        "rounds": rounds,
    }


def _round(ours: _Ours, peer: _Peer | None, kinds: set[str], steps: int) -> Round:
    """Whole episodes until each kind of ground has had its steps; the peer keeps up, so that all share the noise."""
    tallies = {kind: Tally() for kind in kinds}
    peers = Tally()
    while any(tally.steps < steps for tally in tallies.values()):
        ours.next_episode(tallies, steps)
        while peer and peers.steps < max(tally.steps for tally in tallies.values()):
            peer.next_episode(peers)
    return {**tallies, PEER: peers} if peer else tallies


def environment_figures(rounds: list[Round]) -> dict[str, Any]:
    """Medians of the rounds' rates and ratios; keys of a kind of ground that was not met are left out."""
    found: dict[str, Any] = {}
    for kind, ending in ENDINGS.items():
        tallies = [tallies[kind] for tallies in rounds if kind in tallies]
        if tallies:
            found[f"env_steps_per_s{ending}_1"] = _median(t.rate for t in tallies)
            found[f"env_steps_per_s{ending}_1_with_resets"] = _median(t.rate_with_resets for t in tallies)
            found[f"share_in_physics{ending}"] = _median((t.share_in_physics for t in tallies), 3)
            # Resets differ from scene to scene, so theirs is a mean; numerator and denominator share a round's noise.
            found[f"reset_in_steps{ending}"] = round(fmean(t.reset_in_steps for t in tallies), 2)
            found[f"scenes{ending or '_smooth'}"] = sum(t.resets for t in tallies)
    found |= _ratios("rough_over_smooth", rounds, "rough", "smooth")
    peers = [tallies[PEER] for tallies in rounds if PEER in tallies]
    if not peers:
        return {**found, "peer_published_steps_per_s": PEER_PUBLISHED}
    found |= {
        "peer": PEER,
        "peer_steps_per_s_1": _median(t.rate for t in peers),
        "peer_steps_per_s_1_with_resets": _median(t.rate_with_resets for t in peers),
        "peer_reset_in_steps": round(fmean(t.reset_in_steps for t in peers), 2),
    }
    return found | _ratios("env_over_peer", rounds, "smooth", PEER) | _ratios("rough_over_peer", rounds, "rough", PEER)


def _ratios(name: str, rounds: list[Round], above: str, below: str) -> dict[str, Any]:
    """Ratio of two rates in each round, and their median."""
    ratios = [tallies[above].rate / tallies[below].rate for tallies in rounds if above in tallies and below in tallies]
    return {name: _median(ratios, 3), f"{name}_rounds": [round(ratio, 3) for ratio in ratios]} if ratios else {}


def _median(values: Any, digits: int = 1) -> float:
    return round(median(values), digits)


class _Ours:
    """One environment with everything on, timed from outside; scenes follow from consecutive seeds."""

    def __init__(self, stack: ExitStack) -> None:
        self.env = stack.enter_context(closing(LunarRescueEnv()))
        self._seeds: Iterator[int] = itertools.count(FIRST_SEED)
        self._rng = np.random.default_rng(0)
        self._inside = 0.0
        self._advance = self.env.simulation.advance
        self.env.simulation.advance = self._timed  # type: ignore[method-assign]

    def _timed(self, substeps: int) -> None:
        begun = time.perf_counter()
        self._advance(substeps)
        self._inside += time.perf_counter() - begun

    def next_episode(self, tallies: Round, steps: int) -> None:
        """One episode, into the tally of its ground; none where that has its steps already."""
        begun = time.perf_counter()
        # The scene is drawn within the time of the reset, as in training; only then is its ground known.
        _, info = self.env.reset_flat(next(self._seeds))
        resetting = time.perf_counter() - begun
        tally = tallies.get(info["scene"].terrain.kind)
        if tally is not None and tally.steps < steps:
            tally.resetting += resetting
            tally.resets += 1
            self._episode(tally)

    def _episode(self, tally: Tally) -> None:
        self._inside, done, number = 0.0, False, 0
        while not done:
            if number % HOLD == 0:
                action = self._rng.uniform(-1, 1, JOINTS)
            begun = time.perf_counter()
            *_, terminated, truncated, _ = self.env.step_flat(action)
            tally.stepping += time.perf_counter() - begun
            number, done = number + 1, terminated or truncated
        tally.steps += number
        tally.inside += self._inside


class _Peer:
    """panda-gym's environment without Gymnasium's wrappers, as ours is measured, and with its own step limit."""

    def __init__(self, env: gymnasium.Env[Any, Any], longest: int) -> None:
        self.env = env
        self._longest = longest
        self.env.action_space.seed(0)

    def next_episode(self, tally: Tally) -> None:
        """One episode of random actions."""
        begun = time.perf_counter()
        self.env.reset()
        tally.resetting += time.perf_counter() - begun
        tally.resets += 1
        for _ in range(self._longest):
            action = self.env.action_space.sample()
            begun = time.perf_counter()
            _, _, terminated, _, _ = self.env.step(action)
            tally.stepping += time.perf_counter() - begun
            tally.steps += 1
            if terminated:
                break


def _peer(stack: ExitStack) -> _Peer | None:
    """The peer if panda-gym is installed; ``stack`` closes it."""
    try:
        import panda_gym  # noqa: F401
    except ImportError:
        return None
    with no_greeting():
        env = stack.enter_context(closing(gymnasium.make(PEER)))
    assert env.spec is not None and env.spec.max_episode_steps is not None
    return _Peer(env.unwrapped, env.spec.max_episode_steps)


def _all_environments(venv: WorkerVecEnv, rng: np.random.Generator) -> float:
    """Steps a second of all environments together, resets included, as a training sees them."""
    begun = time.perf_counter()
    for step in range(MAX_STEPS):
        if step % HOLD == 0:
            actions = rng.uniform(-1, 1, (venv.num_envs, JOINTS)).astype(np.float32)
        venv.step(actions)
    return MAX_STEPS * venv.num_envs / (time.perf_counter() - begun)


# -- training ----------------------------------------------------------------------------------------------------------
def measure_training(rounds: int, steps: int) -> dict[str, Any]:
    """A whole training of the main method with our parts and with stock ones, and the learners alone."""
    config = replace(PRESETS["laptop"], steps=12 * 2048)
    with tempfile.TemporaryDirectory() as folder:
        curve = train(METHODS["hrl_dcs"], config, 0, Path(folder) / "run", "laptop", quiet=True)
    # The first updates hold the start of workers and learners.
    taken, seconds = curve["env_steps"].to_numpy(), curve["seconds"].to_numpy()
    ours = float((taken[-1] - taken[1]) / (seconds[-1] - seconds[1]))
    stock, learner = _stock_training(config, STOCK_UPDATES)
    return {
        "training_steps_per_s": round(ours, 1),
        "stock_training_steps_per_s": round(stock, 1),
        "training_ratio": round(ours / stock, 2),
        **learner,
    }


def _stock_training(config: TrainingConfig, updates: int) -> tuple[float, dict[str, Any]]:
    """Steps a second of a training with stock parts; then both learners on the last rollout, in alternation."""
    with closing(StockTraining(config, 0)) as stock:
        stock.update()
        begun = time.perf_counter()
        for _ in range(updates):
            stock.update()
        rate = updates * config.low.n_steps * config.n_envs / (time.perf_counter() - begun)
        stock.collect()
        ratios = {batch: _learner_ratios(stock, replace(config.low, batch_size=batch)) for batch in BATCHES}
        return rate, {
            "learner_ratio": round(median(ratios[BATCH]), 2),
            "learner_ratio_rounds": [round(ratio, 2) for ratio in ratios[BATCH]],
            **{f"learner_ratio_{batch}": round(median(found), 2) for batch, found in ratios.items()},
        }


def _learner_ratios(stock: StockTraining, config: LearnerConfig) -> list[float]:
    """The stock learner's time over ours, on the same rollout, weights, batch and epochs, in alternation."""
    spaces = OnlySpaces(stock.env.observation_space, stock.env.action_space, stock.config.n_envs)
    learners = {
        "stock": make_learner(spaces, config, 0, False, RecurrentPPO),
        "ours": make_learner(spaces, config, 0, False),
    }
    for learner in learners.values():
        learner.policy.load_state_dict(stock.lln.policy.state_dict())
        # Each its own copy: the stock learner flattens its buffer for good when it reads it.
        copy_rollout(stock.lln.rollout_buffer, learner.rollout_buffer)
    ratios = []
    for _ in range(LEARNER_ROUNDS):
        theirs, ours = (_seconds_of(learners[name].train) for name in ("stock", "ours"))
        ratios.append(theirs / ours)
    return ratios


def _seconds_of(run: Callable[[], None]) -> float:
    begun = time.perf_counter()
    run()
    return time.perf_counter() - begun


#: What ``bench --part`` knows, in the order in which it is run.
PARTS: dict[str, Callable[[int, int], dict[str, Any]]] = {
    "env": measure_environments,
    "training": measure_training,
    "profile": measure_profile,
    "methods": measure_methods,
    "ground": lambda rounds, steps: measure_grounds(),
}
