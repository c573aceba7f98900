"""Pictures: they show everything, change nothing, and the overlay lies where things are."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lunar_rescue import LunarRescueEnv, postures, sample_scene
from lunar_rescue.physics import bodies, bullet, client
from lunar_rescue.pictures import stage
from lunar_rescue.pictures.camera import Camera, scene_camera
from lunar_rescue.pictures.overlay import caption, draw_overlay, near_colour, nearest_links, subgoals_in_scene
from lunar_rescue.pictures.rendering import Studio
from lunar_rescue.pictures.stage_set import base_frame
from lunar_rescue.scenes.suit import suit_parts
from lunar_rescue.scenes.terrain import Terrain
from reproduce.report.film import strip
from reproduce.report.formats import parse_size
from reproduce.storage.errors import UserError

SMALL = (240, 176)


@pytest.fixture(scope="module")
def env() -> Iterator[LunarRescueEnv]:
    made = LunarRescueEnv(render_mode="rgb_array")
    yield made
    made.close()


@pytest.fixture(scope="module")
def studio() -> Iterator[Studio]:
    made = Studio(fine=1)
    yield made
    made.close()


def _with_rocks(env: LunarRescueEnv) -> None:
    seed = next(s for s in range(100) if len(sample_scene(s).rocks) >= 3)
    env.reset_flat(options={"scene": sample_scene(seed)})


@pytest.mark.process
def test_pictures_change_nothing_bit_for_bit(env: LunarRescueEnv) -> None:
    """The same actions give the same trajectory whether pictures are taken or not."""
    actions = np.random.default_rng(0).uniform(-1, 1, (40, 11))

    def trajectory(pictures: bool) -> list[bytes]:
        seen = [env.reset_flat(seed=7)[0].tobytes()]
        for action in actions:
            observation, reward, terminated, truncated, _ = env.step_flat(action)
            seen.append(observation.tobytes() + np.float64(reward).tobytes() + env.episode.body.centre.tobytes())
            if pictures:
                env.render()
            if terminated or truncated:
                break
        return seen

    without = trajectory(False)
    assert trajectory(True) == without
    assert trajectory(False) == without


def test_the_stage_never_steps_and_the_simulation_never_looks() -> None:
    def used(*modules: ModuleType) -> set[str]:
        trees = [ast.parse(Path(str(module.__file__)).read_text()) for module in modules]
        return {node.attr for tree in trees for node in ast.walk(tree) if isinstance(node, ast.Attribute)}

    assert "stepSimulation" not in used(stage, client)
    assert not used(bullet, bodies, client) & {"getCameraImage", "changeVisualShape", "addUserDebugLine"}


@pytest.mark.process
def test_a_picture_is_the_same_again(env: LunarRescueEnv, studio: Studio) -> None:
    _with_rocks(env)
    camera = scene_camera(env.episode.scene, SMALL)
    first = studio.picture(env.episode, camera)
    assert first.shape == (SMALL[1], SMALL[0], 3) and first.dtype == np.uint8
    env.reset_flat(seed=1)
    studio.picture(env.episode)
    _with_rocks(env)
    assert np.array_equal(studio.picture(env.episode, camera), first)


def test_arms_suit_sky_and_ground_are_told_apart(env: LunarRescueEnv, studio: Studio) -> None:
    env.reset_flat(options={"scene": replace(sample_scene(0, posture="supine_straight"), terrain=Terrain(), rocks=())})
    picture = studio.picture(env.episode).astype(int)
    red, _, blue = np.moveaxis(picture, -1, 0)
    share = {
        "arm A": (blue > red + 60).mean(),
        "arm B": (red > blue + 80).mean(),
        "suit": (picture.min(axis=-1) > 190).mean(),
        "sky": (picture.max(axis=-1) == 0).mean(),
        "ground": ((np.ptp(picture, axis=-1) < 25) & (red > 60) & (red < 190)).mean(),
    }
    assert share["arm A"] > 0.003 and share["arm B"] > 0.01 and share["suit"] > 0.02
    assert 0.03 < share["sky"] < 0.3 and share["ground"] > 0.4


def test_ground_has_no_stripes(env: LunarRescueEnv, studio: Studio) -> None:
    """The ground beside everything is a little rough, but never in full light and full shadow in turn."""
    env.reset_flat(options={"scene": replace(sample_scene(3), terrain=Terrain(), rocks=())})
    corner = studio.picture(env.episode)[-60:, :60].astype(float).mean(axis=-1)
    assert 1.0 < corner.std() < 12.0


@settings(max_examples=30, deadline=None)
@given(st.floats(-180, 180), st.floats(-80, -2), st.floats(1, 8))
def test_camera_sees_its_target_in_the_middle(yaw: float, pitch: float, distance: float) -> None:
    camera = Camera((0.3, -0.2, 0.4), distance, yaw, pitch)
    x, y, depth = camera.project(np.array([camera.target]))[0]
    assert (x, y, depth) == pytest.approx((camera.size[0] / 2, camera.size[1] / 2, distance), abs=1e-6)
    above = camera.project(np.array([camera.target]) + [0, 0, 0.1])[0]
    assert above[1] < y and above[0] == pytest.approx(x, abs=1e-6)
    middle = camera.rays()[camera.size[1] // 2, camera.size[0] // 2]
    assert camera.eye + distance * middle == pytest.approx(np.array(camera.target), abs=0.02 * distance)


def test_projection_is_the_renderers(env: LunarRescueEnv, studio: Studio) -> None:
    """A body's middle projects onto its pixels: the helmet's projection falls on the suit's white."""
    scene = replace(sample_scene(0, posture="supine_straight"), terrain=Terrain(), rocks=())
    env.reset_flat(options={"scene": scene})
    camera = replace(scene_camera(scene), pitch=-60.0)
    picture = studio.picture(env.episode, camera)
    torso = env.episode.astronaut.keypoints(env.episode.body)[[7, 10]].mean(axis=0)  # between the hips
    x, y, _ = camera.project(torso[None])[0].astype(int)
    assert picture[y, x].min() > 120


@pytest.mark.process
def test_a_slope_leans_and_the_camera_does_not(env: LunarRescueEnv, studio: Studio) -> None:
    drawn = next(scene for scene in map(sample_scene, range(1000)) if scene.terrain.slope > 7.0)
    slope = replace(drawn, rocks=())
    level = replace(slope, terrain=Terrain())
    camera = scene_camera(slope)
    up = camera.view[:3, :3] @ slope.terrain.up()
    assert up[0] == pytest.approx(0.0, abs=1e-9)  # against gravity is upwards in the picture
    pictures = []
    for scene in (level, slope):
        env.reset_flat(options={"scene": scene})
        pictures.append(studio.picture(env.episode))
    assert np.abs(pictures[0].astype(int) - pictures[1]).mean() > 3


@pytest.mark.parametrize("name", list(postures())[::5])
def test_every_suit_part_is_drawn_where_it_collides(name: str) -> None:
    from lunar_rescue.pictures.shapes import suit_shapes

    limbs = postures()[name].limbs
    corners = np.concatenate([mesh.vertices for mesh in suit_shapes(limbs).values()])
    for part in suit_parts(limbs):
        assert np.linalg.norm(corners - part.position, axis=1).min() < max(part.size) + 0.01
    assert np.abs(corners).max() < 1.5


def test_overlay_draws_targets_subgoals_and_marks(env: LunarRescueEnv, studio: Studio) -> None:
    _with_rocks(env)
    e = env.episode
    camera = scene_camera(e.scene)
    plain = studio.picture(e, camera)
    kept = plain.copy()
    subgoals = e.observer.to_base(e.targets()) + [0.0, 0.0, 0.3]
    drawn = draw_overlay(plain, e, camera, subgoals, "a note")
    assert drawn.shape == plain.shape and np.array_equal(plain, kept)
    changed = (drawn != plain).any(axis=-1)
    for point in [*e.targets(), *e.robot.ends, *e.marks, *subgoals_in_scene(e, subgoals)]:
        x, y, _ = camera.project(point[None])[0].round().astype(int)
        if 3 < x < camera.size[0] - 3 and 3 < y < camera.size[1] - 40:
            assert changed[y - 3 : y + 4, x - 3 : x + 4].any()
    lines = caption(e, "a note")
    assert "a note" in lines[0] and f"step {e.steps}" in lines[0] and "A to target" in lines[1]


def test_subgoals_come_back_from_the_base_frame(env: LunarRescueEnv) -> None:
    env.reset_flat(seed=4)
    points = env.episode.robot.ends
    assert subgoals_in_scene(env.episode, env.episode.observer.to_base(points)) == pytest.approx(points, abs=1e-9)
    origin, axes = base_frame(env.episode)
    assert origin[:2] == pytest.approx([env.episode.scene.base_x, env.episode.scene.base_y])
    assert axes @ axes.T == pytest.approx(np.eye(3), abs=1e-9)


def test_nearest_links_and_their_colours() -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0]])
    marks = np.array([[1.2, 0, 0]] + [[5.0, 0, 0]] * 4 + [[0, 0.6, 0]] * 5)
    first, second = nearest_links(points, marks)
    assert first.distance == pytest.approx(0.2) and first.joint[0] == 1.0
    assert second.distance == pytest.approx(0.6) and second.joint[0] == 0.0
    assert nearest_links(points, np.zeros((0, 3))) == []
    assert near_colour(0.0)[0] > 200 > near_colour(0.0)[1] and near_colour(9.0) == near_colour(0.5)


def test_strip_and_sizes() -> None:
    frames = [np.full((16, 32, 3), i, np.uint8) for i in range(20)]
    assert strip(frames, 8, 4).shape == (2 * 16 + 4, 4 * 32 + 3 * 4, 3)
    assert strip(frames[:1], 3, 2).shape == (36, 68, 3)
    assert parse_size("720x528") == (720, 528)
    for bad in ("720", "x", "720x529", "16x16", "-480x352", "4800x352"):
        with pytest.raises(UserError, match="--size"):
            parse_size(bad)
