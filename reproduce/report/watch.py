"""Rescues in PyBullet's window, in real time."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from lunar_rescue import LunarRescueEnv, sample_scene
from lunar_rescue.physics.robot import CONTROL_STEP
from lunar_rescue.pictures.window import Window, why_no_window
from reproduce.experiments.evaluate import find_policy, run_episode
from reproduce.report.film import WatchedPolicy, ending
from reproduce.storage.errors import UserError

PAUSE = 2.0  # s, after each rescue
LAG = 0.5  # s, that a slow picture may be made up for by quicker ones after it


class _ClosedError(Exception):
    """The window has been closed."""


def watch(
    where: str | Path,
    seed: int,
    rescues: int = 0,
    posture: str | None = None,
    task: str | None = None,
    tell: Callable[[str], None] = print,
) -> None:
    """Play rescues one after another, from the scene of ``seed`` on, until the window is closed.

    Closing the window ends the whole program: PyBullet's window knows no other way.

    Args:
        where: Run folder, or a method that does not learn by its name.
        seed: Of the first scene.
        rescues: How many, or 0 for no end.
        posture: Draw scenes with this posture.
        task: Draw scenes with this task.
        tell: Called with a line about each rescue.

    Raises:
        UserError: On a wrong argument, or where there is no display.
    """
    if seed < 0:
        raise UserError(f"seed: expected at least 0, got {seed}")
    if rescues < 0:
        raise UserError(f"--rescues: expected at least 0, got {rescues}")
    _, policy = find_policy(where)
    sample_scene(seed, posture=posture, task=task)  # a wrong posture or task is told before a window opens
    if reason := why_no_window():
        raise UserError(f"watch: {reason}; `reproduce replay` makes a film without one")
    env, window = LunarRescueEnv(), Window()
    watched = WatchedPolicy(policy, _show_in_time(env, window))
    try:
        for number in itertools.count(seed) if rescues == 0 else range(seed, seed + rescues):
            scene = sample_scene(number, posture=posture, task=task)
            row = run_episode(env, watched, scene)
            tell(f"scene {number}, {row['task']} {row['posture']}: {ending(row)} after {row['steps']} steps")
            window.show(env.episode, note=ending(row))
            time.sleep(PAUSE)
    except _ClosedError:
        tell("window closed")
    finally:
        env.close()
        window.close()


def _show_in_time(env: LunarRescueEnv, window: Window) -> Callable[[NDArray[Any] | None], None]:
    """A function that shows the episode, once a ``CONTROL_STEP`` on average."""
    due = [0.0]

    def show(subgoals: NDArray[Any] | None) -> None:
        time.sleep(max(0.0, due[0] - time.monotonic()))
        due[0] = max(due[0], time.monotonic() - LAG) + CONTROL_STEP
        if not window.is_open:
            raise _ClosedError
        window.show(env.episode, subgoals)

    return show
