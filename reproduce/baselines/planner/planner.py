"""A whole rescue, planned with full knowledge and tried out in a copy of the environment before it is done."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import cycle, islice

import numpy as np
from numpy.typing import NDArray

from lunar_rescue import LunarRescueEnv, Scene
from reproduce.baselines.planner.approach import ApproachPlanner
from reproduce.baselines.planner.collision import CollisionChecker
from reproduce.baselines.planner.rollout import Rollout, Trial
from reproduce.baselines.planner.variants import kind, vary
from reproduce.baselines.way_points import VARIANTS as VARIANTS_FILE
from reproduce.baselines.way_points import Variant, load_way_points
from reproduce.storage.errors import UserError

APPROACHES = 8  # ways tried out, at most
VARIANTS = 40  # lifts or turns tried out, at most
OTHER_WAY_AFTER = 8  # variants, before a second way under the body is looked for


@dataclass(frozen=True)
class Plan:
    """What to do in one scene, and how it was found.

    Attributes:
        actions: Actions (steps, 11) in [-1, 1].
        under: Whether both arms came under the body when it was tried out.
        rescued: Whether the rescue succeeded when it was tried out.
        first_under: Whether the first way that the collision check let pass did, without another look.
        first_rescued: Whether the first way with the first variant succeeded.
        way: How the way under the body was found: ``"straight"``, ``"rrt"`` or ``"none"``.
        ways_tried: Ways tried out.
        variants_tried: Lifts or turns tried out.
        variant: Which one was right, from 0; -1 for none. Those past the file's end were drawn for the scene.
        seconds: Time taken to plan, trials included.
    """

    actions: NDArray[np.float32]
    under: bool
    rescued: bool
    first_under: bool
    first_rescued: bool
    way: str
    ways_tried: int
    variants_tried: int
    variant: int
    seconds: float


class RescuePlanner:
    """Plans scenes one after the other; the same scene gets the same plan."""

    def __init__(self, variants: int = VARIANTS, approaches: int = APPROACHES) -> None:
        """Set the caps on what is tried out; the two simulations are made with the first scene.

        Raises:
            UserError: On a cap below 1.
        """
        for name, value in (("variants", variants), ("approaches", approaches)):
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise UserError(f"{name}: expected an integer >= 1, got {value!r}")
        self._variants, self._approaches = variants, approaches
        self._env: LunarRescueEnv | None = None
        self._checker: CollisionChecker | None = None

    def close(self) -> None:
        """Disconnect from the simulations."""
        if self._env is not None and self._checker is not None:
            self._env.close()
            self._checker.close()
        self._env = self._checker = None

    def plan(self, scene: Scene) -> Plan:
        """Plan a scene.

        Args:
            scene: Any scene.

        Returns:
            The first plan that succeeded, or the one that came furthest.
        """
        begun = time.monotonic()
        if self._env is None or self._checker is None:
            self._env, self._checker = LunarRescueEnv(), CollisionChecker()
        self._env.reset_flat(options={"scene": scene})
        self._checker.set_scene(scene)
        # A negative seed marks a scene that was made by hand.
        approach = ApproachPlanner(self._checker, self._env, np.random.default_rng(abs(scene.seed)))
        rollout = Rollout(self._env, scene)
        search = _Search(approach, rollout, self._approaches)
        first = search.next_under()
        best, way, tried, right = search.furthest(), "none", 0, -1
        if first is not None:
            under = [first]
            (best, way) = first
            for index, variant in enumerate(islice(_variants(scene), self._variants)):
                if index and index % OTHER_WAY_AFTER == 0:
                    under += filter(None, [search.next_under()])
                # The first way first; when the likeliest variants have failed on it, each way in turn.
                begin, found = under[(index // OTHER_WAY_AFTER) % len(under)]
                trial = rollout.rescue(begin, variant, approach.targets)
                tried += 1
                if trial.rescued:
                    best, way, right = trial, found, index
                    break
        return Plan(
            actions=best.actions,
            under=best.under is not None,
            rescued=best.rescued,
            first_under=search.first_under,
            first_rescued=search.first_under and right == 0,
            way=way,
            ways_tried=search.tried,
            variants_tried=tried,
            variant=right,
            seconds=time.monotonic() - begun,
        )


class _Search:
    """Ways for one scene, tried out one after the other."""

    def __init__(self, approach: ApproachPlanner, rollout: Rollout, most: int) -> None:
        self._ways, self._rollout = islice(approach.ways(), most), rollout
        self._failed: list[Trial] = []
        self.tried = 0
        self.first_under = False

    def next_under(self) -> tuple[Trial, str] | None:
        """The next way that gets both arms under and how it was found, or None when there are no more."""
        for way in self._ways:
            trial = self._rollout.approach(way.path)
            self.tried += 1
            if trial.under is not None:
                self.first_under |= self.tried == 1
                return trial, way.found
            self._failed.append(trial)
        return None

    def furthest(self) -> Trial:
        """Something to do where nothing succeeds: a way that failed, or to stand still."""
        still = Trial(np.zeros((1, 11), dtype=np.float32), None, False, None)
        return self._failed[0] if self._failed else still


def _variants(scene: Scene) -> Iterator[Variant]:
    """Variants of the file, then others near them, drawn for the scene."""
    name = kind(scene)
    listed = load_way_points(VARIANTS_FILE).get(name, ())
    if not listed:
        raise UserError(f"planner: no variants for {name}")
    yield from listed
    rng = np.random.default_rng([abs(scene.seed), 2])
    for variant in cycle(listed):
        yield vary(variant, rng)
