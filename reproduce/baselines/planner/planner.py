"""`planner`: plans a whole rescue with full knowledge, trying it out in a copy of the simulator before it is done."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import cycle, islice

import numpy as np
from numpy.typing import NDArray

from lunar_rescue import LunarRescueEnv, Scene
from lunar_rescue.physics.engines import DEFAULT
from lunar_rescue.physics.robot import JOINTS
from lunar_rescue.physics.solver import SolverSettings
from reproduce.baselines.planner.approach import ApproachPlanner, CollisionChecker, Way
from reproduce.baselines.planner.rollout import Noise, Rollout, Trial
from reproduce.baselines.scripted import VARIANTS as VARIANTS_FILE
from reproduce.baselines.scripted import Variant, kind, load_way_points, vary
from reproduce.learning.policy import Actions, Observations, Policy
from reproduce.storage.errors import UserError

APPROACHES = 8  # ways tried out, at most
VARIANTS = 40  # lifts or turns tried out, at most
OTHER_WAY_AFTER = 8  # variants, before a second way under the body is looked for


Array = NDArray[np.float64]


@dataclass(frozen=True)
class Plan:
    """What to do in one scene, and how it was found."""

    actions: NDArray[np.float32]  # actions (steps, 11) in [-1, 1]
    under: bool  # whether both arms came under the body when it was tried out
    rescued: bool  # whether the rescue succeeded when it was tried out
    first_under: bool  # whether the first way that the collision check let pass did, without another look
    first_rescued: bool  # whether the first way with the first variant succeeded
    way: str  # how the way under the body was found: ``"straight"``, ``"rrt"`` or ``"none"``
    ways_tried: int  # ways tried out
    variants_tried: int  # lifts or turns tried out
    variant: int  # which one was right, from 0; -1 for none. Those past the file's end were drawn for the scene
    seconds: float  # time taken to plan, trials included
    path: Array | None = None  # joint path (m, 11) [rad] that it followed until both arms were under
    points: Variant | None = None  # way-points of the lift or turn that succeeded
    targets: Array | None = None  # the two targets as first seen, in the base frame (2, 3) [m]


class RescuePlanner:
    """Plan scenes one after the other; the same scene gets the same plan."""

    def __init__(
        self,
        variants: int = VARIANTS,
        approaches: int = APPROACHES,
        solver: SolverSettings | None = None,
        simulator: str = DEFAULT,
    ) -> None:
        """Set the caps, at least 1, on what is tried out; the two simulations are started with the first scene.

        Plans are tried out in ``simulator``; ways are checked for collision in PyBullet, whichever that is.
        """
        for name, value in (("variants", variants), ("approaches", approaches)):
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise UserError(f"{name}: expected an integer >= 1, got {value!r}")
        self._variants, self._approaches = variants, approaches
        self._make_env = partial(LunarRescueEnv, solver=solver, simulator=simulator)
        self._simulations: tuple[LunarRescueEnv, CollisionChecker] | None = None

    def close(self) -> None:
        """Disconnect from both simulations, which a next scene starts anew."""
        for simulation in self._simulations or ():
            simulation.close()
        self._simulations = None

    def plan(self, scene: Scene, prefix: Sequence[NDArray[np.float32]] = ()) -> Plan:
        """Return the first plan of a scene that succeeded, or the one that came furthest.

        ``prefix`` are actions (11,) that were taken already: the plan goes on from where they have led, and its actions
        begin with them.
        """
        begun = time.monotonic()
        search = _Search(*self._open(), scene, self._approaches, prefix)
        best, way, variant = search.rescue(self._variants)
        points = next(islice(_variants(scene), variant, None)) if variant >= 0 else None
        return Plan(
            actions=best.actions,
            under=best.under is not None,
            rescued=best.rescued,
            first_under=search.first_under,
            first_rescued=search.first_under and variant == 0,
            way=way.kind if way else "none",
            ways_tried=search.ways_tried,
            variants_tried=search.variants_tried,
            variant=variant,
            seconds=time.monotonic() - begun,
            path=way.path if way else None,
            points=points,
            targets=search.targets,
        )

    def disturbed(self, scene: Scene, plan: Plan, noise: Noise, prefix: Sequence[NDArray[np.float32]] = ()) -> Trial:
        """Do what was planned once more while noise moves the set-points, and return how that went."""
        if plan.points is None or plan.targets is None:
            raise UserError("planner: only a plan that succeeded can be done under noise")
        return Rollout(self._open()[0], scene, prefix, noise).whole(plan.path, plan.points, plan.targets)

    def _open(self) -> tuple[LunarRescueEnv, CollisionChecker]:
        if self._simulations is None:
            self._simulations = self._make_env(), CollisionChecker()
        return self._simulations


class _Search:
    """Ways and variants for one scene, tried out one after the other."""

    def __init__(
        self,
        env: LunarRescueEnv,
        checker: CollisionChecker,
        scene: Scene,
        most: int,
        prefix: Sequence[NDArray[np.float32]] = (),
    ) -> None:
        checker.set_scene(scene)
        env.reset_flat(options={"scene": scene})
        self.targets = env.episode.observer.to_base(env.episode.targets())
        self._scene, self._rollout, self._prefix = scene, Rollout(env, scene, prefix), prefix
        # A negative seed marks a scene that was made by hand.
        approach = ApproachPlanner(checker, env, np.random.default_rng(abs(scene.seed)))
        self._ways = islice(approach.ways(), most)
        self._failed: list[Trial] = []
        self.ways_tried = self.variants_tried = 0
        self.first_under = False

    def rescue(self, most: int) -> tuple[Trial, Way | None, int]:
        """Try out at most so many variants on the ways under the body.

        Returns the trial that succeeded or came furthest, its way under the body, and the index of the variant or -1.
        """
        begun = self._rollout.so_far() if self._prefix else None
        under: list[tuple[Trial, Way | None]]
        under = [(begun, None)] if begun and begun.under is not None else [*filter(None, [self._next_under()])]
        if not under:
            nothing = np.zeros((1, JOINTS), np.float32)  # to stand still, where no way was tried
            return (self._failed or [Trial(nothing, None, False, nothing)])[0], None, -1
        for index, variant in enumerate(islice(_variants(self._scene), most)):
            if index and index % OTHER_WAY_AFTER == 0:
                under += filter(None, [self._next_under()])
            # The first way first; when the likeliest variants have failed on it, each way in turn.
            begin, way = under[(index // OTHER_WAY_AFTER) % len(under)]
            trial = self._rollout.rescue(begin, variant, self.targets)
            self.variants_tried += 1
            if trial.rescued:
                return trial, way, index
        return *under[0], -1

    def _next_under(self) -> tuple[Trial, Way] | None:
        """Return the next way that gets both arms under and how that went, or None when there are no more."""
        for way in self._ways:
            trial = self._rollout.approach(way.path)
            self.ways_tried += 1
            if trial.under is not None:
                self.first_under |= self.ways_tried == 1
                return trial, way
            self._failed.append(trial)
        return None


def _variants(scene: Scene) -> Iterator[Variant]:
    """Yield the variants of the file, then others near them, drawn for the scene."""
    name = kind(scene)
    listed = load_way_points(VARIANTS_FILE).get(name, ())
    if not listed:
        raise UserError(f"{VARIANTS_FILE}: file of way-points: expected variants for {name!r}, got none")
    yield from listed
    rng = np.random.default_rng([abs(scene.seed), 2])
    for variant in cycle(listed):
        yield vary(variant, rng)


class PlannerPolicy(Policy):
    """Do what was planned for the scene, whatever is seen; one environment at a time."""

    def __init__(self, planner: RescuePlanner | None = None) -> None:
        """Plan with ``planner``, or one of its own."""
        self._planner = planner or RescuePlanner()
        self._step = 0
        self._plan: Plan | None = None
        self._scene: Scene | None = None  # that it was made for

    @property
    def plan(self) -> Plan:
        """The plan for the present episode; ``UserError`` where no scene was given yet."""
        if self._plan is None:
            raise UserError("planner: needs the scene before it can act; call prepare(scene)")
        return self._plan

    def plan_in(self, simulator: str) -> None:
        """Try plans out in another simulator from now on."""
        self._planner.close()
        self._planner, self._scene = RescuePlanner(simulator=simulator), None

    def prepare(self, scene: Scene) -> None:
        """Plan for the episode that is about to begin; the plan of the same scene as before is kept."""
        if scene != self._scene:
            self._plan, self._scene = self._planner.plan(scene), scene
        self._step = 0

    def act(self, observations: Observations, starts: NDArray[np.bool_]) -> Actions:
        """See ``Policy.act``; past its end, the plan's last action goes on."""
        actions = self.plan.actions
        if len(observations) != 1:
            raise UserError(f"planner: acts in one environment at a time, got observations of {len(observations)}")
        action = actions[min(self._step, len(actions) - 1)]
        self._step += 1
        return action[None].copy()
