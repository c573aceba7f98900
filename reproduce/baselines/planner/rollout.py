"""Try a plan out in an environment: follow a joint path until both arms are under, then one through way-points."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lunar_rescue import LunarRescueEnv, Scene
from lunar_rescue.physics.robot import JOINTS
from reproduce.baselines.planner.rrt import resample
from reproduce.baselines.scripted import Variant

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

    def along(self, path: Array, under: int) -> Trial:
        """Follow set-points (m, 11) [rad] that led to a rescue, from those nearest to where the prefix has led.

        The first ``under`` of them brought both arms under the body; they are left out where both have been there.
        """
        self._begin()
        self._follow(path[:under], anywhere=True)
        if self._under is not None:
            self._hold(Track(path[under - 1 :], self._angles))
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

    def _follow(self, path: Array, anywhere: bool = False) -> None:
        """Aim a little ahead on the path until both arms are under, or nothing moves any more at its end.

        The path begins where the arms are; ``anywhere`` says that they may be anywhere beside it.
        """
        track, waited = Track(path, self._angles if anywhere else None), 0
        while not self._done and self._under is None and waited < SETTLE:
            self._aim(track)
            waited += track.at_end

    def _pass_through(self, variant: Variant, targets: Array) -> None:
        """Go through way-points on straight lines between their joint angles, and hold the last one.

        No clock tells when to go on, so what a learner should do follows from where the arms are, not from how long
        ago they came there: waits at way-points cannot be imitated (see the training log).
        """
        robot, points = self._env.robot, [self._angles.copy()]
        for point in variant:
            points.append(robot.joint_targets(robot.action_for(point.joints(targets, points[-1]))))
        self._hold(Track(np.array(points)))

    def _hold(self, track: Track) -> None:
        """Follow a path to the episode's end."""
        while not self._done:
            self._aim(track)

    def _aim(self, track: Track) -> None:
        self._step(self._env.robot.action_for(track.aim(self._angles)))


class Track:
    """A joint path that is followed by aiming a little ahead, so that all joints keep to it.

    Joints are limited one by one, and would otherwise arrive one after the other.
    """

    def __init__(self, path: Array, angles: Array | None = None) -> None:
        """Follow a path (m, 11) [rad] from its beginning, or from the point nearest to the joints (11,) [rad]."""
        self._points = resample(path, SPACING)
        self._at = 0 if angles is None else int(self._distances(self._points, angles).argmin())
        self.at_end = False  # whether the last aim was the path's end

    def aim(self, angles: Array) -> Array:
        """Return the joints (11,) [rad] to ask for where the joints are at (11,) [rad]."""
        self._at += int(self._distances(self._points[self._at : self._at + WINDOW], angles).argmin())
        aim = min(self._at + AHEAD, len(self._points) - 1)
        self.at_end = aim == len(self._points) - 1
        target: Array = self._points[aim]
        return target

    @staticmethod
    def _distances(points: Array, angles: Array) -> Array:
        distances: Array = np.abs(points - angles).max(axis=1)
        return distances
