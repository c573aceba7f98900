"""Make recoveries: episodes that a student led astray, brought to a rescue by a demonstrator.

A student acts in scenes that were demonstrated. Where it fails, its episode is replayed up to some steps before the
end, and the demonstrator goes on from there: it follows the set-points of the scene's demonstration from those nearest
to where the arms are. What succeeds teaches how to come back, where demonstrations alone teach only how not to leave.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lunar_rescue import LunarRescueEnv, Scene, sample_scene
from reproduce.baselines.planner.rollout import Rollout
from reproduce.experiments.evaluate import act_out, find_policy
from reproduce.experiments.pool import map_scenes
from reproduce.learning.demonstrations import Demonstration
from reproduce.learning.policy import Policy

Floats = NDArray[np.float32]

#: Takeovers of an episode that failed and of one that did not; a student's own rescues need fewer.
FAILED, RESCUED = 4, 1
LATEST = 3  # steps before the end of an episode; later nothing can be mended
_STATE: dict[str, Any] = {}


def _prepare(folder: str, demonstrations: Sequence[Demonstration]) -> None:
    import torch as th

    th.set_num_threads(1)
    plain = {one.seed: one for one in demonstrations}
    _STATE.update(env=LunarRescueEnv(), policy=find_policy(folder)[1], plain=plain)


def student_actions(env: LunarRescueEnv, policy: Policy, scene: Scene) -> tuple[Floats, bool]:
    """Let a student act in a scene; return its actions (steps, 11) and whether they were a rescue."""
    steps = list(act_out(env, policy, scene))
    return np.array([action for action, _, _ in steps]), bool(steps[-1][2]["is_success"])


class Demonstrator:
    """Goes on from where a student has led, by the set-points of the same scene's demonstration."""

    def __init__(self, env: LunarRescueEnv, demonstration: Demonstration) -> None:
        """Play the demonstration once, to see when both arms come under the body."""
        self._env, self._scene = env, sample_scene(demonstration.seed)
        self._under = Rollout(env, self._scene, list(demonstration.actions)).so_far().under
        self._path = np.array([env.robot.joint_targets(action) for action in demonstration.actions])

    def recover(self, astray: Floats) -> Demonstration | None:
        """Go on from where actions (steps, 11) have led to the rescue; None where that fails."""
        if self._under is None:
            return None
        trial = Rollout(self._env, self._scene, list(astray)).along(self._path, self._under)
        if not trial.rescued:
            return None
        return Demonstration(self._scene.seed, trial.actions, trial.wanted, begin=len(astray))


def _recover_scene(seed: int) -> tuple[bool, list[Demonstration]]:
    env = _STATE["env"]
    actions, rescued = student_actions(env, _STATE["policy"], sample_scene(seed))
    rng = np.random.default_rng([seed, 7, len(actions)])
    last = len(actions) - LATEST
    count = min(RESCUED if rescued else FAILED, last - 1)
    cuts = np.sort(rng.choice(np.arange(1, last), count, replace=False)) if count > 0 else ()
    demonstrator = Demonstrator(env, _STATE["plain"][seed])
    made = [demonstrator.recover(actions[:cut]) for cut in cuts]
    return rescued, [one for one in made if one is not None]


def recoveries(
    folder: Path, demonstrations: Sequence[Demonstration], *, quiet: bool = False
) -> tuple[list[Demonstration], float]:
    """Let the policy of a run folder act in demonstrated scenes.

    Returns the recoveries that succeeded, and the share of scenes that the policy rescued by itself.
    """
    plain = {one.seed: one for one in demonstrations if one.begin == 0 and np.array_equal(one.actions, one.wanted)}
    arguments = (str(folder), list(plain.values()))
    rows = map_scenes(_recover_scene, list(plain), _prepare, arguments, title="recoveries", quiet=quiet)
    return [one for _, made in rows for one in made], float(np.mean([rescued for rescued, _ in rows]))
