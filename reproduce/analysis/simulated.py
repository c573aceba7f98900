"""Simulate trainings and tests whose truth is known.

A training has its own log-odds of success, normal about its method's; scenes shift those of all trainings alike
(difficulty), and of each method's in its own way (taste); a test is one draw.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.random import Generator
from scipy.optimize import brentq
from scipy.special import expit

from reproduce.analysis.intervals import Outcomes

_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(60)  # integrals over a normal distribution


class Method(NamedTuple):
    """What is true of a simulated method."""

    rate: float  # success over all trainings and scenes that could be
    spread: float = 0.5  # sd of trainings' log-odds
    trainings: int = 5


class World(NamedTuple):
    """The scenes that all trainings meet."""

    difficulty: float = 0.0  # sd of what a scene adds to the log-odds of all
    taste: float = 0.0  # sd of what it adds to those of one method
    scenes: int = 1000


@cache
def centre(rate: float, spread: float) -> float:
    """Return the log-odds about which normal ones with this sd have a mean success of ``rate``."""
    mean = lambda middle: float(_WEIGHTS @ expit(middle + spread * _NODES) / _WEIGHTS.sum()) - rate  # noqa: E731
    return float(brentq(mean, -40.0, 40.0))


def spread(points: float, rate: float) -> float:
    """Return the sd of log-odds that is an sd of so many points at a success rate."""
    return points / 100 / (rate * (1.0 - rate))


def experiment(rng: Generator, world: World, *methods: Method) -> list[Outcomes]:
    """Return the outcomes of simulated methods, each (trainings, scenes), on the same scenes."""
    shared, tests = world.difficulty * rng.standard_normal(world.scenes), []
    for method in methods:
        middle = centre(method.rate, float(np.hypot(np.hypot(method.spread, world.difficulty), world.taste)))
        own = world.taste * rng.standard_normal(world.scenes)
        odds = middle + method.spread * rng.standard_normal((method.trainings, 1)) + shared + own
        tests.append(rng.random(odds.shape) < expit(odds))
    return tests


def beta_trainings(rng: Generator, rate: float, points: float, trainings: int = 5, scenes: int = 1000) -> Outcomes:
    """Return outcomes of trainings whose rates are beta-distributed with an sd of so many points: no log-odds here."""
    total = rate * (1.0 - rate) / (points / 100) ** 2 - 1.0
    return rng.random((trainings, scenes)) < rng.beta(rate * total, (1.0 - rate) * total, (trainings, 1))


def failing_trainings(
    rng: Generator, good: float, bad: float, share: float, trainings: int = 5, scenes: int = 1000
) -> Outcomes:
    """Return outcomes of trainings of which a share goes wrong and ends with another rate."""
    rates = np.where(rng.random((trainings, 1)) < share, bad, good)
    return rng.random((trainings, scenes)) < rates
