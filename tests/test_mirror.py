"""The learners' view: a mirrored scene with mirrored actions is the scene again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from images import image  # type: ignore[import-not-found]  # pytest puts this folder on the path

from lunar_rescue import LunarRescueEnv, Scene, sample_scene
from lunar_rescue.observation import SIZE, SLICES
from lunar_rescue.physics.robot import JOINTS
from lunar_rescue.scenes.postures import all_postures
from lunar_rescue.scenes.terrain import SMOOTH
from reproduce.learning.mirror import Mirror, mirror_actions, mirror_observations, mirror_points

POSTURES = ("supine_straight", "prone_straight", "left_side_arms_front", "left_side_stride", "right_side_arm_across")
_SPEEDS_AND_TORQUES = np.r_[5:15, 26:36, 43:45]


def _reflected(scene: Scene, posture: str) -> Scene:
    """The scene's image in the world's x-z plane."""
    rocks = tuple(replace(r, y=-r.y, yaw=-r.yaw) for r in scene.rocks)
    assert scene.terrain == SMOOTH
    turned = {name: -getattr(scene, name) for name in ("astronaut_y", "astronaut_yaw", "base_y", "base_yaw")}
    return replace(scene, posture=posture, rocks=rocks, **turned)


def _level_scene(posture: str) -> Scene:
    """A scene with rocks on level ground: a relief is not its own mirror image."""
    scene = next(s for seed in range(400) if (s := sample_scene(seed, posture=posture)).rocks)
    return replace(scene, rocks=tuple(replace(r, ground=0.0) for r in scene.rocks), terrain=SMOOTH)


@pytest.mark.parametrize("posture", POSTURES)
def test_mirrored_scene_is_seen_alike(posture: str, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, other = _level_scene(posture), image(all_postures()[posture])
    monkeypatch.setitem(all_postures(), other.name, other)
    rng = np.random.default_rng(0)
    actions = np.repeat(rng.uniform(-0.4, 0.4, (4, JOINTS)).astype(np.float32), 4, axis=0)
    envs = LunarRescueEnv(), LunarRescueEnv()
    seen = [
        e.reset_flat(options={"scene": s})[0] for e, s in zip(envs, (scene, _reflected(scene, other.name)), strict=True)
    ]
    for step, action in enumerate(actions):
        far = np.abs(mirror_observations(seen[0][None])[0] - seen[1])
        assert far[SLICES["P_E"]].max() < 0.25  # a rock's bumps, and so its top, are not their own mirror image
        far[SLICES["P_E"]] = 0.0
        if step:  # contacts are solved in another order, which shows in speeds and torques
            far[_SPEEDS_AND_TORQUES] = 0.0
        assert far.max() < (0.05 if step else 0.01)
        seen = [envs[0].step_flat(action)[0], envs[1].step_flat(mirror_actions(action[None])[0])[0]]
    for env in envs:
        env.close()


def test_mirroring_twice_changes_nothing() -> None:
    rng = np.random.default_rng(1)
    observations = rng.normal(size=(3, SIZE)).astype(np.float32)
    actions = rng.normal(size=(3, JOINTS)).astype(np.float32)
    points = rng.normal(size=(3, 2, 3)).astype(np.float32)
    once = mirror_observations(observations)
    assert np.array_equal(mirror_observations(once), observations)
    assert (once != observations).mean() > 0.5
    assert np.array_equal(mirror_actions(mirror_actions(actions)), actions)
    assert np.array_equal(mirror_points(mirror_points(points)), points)


def test_head_is_always_on_the_left_at_the_start_and_the_view_stays(env: LunarRescueEnv) -> None:
    head = SLICES["P_P"].start + 16
    seen = np.array([env.reset_flat(options={"scene": sample_scene(i)})[0] for i in range(12)])
    mirror = Mirror(12)
    mirror.begin(seen, np.ones(12, bool))
    assert 0 < mirror.mirrored.sum() < 12
    view = mirror.observations(seen)
    assert (view[:, head] > view[:, SLICES["P_P"].start + 1]).all()
    kept = mirror.mirrored.copy()
    mirror.begin(mirror_observations(seen), np.arange(12) == 0)  # only the first begins anew, and with its image
    assert mirror.mirrored[0] == (not kept[0])
    assert np.array_equal(mirror.mirrored[1:], kept[1:])
