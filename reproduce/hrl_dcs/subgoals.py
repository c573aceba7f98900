"""Sub-goals of the rescue: the one metric space in which SGN commands and LLN obeys (section 2.2, point 2).

A sub-goal is a wanted place of the two arms in the robot's base frame: the positions of their ends and, per arm, the
rise of the plate, by which its end lies above its wrist. Plates that slope the wrong way let the body slide off, which
no position of an end can tell.

SGN's tanh-bounded outputs move both sub-goals together, then the two apart, from an anchor: the arms have to work
together on one body, and so SGN's exploration moves them. In process 1 the anchor is, for each arm, the entry before
the body while its end is high, and the target area once it is low, tips pointing down. In process 2 it lies over the
target area as it was when both arms had got under, and leads the arms up. A lift begins further under the body, with
tips a little up, and its anchors hold once the body has risen enough; where the body has slid off, they are the way in
again. A body face down wants other ways than one face up: lifted, it rolls off plates that do not slope more and come
back as they rise, and turned, it wants them to go on under it. With the targets as anchors from the beginning, an
untrained SGN sends the arms straight at them and onto the body, and learning starts in a trap (tried, see the training
log). All distances are in ``AnchorConfig``.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lunar_rescue.episode import OVER
from lunar_rescue.observation import SIZE, SLICES
from lunar_rescue.physics.robot import JOINTS
from lunar_rescue.rewards import TERMS
from reproduce.hrl_dcs.config import AnchorConfig
from reproduce.hrl_dcs.joint_step import joint_step, sideways_tilt
from reproduce.learning.actions import to_environment

Floats = NDArray[np.float32]

ENDS_SIZE = 6  # x, y, z of both arm ends
SUBGOAL_SIZE = ENDS_SIZE + 2  # and the rise of both plates
LLN_SIZE = SIZE + 2 * SUBGOAL_SIZE + 2 + JOINTS + 1

_APPROACH = [term.name for term in TERMS].index("approach")
#: Terms of the environment's reward that INR shares with it; the approach term is towards the sub-goal instead.
SHARED_TERMS = [index for index, term in enumerate(TERMS) if not term.once and index != _APPROACH]
#: Terms that come once an episode, of which INR has a share.
MILESTONES = [index for index, term in enumerate(TERMS) if term.once]

_END_A, _END_B = (slice(SLICES[arm].start + 15, SLICES[arm].start + 18) for arm in ("P_A", "P_B"))
_AHEAD = np.array([1.0, 0.0, 0.0] * 2, np.float32)
_UP = np.array([0.0, 0.0, 1.0] * 2, np.float32)
_UP_A, _UP_B = SLICES["P_A"].start + 20, SLICES["P_B"].start + 20  # height of the unit vector along a plate
_TARGETS = slice(SLICES["P_G"].start, SLICES["P_G"].start + 6)
_TO_ENTRIES = slice(SLICES["P_G"].start + 12, SLICES["P_G"].start + 18)
_LIFT = SLICES["I"].start
_PROCESS_2 = SLICES["phase"].start
_CENTRE_Z = SLICES["P_P"].start + 2
_FRONT_Z = SLICES["P_P"].start + 5


def arm_ends(observations: Floats) -> Floats:
    """Return the two arm ends from flat observations (n, SIZE), as (n, 6) [m]."""
    return np.concatenate([observations[:, _END_A], observations[:, _END_B]], axis=1)


def achieved(observations: Floats, rise: float) -> Floats:
    """Return where the arms are in the space of sub-goals (n, SUBGOAL_SIZE) [m]; a vertical plate rises by ``rise``."""
    return np.concatenate([arm_ends(observations), rise * observations[:, [_UP_A, _UP_B]]], axis=1)


def targets(observations: Floats) -> Floats:
    """Return the two target areas P_G, (n, 6) [m]."""
    return observations[:, _TARGETS]


def entries(observations: Floats) -> Floats:
    """Return the two entries before the body, (n, 6) [m]."""
    return observations[:, _TO_ENTRIES] + arm_ends(observations)


def next_points(observations: Floats) -> Floats:
    """Return for each arm the entry while its end is high, the target area once it is low, (n, 6) [m]."""
    ends, goals = arm_ends(observations), targets(observations)
    high = ends[:, [2, 5]] > goals[:, [2, 5]] + OVER
    return np.where(np.repeat(high, 3, axis=1), entries(observations), goals)


def slipped(observations: Floats, anchors: AnchorConfig) -> NDArray[np.bool_]:
    """Return whether a body that is to be lifted has slid off an arm, (n,)."""
    ends = arm_ends(observations).reshape(-1, 2, 3)
    way = ends - targets(observations).reshape(-1, 2, 3)
    off = (np.linalg.norm(way, axis=2) > anchors.slipped_away) | (way[:, :, 2] > anchors.slipped_above)
    return off.any(axis=1) & (observations[:, _LIFT] > 0.5)


class RescueGoals:
    """Sub-goals of several rescues, as ``reproduce.hrl_dcs.goals.Goals``: where they are measured from, and INR."""

    outputs, size, distance_count, view_size, actions = SUBGOAL_SIZE, SUBGOAL_SIZE, 2, LLN_SIZE, JOINTS

    def __init__(self, count: int, anchors: AnchorConfig, milestone_share: float = 0.0) -> None:
        """Begin with nothing known; where a trained policy acts, ``milestone_share``, a weight in INR, is of no use."""
        self.config, self._milestone_share = anchors, milestone_share
        # Of a lift and a turn, of a body face up and face down each.
        ways = (anchors.lift, anchors.lift_face_down, anchors.turn, anchors.turn_face_down)
        self._tips = np.array([(way.rise, way.final_rise) for way in ways], np.float32)
        self._further = np.array([(way.further, way.final_further) for way in ways], np.float32)
        self._places = np.zeros((count, ENDS_SIZE), np.float32)  # of the anchors
        self._under = np.zeros((count, ENDS_SIZE), np.float32)  # target areas when both arms had got under
        self._centre = np.zeros(count, np.float32)  # height of the centre of gravity when the episode began
        self._face_down = np.zeros(count, bool)
        self._waited = np.zeros(count, np.int64)
        self._ends = np.zeros((count, ENDS_SIZE), np.float32)
        self._rises = np.zeros(count, np.float32)
        self._carried = np.zeros(count, bool)

    def update(self, observations: Floats, starts: NDArray[np.bool_]) -> None:
        """Follow the way in during process 1, and again where the body slid off; else lead the arms up."""
        a = self.config
        self._centre[starts] = observations[starts, _CENTRE_Z]
        self._face_down[starts] = observations[starts, _FRONT_Z] < a.face_down_below
        lifts = observations[:, _LIFT] > 0.5
        kind = 2 * ~lifts + self._face_down
        carries = (observations[:, _PROCESS_2] > 0.5) & ~slipped(observations, a)
        begins = carries & (starts | ~self._carried)
        self._under[begins] = targets(observations)[begins]
        self._waited[begins] = 0
        self._ends = arm_ends(observations)
        moved = self._ends - self._under
        raised = moved[:, [2, 5]].mean(axis=1)
        on = np.clip((raised - a.rising_from) / (a.rising_to - a.rising_from), 0.0, 1.0)
        near = np.where(self._face_down, a.in_place_face_down, a.in_place)
        short = self._further[kind, 0] - moved[:, [0, 3]].min(axis=1) > near
        waits = carries & lifts & short & (raised < a.raised) & (self._waited < a.patience)
        self._waited += waits
        missing = a.wanted_rise - (observations[:, _CENTRE_Z] - self._centre)
        led = np.where(lifts, raised + np.clip(missing, -a.lowered, a.lead), np.minimum(raised + a.lead, a.highest))
        up = np.where(waits, 0.0, led)
        further, tips = (t[kind, 0] + on * (t[kind, 1] - t[kind, 0]) for t in (self._further, self._tips))
        over = self._under + further[:, None] * _AHEAD + up[:, None] * _UP
        self._places = np.where(carries[:, None], over, next_points(observations)).astype(np.float32)
        self._rises = np.where(carries, tips, a.rise_in).astype(np.float32)
        self._carried = carries

    def subgoals(self, outputs: Floats) -> Floats:
        """Return the sub-goals (n, SUBGOAL_SIZE) [m] that SGN's outputs (n, SUBGOAL_SIZE) in [-1, 1] command."""
        a, moved = self.config, np.clip(outputs, -1.0, 1.0)
        reach = np.where(self._carried, a.reach_carrying, a.reach_in).astype(np.float32)[:, None]
        ends = _both(reach * moved[:, :3], a.apart * moved[:, 3:ENDS_SIZE])
        rises = _both(a.rise * moved[:, ENDS_SIZE:-1], a.rise_apart * moved[:, -1:])
        way = (self._places + ends - self._ends).reshape(-1, 2, 3)
        way *= np.minimum(1.0, a.stride / np.maximum(np.linalg.norm(way, axis=2, keepdims=True), 1e-6))
        places = self._ends + way.reshape(-1, ENDS_SIZE)
        return np.concatenate([places, self._rises[:, None] + rises], axis=1).astype(np.float32)

    def distances(self, observations: Floats, subgoals: Floats) -> Floats:
        """Return how far each arm is from its sub-goal, over end, rise and a plate level across, (n, 2) [m]."""
        way = achieved(observations, self.config.rise) - subgoals
        ends = way[:, :ENDS_SIZE].reshape(-1, 2, 3)
        squares: Floats = np.einsum("nak,nak->na", ends, ends) + way[:, ENDS_SIZE:] ** 2
        return np.sqrt(squares + sideways_tilt(observations, self.config.level) ** 2)

    def view(self, observations: Floats, subgoals: Floats, remaining: Floats) -> Floats:
        """Return what LLN sees: s_t (with a_{t-1}), the sub-goal, the way to it and the share of N steps left.

        The way is there twice, in metres and in joint angles, see ``reproduce.hrl_dcs.joint_step``: (n, LLN_SIZE).
        """
        way = subgoals - achieved(observations, self.config.rise)
        tilt, steps = sideways_tilt(observations, self.config.level), joint_step(observations, way, self.config)
        seen = [observations, subgoals, way, tilt, steps, remaining[:, None]]
        return np.concatenate(seen, axis=1).astype(np.float32)

    def shared_reward(self, venv: Any, observations: Floats) -> Floats:
        """Return obstacle avoidance, joint motion and a share of what comes once an episode, (n,)."""
        terms: Floats = venv.terms
        shared: Floats = terms[:, SHARED_TERMS].sum(axis=1)
        return shared + self._milestone_share * terms[:, MILESTONES].sum(axis=1)

    def actions_of(self, observations: Floats, outputs: Floats) -> Floats:
        """Return Eq. 3's actions (n, JOINTS) for LLN's outputs (n, JOINTS)."""
        return to_environment(observations, outputs)


def _both(common: Floats, apart: Floats) -> Floats:
    return np.concatenate([common + apart, common - apart], axis=1)
