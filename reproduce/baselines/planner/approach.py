"""Process 1: joint paths that bring both plates under the body, by inverse kinematics and RRT-Connect.

The last part of every way is a straight slide in front of and then under the body, as nothing else fits there; it is
solved backwards from several goals for each arm, and RRT-Connect finds the way to where the slide begins.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice, pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lunar_rescue import LunarRescueEnv, Scene
from lunar_rescue.physics.kinematics import TIP, ArmChain, solve_arms
from lunar_rescue.physics.robot import ARM_JOINTS, ARMS, WAIST, Arm
from reproduce.baselines.planner.choices import Stance, load_choices
from reproduce.baselines.planner.rrt import connect, length, line_is_free, path_is_free, shortcut

Array = NDArray[np.float64]

ROCK_MARGIN = 0.015  # m, motors lag and sag a little on the way
BODY_TOUCH = 0.006  # m, the plates are 3 cm thick and slide in under a suit that yields to a light touch
GROUND_TOUCH = 0.010  # m, plates skim over loose regolith
REACHED = 0.03  # m, the kinematics may miss a goal by this; the target area is 0.10 m wide
BEFORE = 0.04  # m, the slide begins this far before the entry
TIP_HEIGHT = 0.016  # m, lowest middle of a plate's tip above the ground
#: Where the plates come down to where a slide begins: from so high above [m], so far back [m]; the likeliest first.
HOVERS = ((0.50, 0.05), (0.40, 0.0), (0.40, 0.15), (0.25, 0.0), (0.40, 0.30), (0.60, 0.15))
LOW = 0.04  # m, from so high above the slide plates go on where they came down further back
HOVER_SLOPE, HOVER_LEAN = 20.0, 8.0  # deg, there: slope, and waist further back
TIPS_FIRST = 6.0  # deg, tips point down by so much more where the slide begins
HEADINGS = (0.0, 0.5, 1.0)  # of slides, between the robot's own and straight into the body
SLIDE_STEPS = 5  # places along the slide, the goal included
PAIRS = 450  # of goals of the two arms, the likeliest ones
BEGINS = (0, 1, 2, 3)  # places of a slide from which on it may be free, the rest is for RRT-Connect
OPEN_TOUCH = 0.02  # m, how deep a way may lead into the body before the slide; a suit that is brushed does not move
CHECKS = 120_000  # collision checks for one scene, about 6 s; most need 500
LONGEST = 7.5  # rad, a longer way leaves no time for the second process


@dataclass(frozen=True)
class Effort:
    """How hard to look for a way."""

    # how far into the resting body a slide may lead [m], tried one after the other: a suit that lies close to
    # the ground gives way to a plate, which only trying out can tell
    touches: tuple[float, ...]
    draws: int  # draws of RRT-Connect for one way; without any only straight lines are tried
    slides: int  # slides of one stance for which a way is sought


#: One after the other: most scenes have a way in straight lines, a few need much.
EFFORTS = (
    Effort((BODY_TOUCH, 0.02), 0, 3),
    Effort((BODY_TOUCH, 0.02, 0.04, 0.07), 600, 4),
    Effort((BODY_TOUCH, 0.02, 0.04, 0.07), 4000, 12),
)


class Way(NamedTuple):
    """A joint path (m, 11) [rad] that brings both plates under the body, ``"straight"`` or found by ``"rrt"``."""

    path: Array
    kind: str


class Solved(NamedTuple):
    """Slides of one arm to all goals, with the waist at one stance."""

    places: Array  # wanted places of the end (n, SLIDE_STEPS, 3) [m]
    angles: Array  # of the arm there (n, SLIDE_STEPS, 5) [rad]
    misses: Array  # by how much the end misses its goal (n,) [m]


class Slide(NamedTuple):
    """A free slide of both arms, whole or from one of its places on."""

    path: Array  # joints (m, 11) [rad]
    begins: Array  # place of each end where it begins (2, 3) [m]


class CollisionChecker:
    """Hold robot, astronaut, ground and rocks of one scene, placed as at the start of an episode."""

    def __init__(self, env: LunarRescueEnv | None = None) -> None:
        """Build on an environment of its own, or on one that nobody steps."""
        self._env = env or LunarRescueEnv()
        self.body_touch = BODY_TOUCH  # how deep robot and resting astronaut may overlap [m]
        self.checks = 0  # configurations checked so far

    def set_scene(self, scene: Scene, margin: float = ROCK_MARGIN) -> None:
        """Place everything of a scene, with rocks ``margin`` [m] larger than they are."""
        self._env.reset_flat(options={"scene": scene})
        episode, simulation = self._env.episode, self._env.simulation
        self._astronaut = episode.astronaut.handle
        self._rocks = [*episode.rocks]
        for vertices in [rock.vertices() for rock in scene.rocks] if margin else []:
            outward = vertices - vertices.mean(axis=0)
            grown = vertices + margin * outward / np.linalg.norm(outward, axis=1, keepdims=True)
            self._rocks.append(simulation.add_hull(grown))
        # An environment may load a new robot at a reset.
        by_name = {row[1]: row[0] for row in simulation.joint_table(self._env.robot.handle)}
        names = [f"{arm.name}_{joint}" for arm in ARMS for joint in ARM_JOINTS] + ["waist"]
        self._joints = [by_name[name] for name in names]
        relief = simulation.relief
        self._grounds = [simulation.ground] + ([] if relief is None else [relief])

    def close(self) -> None:
        """Disconnect from the simulation; nothing can be checked afterwards."""
        self._env.close()

    def free(self, angles: Array) -> bool:
        """Whether the robot at these angles (11,) [rad] touches no rock, itself or, beyond a light touch, anything."""
        self.checks += 1
        robot, simulation = self._env.robot.handle, self._env.simulation
        simulation.reset_joints(robot, self._joints, angles)
        # The first question also detects the contacts that the later ones read.
        if simulation.penetration(robot, self._astronaut) > self.body_touch:
            return False
        if any(simulation.touching(robot, other) for other in (*self._rocks, robot)):
            return False
        return all(simulation.penetration(robot, ground) <= GROUND_TOUCH for ground in self._grounds)


class ApproachPlanner:
    """Find ways under the body for one scene, the likeliest first."""

    def __init__(self, checker: CollisionChecker, env: LunarRescueEnv, rng: np.random.Generator) -> None:
        """Plan for the episode that has just begun in ``env``, whose scene the checker has too."""
        self._checker, self._rng = checker, rng
        self._start = env.episode.robot.angles.copy()
        window = env.robot.initial - env.robot.window, env.robot.initial + env.robot.window
        self._lower = np.maximum(env.robot.lower, window[0]) + 1e-4
        self._upper = np.minimum(env.robot.upper, window[1]) - 1e-4
        to_base = env.episode.observer.to_base
        self.targets = to_base(env.episode.targets())
        ways = to_base(env.episode.entries()) - self.targets
        longest = float(np.linalg.norm(ways, axis=1).max())
        # How far the straight ways in lead to the left, as the robot stands askew [rad].
        askew = np.arctan2(-ways[:, 1], -ways[:, 0])
        self._headings = [np.array([share * angle for share in HEADINGS]) for angle in askew]
        #: How far before its goal a plate is at each place of a slide [m].
        self._backs = np.linspace(longest + BEFORE, 0.0, SLIDE_STEPS)
        choices = load_choices()
        self._stances = choices.leaning.stances(float(self.targets[:, 0].mean())) + choices.stances
        self._goals = choices.goals
        self._solved: dict[Stance, list[Solved]] = {}

    def ways(self) -> Iterator[Way]:
        """Yield ways that are free of collision, until the checks of a scene are used up."""
        end_of_checks = self._checker.checks + CHECKS
        tasks = ((effort, touch, stance) for effort in EFFORTS for touch in effort.touches for stance in self._stances)
        for effort, touch, stance in tasks:
            for slide in islice(self._slides(stance, touch), effort.slides):
                if self._checker.checks > end_of_checks:
                    return
                way = self._reach(slide, effort.draws)
                if way is not None and length(way.path) <= LONGEST:
                    yield way
                    break

    # -- slides ------------------------------------------------------------------------------------------------------
    def _slides(self, stance: Stance, touch: float) -> Iterator[Slide]:
        """Yield free slides of both arms to goals: whole, or their last part where something is in front."""
        free = self._checker.free
        # The waist at each place of the slide, (SLIDE_STEPS,) [rad].
        waists = np.clip(np.radians(stance.under - stance.lean * self._backs), self._lower[WAIST], self._upper[WAIST])
        if stance not in self._solved:
            self._solved[stance] = [
                self._solve(a, target, waists) for a, target in zip(ARMS, self.targets, strict=True)
            ]
        solved = self._solved[stance]
        good = [np.flatnonzero(one.misses < REACHED) for one in solved]
        # A pair of goals is as likely as its less likely one; its end is checked first, where most pairs fail.
        pairs = sorted(((i, j) for i in good[0] for j in good[1]), key=lambda p: (max(p), sum(p)))
        for i, j in pairs[:PAIRS]:
            path = np.column_stack([solved[0].angles[i], solved[1].angles[j], waists])
            self._checker.body_touch = touch
            ends = (k for k in BEGINS if all(map(free, path[k:][::-1])) and path_is_free(path[k:], free))
            begin = next(ends, None)
            # What comes before is in the open, where nothing needs to be touched.
            self._checker.body_touch = OPEN_TOUCH
            if begin is not None and free(path[begin]):
                yield Slide(path[begin:], np.array([solved[0].places[i, begin], solved[1].places[j, begin]]))

    def _solve(self, arm: Arm, target: Array, waists: Array) -> Solved:
        """Solve the slides to all goals."""
        headings, backs = self._headings[ARMS.index(arm)], self._backs
        goals, heading = [g for g in self._goals for _ in headings], np.tile(headings, len(self._goals))
        count = len(goals)
        turns = heading + arm.side * np.radians([goal.turn for goal in goals])
        ahead = np.column_stack([np.cos(turns), np.sin(turns), np.zeros(count)])
        aside = np.column_stack([-np.sin(heading), np.cos(heading), np.zeros(count)])
        ends = target + np.array([[g.ahead] for g in goals]) * np.column_stack([aside[:, 1], -aside[:, 0], aside[:, 2]])
        ends += np.array([[arm.side * g.aside] for g in goals]) * aside + np.array([[0.0, 0.0, g.up] for g in goals])
        slopes = np.array([goal.slope for goal in goals])
        places = [ends - back * ahead for back in backs]
        tilts = [slopes - TIPS_FIRST * back / backs[0] for back in backs]
        angles = self._hover(
            arm, places[0], float(waists[0]), HOVERS[0][0], np.tile(self._start[arm.joints], (count, 1))
        )
        rows = []
        for place, tilt, waist in zip(places, tilts, waists, strict=True):
            angles, misses = self._solve_low(arm, place, np.radians(tilt), np.full(count, waist), angles)
            rows.append(angles)
        return Solved(np.stack(places, axis=1), np.stack(rows, axis=1), misses)

    def _hover(self, arm: Arm, places: Array, waist: float, height: float, near: Array) -> Array:
        """Solve an arm's joints (n, 5) [rad] with its end above places (n, 3) [m], near joints (n, 5) [rad]."""
        count, slope = len(places), HOVER_SLOPE if height > LOW else 0.0
        slopes, waists = np.full(count, np.radians(slope)), np.full(count, self._leant_back(waist))
        return self._solve_low(arm, places + [0.0, 0.0, height], slopes, waists, near)[0]

    def _leant_back(self, waist: float) -> float:
        return max(waist - float(np.radians(HOVER_LEAN)), float(self._lower[WAIST]))

    def _both(self, slide: Slide, back: float, height: float, near: Array) -> Array:
        """Solve all joints (11,) [rad] with both ends above and behind where a slide begins, near other joints."""
        joints, waist = near.copy(), float(slide.path[0, WAIST])
        joints[WAIST] = self._leant_back(waist)
        for arm, place in zip(ARMS, slide.begins - [back, 0.0, 0.0], strict=True):
            joints[arm.joints] = self._hover(arm, place[None], waist, height, near[None, arm.joints])[0]
        return joints

    def _solve_low(self, arm: Arm, places: Array, slopes: Array, waists: Array, starts: Array) -> tuple[Array, Array]:
        """Solve as ``solve_arms`` does, then again with the ends so much higher that no tip is in the ground."""
        bounds = self._lower[arm.joints], self._upper[arm.joints]
        angles, misses = solve_arms(places, slopes, waists, arm.side, starts, *bounds)
        missing = np.maximum(0.0, TIP_HEIGHT - ArmChain(waists, angles).points[:, TIP, 2])
        if missing.any():
            higher = places + missing[:, None] * [0.0, 0.0, 1.0]
            angles, misses = solve_arms(higher, slopes, waists, arm.side, angles, *bounds)
        return angles, misses

    # -- the way to where the slide begins ---------------------------------------------------------------------------
    def _reach(self, slide: Slide, draws: int) -> Way | None:
        """Complete a slide by a way from the start to its beginning, or return None where none was found.

        Straight lines by way of a place above the beginning are tried first: they are much alike from scene to scene,
        and they are found much sooner.
        """
        free, begin = self._checker.free, slide.path[0]
        for height, back in HOVERS:
            points = [self._start, self._both(slide, back, height, self._start)]
            if back:
                points.append(self._both(slide, back, LOW, points[-1]))
            points.append(begin)
            if all(map(free, points[1:-1])) and all(line_is_free(a, b, free) for a, b in pairwise(points)):
                return Way(np.concatenate([points[:-1], slide.path]), "straight")
        if not draws:
            return None
        way = connect(self._start, begin, free, (self._lower, self._upper), self._rng, draws=draws)
        if way is None:
            return None
        return Way(np.concatenate([shortcut(way, free, self._rng), slide.path[1:]]), "rrt")
