"""The environment with disturbances: what ``disturbances`` describes happens here, in either simulator.

Rewards, success and failure are the environment's own and judge what really happens; only what the robot sees and what
its motors do is disturbed.
"""

import math
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lunar_rescue.arrays import Array, Floats
from lunar_rescue.disturbances import NOTHING, Disturbance
from lunar_rescue.env import LunarRescueEnv
from lunar_rescue.episode import Episode, begin_episode
from lunar_rescue.observation import SLICES
from lunar_rescue.physics.astronaut import AstronautState
from lunar_rescue.physics.robot import JOINTS, checked_action
from lunar_rescue.scenes.scene import Scene


class DisturbedEnv(LunarRescueEnv):
    """``LunarRescueEnv`` with a disturbance in each episode; without one, its episodes are the same bit for bit.

    ``reset(options={"disturbance": ...})`` names that of an episode, which is else what ``draw`` says for its scene.

    Attributes:
        disturbance: What is different in the episode under way.
    """

    def __init__(self, draw: Callable[[Scene], Disturbance] | None = None, **arguments: Any) -> None:
        """Connect to the simulator; ``arguments`` are those of ``LunarRescueEnv``."""
        super().__init__(**arguments)
        self._draw = draw
        self._named: Disturbance | None = None
        self._usual = self.simulation.settings
        self.disturbance = NOTHING

    def reset_flat(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        """Start an episode as ``LunarRescueEnv`` does; of the options, ``disturbance`` is a ``Disturbance``."""
        options = dict(options or {})
        named = options.pop("disturbance", None)
        if named is not None and not isinstance(named, Disturbance):
            raise ValueError(f"options['disturbance']: expected a Disturbance, got {type(named).__name__}")
        self._named = named
        return super().reset_flat(seed, options)

    def _begin(self, scene: Scene) -> Episode:
        d = self._named or (self._draw(scene) if self._draw else NOTHING)
        self.disturbance = d
        self.simulation.settings = d.solver or self._usual
        self._clear()
        self.robot.set_motors(d.torque, d.gains)
        self._rng = np.random.default_rng(d.seed)
        self._off = _half(d.position) * self._rng.standard_normal(3), _half(d.attitude) * self._rng.standard_normal(3)
        self._poses: deque[AstronautState] = deque(maxlen=d.age + 1)
        self._seen: AstronautState | None = None
        self._asked = np.zeros(JOINTS)
        self._late = deque([self._asked] * d.delay)
        world = d.world(scene)
        return begin_episode(
            self.simulation,
            self.robot,
            world,
            self.weights.memory,
            seen=d.believed(scene) if d.unseen else None,
            friction=d.friction,
            offset=None if d.offset is None else np.array(d.offset),
        )

    def step_flat(self, action: NDArray[np.floating[Any]]) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        """Hold what was asked for some steps ago, as ``LunarRescueEnv`` does; the observation has what is asked now."""
        self._asked = checked_action(action)
        self._late.append(self._asked)
        return super().step_flat(self._stuck(self._late.popleft()))

    def _stuck(self, action: Array) -> Array:
        """Return an action that leaves the joint that sticks where it was when it began to."""
        if self.disturbance.stuck is None:
            return action
        (joint, begin, lasts), e = self.disturbance.stuck, self.episode
        if e.steps == begin:
            self._held = float(self.robot.action_for(e.robot.angles)[joint])
        if not begin <= e.steps < begin + lasts:
            return action
        stuck = action.copy()
        stuck[joint] = self._held
        return stuck

    def _observe(self, action: Array) -> Floats:
        e, body = self.episode, self._perceive(self.episode.body)
        if body is e.body:
            return super()._observe(self._asked)
        targets = e.astronaut.targets(body)[e.order]
        entries = targets + e.entries() - e.targets()
        phase = np.array([float(e.process == 2), e.steps / self.max_steps])
        seen = e.observer.fill(e.robot, body, targets, entries, e.astronaut.keypoints(body), self._asked, phase)
        if self.disturbance.position:
            rocks = seen[SLICES["P_E"]].reshape(-1, 5)  # a view: top mark (3), radius, whether there is one
            moved, still = e.observer.to_base(np.array([self._off[0], np.zeros(3)]))
            rocks[:, :3] += rocks[:, 4:] * (moved - still)
        return seen

    def _perceive(self, body: AstronautState) -> AstronautState:
        """Return the state of the body that the robot takes for the present one."""
        d = self.disturbance
        self._poses.append(body)
        if self._seen is not None and d.dropped and self._rng.random() < d.dropped:
            return self._seen
        arrived = self._poses[0]
        if d.position or d.attitude:
            moved, turned = (self._rng.standard_normal(3) for _ in range(2))
            centre = arrived.centre + self._off[0] + _half(d.position) * moved
            turn = Rotation.from_rotvec(self._off[1] + _half(d.attitude) * turned).as_matrix()
            arrived = AstronautState(centre, turn @ arrived.rotation, arrived.velocity, arrived.spin)
        self._seen = arrived
        return arrived


def _half(deviation: float) -> float:
    """Return the standard deviation of one of two like parts of an error."""
    return deviation / math.sqrt(2.0)
