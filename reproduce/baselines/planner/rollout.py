"""Try a plan out in an environment: follow a joint path until both arms are under, then way-points."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lunar_rescue import LunarRescueEnv, Scene
from lunar_rescue.physics.robot import JOINTS
from reproduce.baselines.planner.rrt import resample
from reproduce.baselines.scripted import ARRIVED, Variant

Array = NDArray[np.float64]
Actions = NDArray[np.float32]

SPACING = 0.02  # rad, between two points of the path that is followed
AHEAD = 8  # points; 0.16 rad ahead is as far as the set-point may run before the joints
WINDOW = 12  # points among which the nearest one is looked for
SETTLE = 10  # steps at the end of the path, before giving up


class Trial(NamedTuple):
    """How a plan went."""

    actions: Actions  # what was done (steps, 11)
    under: int | None  # after how many steps both arms were under, or None
    rescued: bool  # whether it succeeded
    wanted: Actions  # what the plan asked for (steps, 11), which noise made into ``actions``


@dataclass
class Noise:
    """What a plan's set-points are off by in each step: a first-order autoregression, in units of the action."""

    rng: np.random.Generator
    deviation: float  # standard deviation
    memory: float = 0.7  # share of the last step's that stays
    _now: Array | None = None

    def draw(self) -> Array:
        """Return the next step's (11,)."""
        fresh = self.rng.normal(0.0, self.deviation, JOINTS)
        self._now = fresh if self._now is None else self.memory * self._now + math.sqrt(1 - self.memory**2) * fresh
        return self._now


class Rollout:
    """Run plans for one scene in an environment, every one from the episode's beginning or a state on its way."""

    def __init__(
        self, env: LunarRescueEnv, scene: Scene, prefix: Sequence[NDArray[np.float32]] = (), noise: Noise | None = None
    ) -> None:
        """Use ``env`` until the next scene; plans go on from where ``prefix``, actions (11,) each, has led."""
        self._env, self._scene, self._prefix, self._noise = env, scene, prefix, noise
        self._begin()

    def approach(self, path: Array) -> Trial:
        """Follow a path (m, 11) [rad] until both arms are under."""
        self._begin()
        self._follow(path)
        return self._trial()

    def rescue(self, approach: Trial, variant: Variant, targets: Array) -> Trial:
        """Repeat an approach that got both arms under, then go through the way-points of a lift or turn.

        ``targets`` are the two as first seen, in the base frame (2, 3) [m].
        """
        self._begin()
        for action in approach.actions[len(self._prefix) :]:
            if self._done:
                break
            self._step(action)
        self._pass_through(variant, targets)
        return self._trial()

    def whole(self, path: Array | None, variant: Variant, targets: Array) -> Trial:
        """Follow a path (m, 11) [rad], where there is one, and go on with a lift or turn, looking at each step."""
        self._begin()
        if path is not None:
            self._follow(path)
        if self._under is not None:
            self._pass_through(variant, targets)
        return self._trial()

    def so_far(self) -> Trial:
        """Return where the prefix has led."""
        self._begin()
        return self._trial()

    # -- parts -------------------------------------------------------------------------------------------------------
    def _trial(self) -> Trial:
        return Trial(np.array(self._actions), self._under, self._rescued, np.array(self._wanted))

    def _begin(self) -> None:
        self._env.reset_flat(options={"scene": self._scene})
        self._actions: list[Actions] = []
        self._wanted: list[Actions] = []
        self._under: int | None = None
        self._rescued = self._done = False
        noise, self._noise = self._noise, None
        for action in self._prefix:
            self._step(action)
        self._noise = noise

    def _step(self, action: NDArray[np.floating]) -> None:
        # What is tried is what will be done: a policy's actions are single precision.
        wanted = single = np.asarray(action, dtype=np.float32)
        if self._noise:
            single = np.clip(wanted + self._noise.draw(), -1.0, 1.0).astype(np.float32)
        _, _, terminated, truncated, info = self._env.step_flat(single)
        self._actions.append(single)
        self._wanted.append(wanted)
        if info["both_arms_under"] and self._under is None:
            self._under = len(self._actions)
        self._done = terminated or truncated
        self._rescued = bool(info["is_success"])

    @property
    def _angles(self) -> Array:
        return self._env.episode.robot.angles

    def _follow(self, path: Array) -> None:
        """Aim a little ahead on the path, so that all joints keep to it although they are limited one by one."""
        points = resample(path, SPACING)
        at, waited = 0, 0
        while not self._done and self._under is None and waited < SETTLE:
            near = points[at : at + WINDOW]
            at += int(np.abs(near - self._angles).max(axis=1).argmin())
            aim = min(at + AHEAD, len(points) - 1)
            waited += aim == len(points) - 1
            self._step(self._env.robot.action_for(points[aim]))

    def _pass_through(self, variant: Variant, targets: Array) -> None:
        joints = self._angles.copy()
        for index, point in enumerate(variant):
            joints = point.joints(targets, joints)
            action = self._env.robot.action_for(joints)
            wanted = self._env.robot.joint_targets(action)
            left = point.patience
            while not self._done and (left > 0 or index == len(variant) - 1):
                begun = left < point.patience and index < len(variant) - 1
                if begun and np.all(np.abs(self._angles - wanted) < ARRIVED):
                    break
                self._step(action)
                left -= 1
