"""Intervals over trainings and scenes, and of pairs, worked by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from reproduce.analysis.intervals import (
    crossed_interval,
    difference_of_means,
    kept_share,
    paired_difference,
    ratio_of_means,
    success_difference,
    success_interval,
)


def told(*rows: str) -> np.ndarray:
    """Return outcomes (trainings, scenes) of rows such as 1101."""
    return np.array([[digit == "1" for digit in row] for row in rows])


def test_success_of_three_trainings_by_hand() -> None:
    """Three trainings rescue in 3, 2 and 4 of 4 scenes, the scenes in 3, 3, 2 and 1 trainings.

    Log-odds log(3.5 / 1.5), 0 and log 9: the mean's variance is 0.409334 with 2 degrees of freedom. The scenes' mean
    has 0.025463, less 0.011574 for what one training does on one scene, over (0.75 0.25)^2: 0.395062 with 3. Together
    4.764684 degrees, a quantile of 2.609240, about log 3.
    """
    rate, low, high = success_interval(told("1110", "1100", "1111"))
    assert rate == 0.75 and (low, high) == pytest.approx((0.224164, 0.968895), abs=1e-6)


def test_success_of_one_training_and_of_tests_all_alike_is_wilson_s() -> None:
    assert success_interval(told("1110"))[1:] == pytest.approx((0.3006, 0.9544), abs=1e-4)
    # z^2 / (1000 + z^2) is missing to 1, of 1000 scenes and not of 5000 tests.
    rate, low, high = success_interval(np.ones((5, 1000), dtype=bool))
    assert (rate, high) == (1.0, pytest.approx(1.0)) and 1.0 - low == pytest.approx(3.841459 / 1003.841459, abs=1e-6)
    several: list[Any] = [np.ones(4, dtype=bool), np.ones((2, 3)), np.ones((0, 3), dtype=bool)]
    for bad in several:
        with pytest.raises(ValueError, match="trainings, scenes"):
            success_interval(bad)


def test_trainings_that_differ_widen_the_interval() -> None:
    scenes = np.arange(1000) % 100
    alike = np.stack([(scenes + shift) % 100 < 90 for shift in range(5)])
    apart = np.stack([scenes < share for share in (80, 85, 90, 95, 100)])
    widths = [high - low for _, low, high in map(success_interval, (alike, apart))]
    assert alike.mean() == apart.mean() == 0.9 and widths[1] > 3 * widths[0]


def test_difference_of_two_methods() -> None:
    first, second = told("1111", "1110"), told("1000", "1100")
    value, low, high = success_difference(first, second)
    assert value == 0.5 and low < 0.0 < high <= 1.0
    mirrored = success_difference(second, first)
    assert mirrored == pytest.approx((-value, -high, -low))
    with pytest.raises(ValueError, match="same scenes"):
        success_difference(first, second[:, :3])


def test_difficulty_that_both_share_falls_out_of_a_difference() -> None:
    hard = np.arange(1000) % 2 == 0  # every second scene, which no training rescues
    rng = np.random.default_rng(3)
    first, second = (~hard & (rng.random((5, 1000)) < rate) for rate in (0.98, 0.90))
    _, low, high = success_difference(first, second)
    _, below, above = success_difference(first, second[:, ::-1])  # scenes taken for others
    assert high - low < 0.6 * (above - below)


def test_nothing_told_apart_is_an_interval_of_pairs() -> None:
    same = np.ones((3, 100), dtype=bool)
    # Half a test in each of four cells: 1 / 102 for and against, on either side 1.959964 sqrt((1 / 102) / 102).
    assert success_difference(same, same) == pytest.approx((0.0, -0.019215, 0.019215), abs=1e-6)


def test_one_scene_leaves_student_and_welch() -> None:
    values = np.array([[1.0], [2.0], [4.0]])
    mean, low, high = crossed_interval(values)  # sd 1.527525, Student's quantile of 2 degrees 4.302653
    assert (mean, high - low) == pytest.approx((7 / 3, 2 * 4.302653 * 1.527525 / 3**0.5), abs=1e-5)
    # Variances of means 7/9 and 4, together 43/9 with 22.8272 / (0.302469 + 16) = 1.4002 degrees, quantile 6.6552.
    value, below, above = crossed_interval(values, np.array([[1.0], [5.0]]))
    assert (value, (above - below) / 2) == pytest.approx((-2 / 3, 6.6552 * (43 / 9) ** 0.5), abs=1e-3)
    assert difference_of_means([1.0, 2.0, 4.0], [1.0, 5.0]) == pytest.approx((value, below, above))
    with pytest.raises(ValueError, match="two trainings"):
        difference_of_means([1.0], [1.0, 2.0])


def test_a_ratio_by_hand() -> None:
    # Means 2 and 4, variances of means 1/3 and 4/3: on the log scale 1/12 each, 1/6 with 4 degrees of freedom.
    ratio, low, high = ratio_of_means([1.0, 2.0, 3.0], [2.0, 4.0, 6.0])
    half = np.exp(2.776445 * (1 / 6) ** 0.5)
    assert (ratio, low, high) == pytest.approx((0.5, 0.5 / half, 0.5 * half), abs=1e-5)
    with pytest.raises(ValueError, match="positive"):
        ratio_of_means([0.0, 0.0], [1.0, 2.0])


def test_the_share_kept_by_hand() -> None:
    before, after = told("1111100000")[0], told("1111010000")[0]
    share, low, high = kept_share(before, after)  # 5 before, 5 after, of which one is another: 2 differ
    half = np.exp(1.959964 * (3 / 5.5**2) ** 0.5)
    assert share == 1.0 and (low, high) == pytest.approx((1 / half, half), abs=1e-5)
    with pytest.raises(ValueError, match="successes before"):
        kept_share(~before & before, after)


def test_paired_difference_by_hand() -> None:
    first = np.repeat([True, False], [60, 40])
    second = np.repeat([True, False, True, False], [40, 25, 5, 30])
    difference, low, high = paired_difference(first, second)  # 20 times better, 5 times worse
    assert difference == pytest.approx(0.15)
    half = 1.959964 * ((20.5 + 5.5 - 15.0**2 / 102) / 102**2) ** 0.5
    assert (low, high) == pytest.approx((15.0 / 102 - half, 15.0 / 102 + half), abs=1e-6)
    difference, low, high = paired_difference(first, first)
    assert difference == 0.0 and low < 0.0 < high
    for bad in ([True], [], np.ones(100)):
        with pytest.raises(ValueError, match="outcomes"):
            paired_difference(first, bad)
