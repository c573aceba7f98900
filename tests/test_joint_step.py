"""The way to a sub-goal in joint angles: against numerical changes, and followed to its end."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from lunar_rescue.observation import SIZE, SLICES
from lunar_rescue.physics.kinematics import END, ArmChain
from lunar_rescue.physics.robot import ARM_WINDOW, ARMS, INITIAL_ARM, JOINTS, WAIST, WAIST_WINDOW
from reproduce.hrl_dcs.config import GoalConfig
from reproduce.hrl_dcs.joint_step import joint_step
from reproduce.hrl_dcs.subgoals import SUBGOAL_SIZE, arm_ends
from reproduce.learning.actions import LARGEST_CHANGE, LOWER, UPPER
from reproduce.learning.mirror import mirror_actions, mirror_observations

Array = NDArray[np.float64]
CONFIG = GoalConfig()


def test_changes_are_those_of_the_arm() -> None:
    rng = np.random.default_rng(0)
    waist, q = rng.uniform(-0.5, 0.9, 5), rng.uniform(-1.0, 1.0, (5, 5)) + [0, 0, 0, 1.5, 0]
    chain = ArmChain(waist, q)
    changes = chain.jacobian()
    assert changes.shape == (5, 5, 6)
    small = 1e-6
    for joint in range(6):
        d = small * np.eye(6)[joint]
        ahead, behind = (ArmChain(waist + sign * d[5], q + sign * d[:5]).pose for sign in (1, -1))
        assert changes[:, :, joint] == pytest.approx((ahead - behind) / (2 * small), abs=1e-6)
    assert chain.pose == pytest.approx(
        np.column_stack([chain.points[:, END], chain.direction[:, 2], chain.normal[:, 1]])
    )


def test_an_upright_robot_with_hanging_arms_is_where_its_lengths_say() -> None:
    hanging = ArmChain(np.zeros(1), np.zeros((1, 5)))
    x, y = 0.0, 0.36
    # Shoulder 0.30 + 0.42 m up; upper arm 0.50, forearm 0.45, plate 0.45 m, its end 0.12 m behind the tip.
    places = [[x, y, 0.72], [x, y, 0.22], [x, y, -0.23], [x, y, -0.56], [x, y, -0.68]]
    assert hanging.points[0] == pytest.approx(np.array(places))
    assert hanging.direction[0] == pytest.approx([0, 0, -1]) and hanging.normal[0] == pytest.approx([1, 0, 0])
    ahead = ArmChain(np.zeros(1), np.radians([[0.0, 0.0, 0.0, 90.0, 0.0]]))
    assert ahead.points[0, END] == pytest.approx([0.78, 0.36, 0.22])
    assert ahead.direction[0] == pytest.approx([1, 0, 0]) and ahead.normal[0] == pytest.approx([0, 0, 1])


def _observed(angles: Array) -> NDArray[np.float32]:
    """What the observation tells of arms at these joint angles (11,)."""
    row = np.zeros((1, SIZE), np.float32)
    for arm, key in zip(ARMS, ("P_A", "P_B"), strict=True):
        chain, at = ArmChain(angles[[WAIST]], angles[None, arm.joints]), SLICES[key].start
        mirror = np.array([1, arm.side, 1])
        row[0, at : at + 5] = (angles[arm.joints] - INITIAL_ARM) / ARM_WINDOW
        row[0, at + 15 : at + 21] = np.ravel([chain.points[0, END], chain.direction[0]] * mirror)
    row[0, SLICES["P_W"].start] = angles[WAIST] / WAIST_WINDOW
    return row


def _far_from_limits(rng: np.random.Generator) -> Array:
    middle, half = 0.5 * (LOWER + UPPER), 0.5 * (UPPER - LOWER)
    angles: Array = middle + 0.4 * half * rng.uniform(-1, 1, JOINTS)
    angles[[3, 8]] -= 0.2  # arms not stretched
    return angles


def test_followed_step_by_step_it_leads_both_arms_to_their_sub_goals() -> None:
    rng = np.random.default_rng(1)
    for _ in range(10):
        angles = _far_from_limits(rng)
        wanted = arm_ends(_observed(angles + rng.normal(0.0, 0.12, JOINTS)))
        first = np.abs(wanted - arm_ends(_observed(angles))).max()
        for _ in range(60):
            row = _observed(angles)
            step = np.clip(joint_step(row, wanted - arm_ends(row), CONFIG)[0], -1, 1)
            angles = np.clip(angles + step * LARGEST_CHANGE * ARM_WINDOW, LOWER, UPPER)
        assert np.abs(wanted - arm_ends(_observed(angles))).max() < min(0.02, first)


def test_it_asks_no_joint_out_of_its_range_for_help() -> None:
    angles = np.zeros(JOINTS)
    angles[:10] = np.tile(INITIAL_ARM, 2)
    way = np.zeros((1, SUBGOAL_SIZE), np.float32)
    way[0, [0, 3]] = 0.1  # ahead
    free = joint_step(_observed(angles), way, CONFIG)[0]
    blocked = angles.copy()
    blocked[0] = UPPER[0] if free[0] > 0 else LOWER[0]
    row = _observed(blocked)
    assert joint_step(row, way, CONFIG)[0, 0] == pytest.approx(0.0, abs=1e-6)


def test_it_is_bounded_mirrored_with_the_scene_and_the_same_in_a_batch() -> None:
    rng = np.random.default_rng(2)
    rows = np.concatenate([_observed(_far_from_limits(rng)) for _ in range(6)])
    way = rng.normal(0.0, 0.3, (6, SUBGOAL_SIZE)).astype(np.float32)
    steps = joint_step(rows, way, CONFIG)
    assert steps.shape == (6, JOINTS) and np.abs(steps).max() <= 2.0
    other = np.concatenate([way[:, 3:] * [1, -1, 1], way[:, :3] * [1, -1, 1]], axis=1)
    mirrored = joint_step(mirror_observations(rows), other.astype(np.float32), CONFIG)
    assert mirrored == pytest.approx(mirror_actions(steps), abs=1e-4)
    for index in range(6):
        alone = joint_step(rows[index : index + 1], way[index : index + 1], CONFIG)
        assert np.array_equal(alone[0], steps[index])
