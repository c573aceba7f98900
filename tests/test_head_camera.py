"""The head camera: where its pixels lie, that its pictures repeat, and that nothing but pixels tells of the scene."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lunar_rescue import LunarRescueEnv, sample_scene
from lunar_rescue.observation import SIZE, SLICES
from lunar_rescue.pictures.camera import Camera
from lunar_rescue.pictures.head import (
    HEIGHT,
    RANGE,
    WIDTH,
    Head,
    _add_mound,
    camera_pose,
    draw_looks,
    head_camera,
    pixels,
)
from lunar_rescue.scenes.terrain import Terrain
from lunar_rescue.seeing import OWN, UP, SeeingEnv


@pytest.fixture(scope="module")
def seeing() -> Iterator[SeeingEnv]:
    made = SeeingEnv()
    yield made
    made.close()


def test_the_middle_of_the_picture_lies_where_it_does_by_hand() -> None:
    """The camera is 1.25 m up and 0.06 m ahead, looking 50 degrees down: it meets the ground 1.25 / tan 50 ahead."""
    place, axes = camera_pose(0.0)
    assert place == pytest.approx([0.06, 0.0, 1.25])
    ahead, away = 1.25 / np.tan(np.radians(50)), 1.25 / np.sin(np.radians(50))
    x, y, depth = pixels(np.array([[0.06 + ahead, 0.0, 0.0]]), 0.0)[0]
    assert (x, y, depth) == pytest.approx((WIDTH / 2, HEIGHT / 2, away))
    # A point 0.1 m to the left is 0.1 / depth * 36 / tan 33 pixels to the left of it.
    left = pixels(np.array([[0.06 + ahead, 0.1, 0.0]]), 0.0)[0]
    assert left[:2] == pytest.approx([48 - 0.1 / away * 36 / np.tan(np.radians(33)), 36.0])
    assert axes[2] @ [ahead, 0, -1.25] == pytest.approx(-away)


def test_the_camera_leans_with_the_waist() -> None:
    """Bent by 90 degrees, what was up is ahead: the mast's 0.95 m lie ahead of the waist, 0.3 m up."""
    place, axes = camera_pose(np.pi / 2)
    assert place == pytest.approx([0.95, 0.0, 0.3 - 0.06])
    looks = -axes[2]
    assert looks == pytest.approx([-np.sin(np.radians(50)), 0.0, -np.cos(np.radians(50))])


def test_a_ray_meets_a_mound_where_it_does_by_hand() -> None:
    """Straight down on the top of a mound 0.1 m high, from 1 m: 0.9 m away; 0.25 m aside, half its radius, 0.925."""
    mound = np.array([0.0, 0.0, 0.5, 0.5, 0.1, 0.3], np.float32)
    rays = np.tile(np.array([1e-9, 0.0, -1.0], np.float32), (2, 1))
    for aside, away in ((0.0, 0.9), (0.25, 0.925)):
        depth, normal = np.ones(2, np.float32), np.tile(np.array([0, 0, 1], np.float32), (2, 1))
        eye = np.array([aside, 0.0, 1.0], np.float32)
        _add_mound(
            mound, rays + np.float32(1e-4), eye, np.tile(eye[:2], (2, 1)), np.zeros(2, np.float32), depth, normal
        )
        assert depth == pytest.approx(away, abs=2e-3)
        # The cap's slope is -2 h x / r^2, and its normal leans against it.
        assert normal[0, 0] == pytest.approx(2 * 0.1 * aside / 0.25, abs=2e-3)


def test_depth_is_that_of_the_ground_and_of_the_body(seeing: SeeingEnv) -> None:
    """On level ground each pixel's depth is the plane's; on the suit and rocks it is less."""
    scene = replace(sample_scene(4, posture="supine_straight"), terrain=Terrain(), rocks=())
    seeing.reset_flat(options={"scene": scene})
    place, axes = camera_pose(0.0, draw_looks(scene.seed))
    rays = head_camera(place, axes).rays()
    plane = -place[2] / rays[..., 2]
    parts, depth = seeing.head.parts, seeing.sight.depth / 1000
    ground = (parts == 0) & (plane < 0.95 * RANGE)
    assert np.abs(depth / plane - 1)[ground].max() < 0.03 and np.abs((depth / plane - 1)[ground].mean()) < 5e-4
    assert (depth < plane)[parts == 2].mean() > 0.99
    assert (depth < plane)[parts == 1].all() and {0, 1, 2} == set(np.unique(parts))


def test_the_suit_s_key_points_lie_on_its_pixels(seeing: SeeingEnv) -> None:
    scene = replace(sample_scene(7, posture="supine_straight"), terrain=Terrain(), rocks=())
    seeing.reset_flat(options={"scene": scene})
    e = seeing.episode
    hips = e.observer.to_base(e.astronaut.keypoints(e.body))[[7, 10]]
    for x, y, _ in pixels(hips, 0.0).astype(int):
        assert seeing.head.parts[y, x] in (1, 2)  # the suit, or an arm before it


def test_pictures_repeat_bit_for_bit_and_differ_by_seed(seeing: SeeingEnv) -> None:
    def picture(seed: int | None = None) -> bytes:
        seeing.reset_flat(options={"scene": sample_scene(11)})
        sight = seeing.sight if seed is None else seeing.head.look(seeing.episode, seed)
        return sight.colour.tobytes() + sight.depth.tobytes()

    first = picture()
    seeing.reset_flat(seed=1)
    assert picture() == first == picture(11)
    assert picture(12) != first
    other = Head()
    again = other.look(seeing.episode)
    other.close()
    assert again.colour.tobytes() + again.depth.tobytes() == first


def test_what_the_seed_decides_is_in_its_range() -> None:
    drawn = [draw_looks(seed) for seed in range(300)]
    assert len(set(drawn)) == 300
    assert all(15 <= looks.sun[1] <= 60 and 0.7 <= looks.sunlight <= 1.4 for looks in drawn)
    assert 0.003 < np.std([looks.mount for looks in drawn]) < 0.005  # m, as MOUNT_ERROR has it
    assert all(0.6 < min(looks.suit) and max(looks.suit) <= 1.0 for looks in drawn)


def test_nothing_but_pixels_tells_of_body_targets_and_rocks(seeing: SeeingEnv) -> None:
    observation, _ = seeing.reset(options={"scene": sample_scene(11)})
    assert set(observation) == {"colour", "depth", "up", *OWN}
    assert seeing.observation_space.contains(observation)
    vector, _ = seeing.reset_flat(options={"scene": sample_scene(11)})
    hidden = np.ones(SIZE, bool)
    for where in (*(SLICES[key] for key in OWN), UP):
        hidden[where] = False
    assert not vector[hidden].any() and seeing.truth[hidden].any()
    # Two scenes that differ in posture and rocks alone have the same own sensors.
    scene = replace(sample_scene(11), rocks=())
    other = replace(
        scene, posture=next(p for p in ("supine_straight", "prone_straight") if p != scene.posture), task="lift"
    )
    plain, moved = (
        seeing.reset(options={"scene": s})[0]
        for s in (replace(scene, task="lift", posture="supine_arms_spread"), other)
    )
    assert all(np.array_equal(plain[key], moved[key]) for key in ("up", *OWN))
    assert not np.array_equal(plain["depth"], moved["depth"])
    after, *_ = seeing.step(np.zeros(11, np.float32))
    assert seeing.observation_space.contains(after)


def test_seeing_changes_nothing_bit_for_bit(seeing: SeeingEnv, env: LunarRescueEnv) -> None:
    actions = np.random.default_rng(0).uniform(-1, 1, (8, 11))
    told = []
    for world in (seeing, env):
        world.reset_flat(seed=7)
        rewards = [world.step_flat(action)[1] for action in actions]
        told.append((world.episode.body.centre.tobytes(), rewards))
    assert told[0] == told[1]
    assert np.array_equal(seeing.truth, env._observe(actions[-1]))


def test_the_suit_hides_behind_the_arms(seeing: SeeingEnv) -> None:
    seeing.reset_flat(options={"scene": sample_scene(11)})
    share = seeing.head.hidden(seeing.episode)
    assert 0.0 < share < 0.6
    before = seeing.sight
    again = seeing.head.look(seeing.episode)  # the robot is back where it was
    assert np.array_equal(before.depth, again.depth)


def test_the_stage_is_not_larger_than_it_must_be() -> None:
    from lunar_rescue.pictures import shapes

    limbs = sample_scene(0).model.limbs
    fine, coarse = (
        sum(len(m.faces) for m in shapes.suit_shapes(limbs, d).values()) for d in (shapes.FINE, shapes.COARSE)
    )
    assert coarse < fine / 4
    assert Path(shapes.__file__).is_file() and Camera((0, 0, 0)).size[0] > WIDTH
