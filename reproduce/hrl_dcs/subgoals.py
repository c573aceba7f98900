"""Sub-goals: the one metric space in which SGN commands and LLN obeys (section 2.2, point 2).

A sub-goal is a wanted place of the two arms in the robot's base frame: the positions of their ends and, per arm, the
rise of the plate, by which its end lies above its wrist. Plates that slope the wrong way let the body slide off, which
no position of an end can tell.

SGN's tanh-bounded output moves them from an anchor, the ends by at most ``REACH``. In process 1 the anchor is, for each
arm, the entry before the body while its end is high, and the target area once it is low, tips pointing down. In process
2 it lies over the target area as it was when both arms had got under, ``LEAD`` higher than the arms are now. A lift
begins further under the body, with tips a little up, and its anchors hold once the body has risen by ``WANTED_RISE``;
where the body has slid off, they are the way in again. A body face down wants other ways than one face up: lifted, it
rolls off plates that do not slope more and come back as they rise, and turned, it wants them to go on under it. No
sub-goal lies further than ``STRIDE`` from its arm. With the targets as anchors from the beginning, an untrained SGN
sends the arms straight at them and onto the body, and learning starts in a trap (tried, see the training log).

What the numbers mean is a choice, ``MEANINGS``: a displacement of each arm's sub-goal, or one of both together and one
of the two apart. The arms have to work together on one body, and with the second SGN's exploration moves them so.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lunar_rescue.episode import OVER
from lunar_rescue.observation import SIZE, SLICES
from lunar_rescue.physics.robot import JOINTS
from reproduce.hrl_dcs.joint_step import joint_step, sideways_tilt

Floats = NDArray[np.float32]

ENDS_SIZE = 6  # two arm ends in three dimensions
SUBGOAL_SIZE = ENDS_SIZE + 2  # and the rise of two plates
#: Furthest that SGN moves a sub-goal from its anchor along each axis, or both together, in process 1 and 2 [m]. In
#: process 1 anchors lie on the way and corrections are small; in process 2 the body has to be taken along.
REACH = (0.25, 0.3)
#: Furthest that it moves either of them away from their common displacement, along each axis [m].
APART = 0.12
RISE = 0.15  # m, what a slope counts beside positions: the rise of so much of a plate
RISE_APART = 0.05  # m, furthest that one plate's rise moves away from that of both together
TIPS_DOWN = -0.052  # m, rise of the plates in the anchors of process 1: such tips (20 deg) slide in, level ones push
#: In those of process 2 the rise of the plates, from where nothing is raised yet to where it is, and how much further
#: under the body the ends are, likewise [m]. A body slides off level plates.
TIPS = {"lift": (0.015, 0.015), "lift face down": (0.015, 0.105), "turn": (0.0, 0.0), "turn face down": (0.03, 0.03)}
FURTHER = {"lift": (0.10, 0.10), "lift face down": (0.15, 0.0), "turn": (0.0, 0.0), "turn face down": (0.0, 0.30)}
BETWEEN = (0.05, 0.30)  # m, raised by so much, anchors are on the way from the first to the second
IN_PLACE = (0.05, 0.08)  # m, near enough to the first for being raised, a body that is face up and one face down
PATIENCE = 15  # steps to wait for that
FACE_DOWN = -0.3  # a body is when the upward part of its front is below this as the episode begins
RAISED = 0.15  # m, ends so far above the target areas as they were no longer need to get there first
#: The anchors of process 2 lead the arms, which stand at the same height, by so much: what is raised fast flies off on
#: the Moon (1 m/s is 0.3 m up), so no anchor waits at transport height [m].
LEAD = 0.10
HIGHEST = 0.50  # m, and lie no higher than this over the target areas as they were, where a body is turned
WANTED_RISE = 0.30  # m, where it is lifted they lead until its centre of gravity has risen so much, and then hold
#: No sub-goal lies further than this from its arm's end when it is set, in training and when a trained policy acts:
#: within reach of N steps, and no faster on the average than 0.6 m/s. Faster arms push a body face down away [m].
STRIDE = (0.30, 0.25)
#: Where a lifted body is higher than wanted, anchors go down by at most so much, likewise. Where they hold, a bias of
#: SGN's upwards adds up; the policy that was trained with them going down was no better (see the training log, 33) [m].
LOWERED = (0.0, 0.10)
SLIPPED = (0.40, 0.30)  # m, an end further than this from its target area, or above it, carries no body
MEANINGS = ("each", "together")
LLN_SIZE = SIZE + 2 * SUBGOAL_SIZE + 2 + JOINTS + 1

_END_A = slice(SLICES["P_A"].start + 15, SLICES["P_A"].start + 18)
_END_B = slice(SLICES["P_B"].start + 15, SLICES["P_B"].start + 18)
_AHEAD = np.array([1.0, 0.0, 0.0] * 2, np.float32)
_UP = np.array([0.0, 0.0, 1.0] * 2, np.float32)
_UP_A, _UP_B = SLICES["P_A"].start + 20, SLICES["P_B"].start + 20  # height of the unit vector along a plate
_TARGETS = slice(SLICES["P_G"].start, SLICES["P_G"].start + 6)
_TO_ENTRIES = slice(SLICES["P_G"].start + 12, SLICES["P_G"].start + 18)
_LIFT = SLICES["I"].start
_PROCESS_2 = SLICES["phase"].start
_CENTRE_Z = SLICES["P_P"].start + 2
_FRONT_Z = SLICES["P_P"].start + 5
_KINDS = tuple(TIPS)
_TIPS, _FURTHER = (np.array([table[kind] for kind in _KINDS], np.float32) for table in (TIPS, FURTHER))


def arm_ends(observations: Floats) -> Floats:
    """The two arm ends from flat observations (n, SIZE), as (n, 6) [m]."""
    return np.concatenate([observations[:, _END_A], observations[:, _END_B]], axis=1)


def achieved(observations: Floats) -> Floats:
    """Where the arms are in the space of sub-goals: ends, then the rise of each plate, (n, SUBGOAL_SIZE) [m]."""
    return np.concatenate([arm_ends(observations), RISE * observations[:, [_UP_A, _UP_B]]], axis=1)


def distances(observations: Floats, subgoals: Floats) -> Floats:
    """Of each arm to its sub-goal, over end, rise and a plate level across, (n, 2) [m]."""
    way = achieved(observations) - subgoals
    squares: Floats = np.einsum("nak,nak->na", *[way[:, :ENDS_SIZE].reshape(-1, 2, 3)] * 2) + way[:, ENDS_SIZE:] ** 2
    return np.sqrt(squares + sideways_tilt(observations) ** 2)


def targets(observations: Floats) -> Floats:
    """The two target areas P_G, (n, 6) [m]."""
    return observations[:, _TARGETS]


def entries(observations: Floats) -> Floats:
    """The entries before the body, (n, 6) [m]."""
    return observations[:, _TO_ENTRIES] + arm_ends(observations)


def next_points(observations: Floats) -> Floats:
    """For each arm the entry while its end is high, the target area once it is low, (n, 6) [m]."""
    ends, goals = arm_ends(observations), targets(observations)
    high = ends[:, [2, 5]] > goals[:, [2, 5]] + OVER
    return np.where(np.repeat(high, 3, axis=1), entries(observations), goals)


def in_process_2(observations: Floats) -> NDArray[np.bool_]:
    """Whether both arms have got under, (n,)."""
    return observations[:, _PROCESS_2] > 0.5


def to_be_lifted(observations: Floats) -> NDArray[np.bool_]:
    """Whether the task is a lift, (n,)."""
    return observations[:, _LIFT] > 0.5


def slipped(observations: Floats) -> NDArray[np.bool_]:
    """Whether a body that is to be lifted has slid off an arm, (n,)."""
    ends = arm_ends(observations).reshape(-1, 2, 3)
    way = ends - targets(observations).reshape(-1, 2, 3)
    off = (np.linalg.norm(way, axis=2) > SLIPPED[0]) | (way[:, :, 2] > SLIPPED[1])
    return off.any(axis=1) & to_be_lifted(observations)


def lln_observations(observations: Floats, subgoals: Floats, remaining: Floats) -> Floats:
    """What LLN sees: s_t (with a_{t-1}), the sub-goal, the way to it and the share of N steps left, (n, LLN_SIZE).

    The way is there twice, in metres and in joint angles, see ``reproduce.hrl_dcs.joint_step``.
    """
    way = subgoals - achieved(observations)
    steps = joint_step(observations, way, RISE)
    seen = [observations, subgoals, way, sideways_tilt(observations), steps, remaining[:, None]]
    return np.concatenate(seen, axis=1).astype(np.float32)


class Anchors:
    """Where sub-goals are measured from, for several environments."""

    def __init__(self, count: int, meaning: str, acting: bool = False) -> None:
        """Start with nothing known.

        Args:
            count: Environments.
            meaning: One of ``MEANINGS``.
            acting: Whether a trained policy acts, with more care than in training.
        """
        if meaning not in MEANINGS:
            raise ValueError(f"subgoals: expected one of {MEANINGS}, got {meaning!r}")
        self._together = meaning == "together"
        self._stride, self._lowered = STRIDE[acting], LOWERED[acting]
        self._kept = np.zeros((count, ENDS_SIZE), np.float32)
        self._under = np.zeros((count, ENDS_SIZE), np.float32)
        self._centre = np.zeros(count, np.float32)  # height of the centre of gravity when the episode began
        self._face_down = np.zeros(count, bool)
        self._waited = np.zeros(count, np.int64)
        self._ends = np.zeros((count, ENDS_SIZE), np.float32)
        self._rises = np.zeros(count, np.float32)
        self._carried = np.zeros(count, bool)

    def update(self, observations: Floats, starts: NDArray[np.bool_]) -> None:
        """Follow the way in during process 1, and again where the body slid off; else lead the arms up."""
        self._centre[starts] = observations[starts, _CENTRE_Z]
        self._face_down[starts] = observations[starts, _FRONT_Z] < FACE_DOWN
        lifts = to_be_lifted(observations)
        kind = 2 * ~lifts + self._face_down  # as in _KINDS
        carries = in_process_2(observations) & ~slipped(observations)
        begins = carries & (starts | ~self._carried)
        self._under[begins] = targets(observations)[begins]
        self._waited[begins] = 0
        self._ends = arm_ends(observations)
        moved = self._ends - self._under
        raised = moved[:, [2, 5]].mean(axis=1)
        on = np.clip((raised - BETWEEN[0]) / (BETWEEN[1] - BETWEEN[0]), 0.0, 1.0)
        short = _FURTHER[kind, 0] - moved[:, [0, 3]].min(axis=1) > np.where(self._face_down, IN_PLACE[1], IN_PLACE[0])
        waits = carries & lifts & short & (raised < RAISED) & (self._waited < PATIENCE)
        self._waited += waits
        missing = WANTED_RISE - (observations[:, _CENTRE_Z] - self._centre)
        led = np.where(lifts, raised + np.clip(missing, -self._lowered, LEAD), np.minimum(raised + LEAD, HIGHEST))
        up = np.where(waits, 0.0, led)
        further, tips = (table[kind, 0] + on * (table[kind, 1] - table[kind, 0]) for table in (_FURTHER, _TIPS))
        over = self._under + further[:, None] * _AHEAD + up[:, None] * _UP
        self._kept = np.where(carries[:, None], over, next_points(observations)).astype(np.float32)
        self._rises = np.where(carries, tips, TIPS_DOWN).astype(np.float32)
        self._carried = carries

    def subgoals(self, outputs: Floats) -> Floats:
        """Sub-goals (n, SUBGOAL_SIZE) [m] commanded by SGN's outputs (n, SUBGOAL_SIZE) in [-1, 1]."""
        moved: Floats = np.clip(outputs, -1.0, 1.0)
        ends, rises = moved[:, :ENDS_SIZE], moved[:, ENDS_SIZE:]
        reach = np.where(self._carried, REACH[1], REACH[0]).astype(np.float32)[:, None]
        if self._together:
            ends = np.concatenate(_both(reach * ends[:, :3], APART * ends[:, 3:]), axis=1)
            rises = np.concatenate(_both(RISE * rises[:, :1], RISE_APART * rises[:, 1:]), axis=1)
        else:
            ends, rises = reach * ends, RISE * rises
        way = (self._kept + ends - self._ends).reshape(-1, 2, 3)
        way *= np.minimum(1.0, self._stride / np.maximum(np.linalg.norm(way, axis=2, keepdims=True), 1e-6))
        places = self._ends + way.reshape(-1, ENDS_SIZE)
        return np.concatenate([places, self._rises[:, None] + rises], axis=1).astype(np.float32)


def _both(common: Floats, apart: Floats) -> list[Floats]:
    return [common + apart, common - apart]
