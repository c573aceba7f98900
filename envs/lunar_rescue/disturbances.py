"""How the world that a robot acts in may differ from the one it believes in, and by how much: data, and nothing moves.

What is drawn follows from the scene's seed and the kind alone, and the severity scales it: a scene meets the same
errors at each severity, only larger. ``disturbed`` has the environment that lets them happen.
"""

import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from random import Random
from typing import NamedTuple

import numpy as np

from lunar_rescue.physics.robot import JOINTS, WAIST
from lunar_rescue.physics.solver import CONTROL_STEP, SolverSettings
from lunar_rescue.scenes.rocks import Rock
from lunar_rescue.scenes.sampling import unseen_rock
from lunar_rescue.scenes.scene import MASS_RANGE, Scene
from lunar_rescue.tasks import MAX_STEPS

SEVERITIES = ("low", "middle", "high")
STUCK_BETWEEN = (5, 40)  # control step at which a joint sticks, from when arms are on their way until they lift


@dataclass(frozen=True)
class Disturbance:
    """What differs in one episode from what the robot believes; as it comes, nothing does."""

    seed: int = 0  # of what is drawn anew in each step
    position: float = 0.0  # standard deviation of the seen place of body and rocks along each axis [m]
    attitude: float = 0.0  # standard deviation of the seen attitude of the body about each axis [rad]
    dropped: float = 0.0  # share of the steps in which no pose of the body arrives, and the last one is kept
    age: int = 0  # of the pose of the body that arrives [control steps]
    delay: int = 0  # between an action and its effect [control steps]
    torque: tuple[float, ...] = ()  # share of its torque limit that each motor has (11,); empty for all of it
    gains: tuple[float, ...] = ()  # what each motor's gain is multiplied by (11,); empty for right ones
    stuck: tuple[int, int, int] | None = None  # a joint, the control step in which it sticks, and for how many
    offset: tuple[float, float, float] | None = None  # of the centre of gravity in the body: front, left, head [m]
    unseen: Rock | None = None  # a rock that is there and not seen
    friction: float = 1.0  # what the scene's friction is multiplied by
    mass: float = 1.0  # what the astronaut's mass is multiplied by, within what any scene has
    solver: SolverSettings | None = None  # how finely the simulator works, where not as usual

    def world(self, scene: Scene) -> Scene:
        """Return the scene that is really there."""
        mass = min(max(self.mass * scene.mass, MASS_RANGE[0]), MASS_RANGE[1])
        added = () if self.unseen is None or self.unseen in scene.rocks else (self.unseen,)
        return scene if (mass, added) == (scene.mass, ()) else replace(scene, mass=mass, rocks=scene.rocks + added)

    def believed(self, scene: Scene) -> Scene:
        """Return the scene that the robot sees."""
        if self.unseen not in scene.rocks:
            return scene
        return replace(scene, rocks=tuple(rock for rock in scene.rocks if rock != self.unseen))


NOTHING = Disturbance()


class Kind(NamedTuple):
    """One kind of disturbance."""

    title: str  # as in tables and figures
    unit: str  # of the levels
    levels: tuple[float, float, float]  # low, middle and high severity
    about: str  # what happens
    make: Callable[[Scene, float, np.random.Generator], Disturbance]  # of a scene, at a level


def _factors(rng: np.random.Generator, least: float, most: float) -> tuple[float, ...]:
    """Draw a factor for each motor, uniform between two."""
    return tuple(rng.uniform(least, most, JOINTS).tolist())


def _payload(scene: Scene, level: float, rng: np.random.Generator) -> Disturbance:
    """Move the centre of gravity towards head or feet: lengthwise, bodies settle a little and do not roll over."""
    return Disturbance(offset=(0.0, 0.0, float(rng.choice([-1.0, 1.0])) * 0.01 * level))


def _unseen(scene: Scene, level: float, rng: np.random.Generator) -> Disturbance:
    return Disturbance(unseen=unseen_rock(scene, 0.01 * level, Random(int(rng.integers(2**32)))))


def _stuck(scene: Scene, level: float, rng: np.random.Generator) -> Disturbance:
    joint, begin = int(rng.integers(WAIST)), int(rng.integers(*STUCK_BETWEEN))
    return Disturbance(stuck=(joint, begin, round(level / CONTROL_STEP)))


#: By name; what is in the middle is what a robot that was built with care should stand.
KINDS: dict[str, Kind] = {
    "position": Kind(
        "place of body and rocks", "cm", (1.0, 2.0, 5.0),
        "standard deviation of the seen place along each axis: half of the variance stays for the whole episode, and "
        "moves rocks too, half is drawn anew in each step",
        lambda scene, level, rng: Disturbance(position=0.01 * level),
    ),
    "attitude": Kind(
        "attitude of the body", "deg", (2.0, 5.0, 10.0),
        "standard deviation of the seen attitude about each axis: half of the variance stays, half is drawn anew",
        lambda scene, level, rng: Disturbance(attitude=math.radians(level)),
    ),
    "dropped": Kind(
        "poses that are dropped", "% of steps", (10.0, 30.0, 60.0),
        "share of the steps in which no pose of the body arrives; the last one is kept",
        lambda scene, level, rng: Disturbance(dropped=0.01 * level),
    ),
    "stale": Kind(
        "poses that are old", "steps", (1.0, 3.0, 5.0),
        "age of the pose of the body, in control steps of 0.1 s",
        lambda scene, level, rng: Disturbance(age=int(level)),
    ),
    "delay": Kind(
        "actions that come late", "steps", (1.0, 2.0, 3.0),
        "control steps of 0.1 s between an action and its effect; the robot knows what it asked for last",
        lambda scene, level, rng: Disturbance(delay=int(level)),
    ),
    "torque": Kind(
        "weak motors", "%", (10.0, 20.0, 40.0),
        "what each motor lacks of its greatest torque, uniform up to this",
        lambda scene, level, rng: Disturbance(torque=_factors(rng, 1.0 - 0.01 * level, 1.0)),
    ),
    "gains": Kind(
        "wrong gains", "%", (10.0, 20.0, 40.0),
        "what each motor's gain is off by, up or down, uniform up to this",
        lambda scene, level, rng: Disturbance(gains=_factors(rng, 1.0 - 0.01 * level, 1.0 + 0.01 * level)),
    ),
    "payload": Kind(
        "centre of gravity", "cm", (2.0, 5.0, 10.0),
        "how far the astronaut's centre of gravity is from where it should be, towards head or feet",
        _payload,
    ),
    "unseen_rock": Kind(
        "a rock that was not seen", "cm", (10.0, 15.0, 20.0),
        "diameter of one more rock, in the way to a target; in a scene with all seven, one of those is not seen",
        _unseen,
    ),
    "stuck_joint": Kind(
        "an arm joint that sticks", "s", (1.0, 3.0, MAX_STEPS * CONTROL_STEP),
        "how long one joint of an arm stays where it is, from 0.5 to 4 s on; the longest is for good",
        _stuck,
    ),
}  # fmt: skip


def disturbance(scene: Scene, kind: str, severity: str) -> Disturbance:
    """Draw what happens in a scene, a pure function of its arguments.

    Raises:
        ValueError: On a kind or a severity that does not exist.
    """
    if kind not in KINDS:
        raise ValueError(f"kind: expected one of {', '.join(KINDS)}; got {kind!r}")
    if severity not in SEVERITIES:
        raise ValueError(f"severity: expected one of {', '.join(SEVERITIES)}; got {severity!r}")
    seed = [abs(scene.seed), zlib.crc32(kind.encode())]
    level = KINDS[kind].levels[SEVERITIES.index(severity)]
    made = KINDS[kind].make(scene, level, np.random.default_rng(seed))
    return replace(made, seed=int(np.random.SeedSequence(seed).generate_state(1)[0]))


#: Ranges from which ``randomised`` draws.
RANDOM_FRICTION = (0.8, 1.2)  # times the scene's
RANDOM_MASS = (0.85, 1.15)  # times the scene's
RANDOM_OFFSET = 0.05  # m, of the centre of gravity towards head or feet, at most
RANDOM_SUBSTEPS = (0.005, 0.01)  # s, with an arm at the astronaut
RANDOM_ITERATIONS = (20, 100)  # of the contact solver, there
RANDOM_DELAY = (0, 1)  # control steps
RANDOM_GAINS = (0.8, 1.2)  # times the right one, each motor


def randomised(scene: Scene) -> Disturbance:
    """Draw friction, mass, centre of gravity, solver settings, delay and gains of a training episode by its seed."""
    rng = np.random.default_rng([abs(scene.seed), zlib.crc32(b"randomised")])
    return Disturbance(
        friction=float(rng.uniform(*RANDOM_FRICTION)),
        mass=float(rng.uniform(*RANDOM_MASS)),
        offset=(0.0, 0.0, float(rng.uniform(-RANDOM_OFFSET, RANDOM_OFFSET))),
        solver=SolverSettings(float(rng.choice(RANDOM_SUBSTEPS)), int(rng.integers(*RANDOM_ITERATIONS, endpoint=True))),
        delay=int(rng.choice(RANDOM_DELAY)),
        gains=_factors(rng, *RANDOM_GAINS),
    )
