from __future__ import annotations

import dataclasses
import json
import math
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from images import mirrored  # type: ignore[import-not-found]  # pytest puts this folder on the path

from lunar_rescue import LunarRescueEnv, sample_scene
from lunar_rescue.observation import BOUND
from lunar_rescue.physics.robot import JOINTS
from lunar_rescue.scenes.postures import DATA_FILE, all_postures, load_postures, postures
from lunar_rescue.scenes.rocks import MAX_ROCKS, ROCK_EXPONENT, ROCK_SIZE_RANGE, Rock, rock_marks
from lunar_rescue.scenes.scene import (
    BASE_RANGE,
    FRICTION_RANGE,
    HELDOUT_MASSES,
    MASS_RANGE,
    TASKS,
    Scene,
    task_distribution,
)
from lunar_rescue.scenes.splits import HELD_OUT, SPLITS
from lunar_rescue.scenes.suit import Limbs, keypoints, mass_properties, suit_parts
from lunar_rescue.scenes.targets import approach_sides, target_areas
from lunar_rescue.scenes.terrain import MAX_SLOPE, SMOOTH, Terrain


def test_twenty_postures_of_four_attitudes() -> None:
    assert len(postures()) == 20
    assert sorted({p.attitude for p in postures().values()}) == ["left_side", "prone", "right_side", "supine"]


def test_both_tasks_occur() -> None:
    assert {task for _, task in task_distribution()} == set(TASKS)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2_039_999_999))
def test_scene_is_a_pure_function_and_survives_json(seed: int) -> None:
    scene = sample_scene(seed)
    assert scene == sample_scene(seed)
    assert Scene.from_json(scene.to_json()) == scene
    assert len(scene.rocks) <= MAX_ROCKS


def test_seed_zero_is_a_seed() -> None:
    assert sample_scene(0).seed == 0
    assert sample_scene(0) != sample_scene(1)


def test_rocks_are_half_buried_and_marked() -> None:
    rocks = [rock for seed in range(60) for rock in sample_scene(seed).rocks]
    assert rocks
    for rock in rocks:
        vertices, marks = rock.vertices(), rock_marks([rock])
        assert vertices[:, 2].min() < rock.ground < vertices[:, 2].max()
        assert marks.shape == (5, 3)
        assert marks[0, 2] == vertices[:, 2].max()
        assert np.all(marks[:, 2] > rock.ground)


def _between(bounds: tuple[float, float]) -> st.SearchStrategy[float]:
    return st.floats(*bounds)


@st.composite
def scenes(draw: st.DrawFn) -> Scene:
    """Any scene within the documented ranges, not only such as ``sample_scene`` draws."""
    model = draw(st.sampled_from(list(all_postures().values())))
    x, y, yaw = draw(_between((-50, 50))), draw(_between((-50, 50))), draw(_between((-7, 7)))
    away = draw(_between((BASE_RANGE[0] + 0.01, BASE_RANGE[1] - 0.01)))
    # Anywhere on a side from which the robot may come.
    bearing = yaw + draw(st.sampled_from(approach_sides(model))) * draw(_between((0.02, math.pi - 0.02)))
    base = x + away * math.cos(bearing), y + away * math.sin(bearing), draw(_between((-7, 7)))
    terrain = SMOOTH
    if draw(st.booleans()):
        sides = approach_sides(model)
        patch, turned = ("lying", draw(st.booleans())) if len(sides) == 2 else ("on_side", sides[0] < 0)
        slope, downhill = draw(_between((0, MAX_SLOPE))), draw(_between((0, 6.3)))
        terrain = Terrain("rough", slope, downhill, draw(st.integers(0, 10**6)), patch, x, y, yaw + math.pi * turned)
    made = Scene(
        draw(st.integers(-1, 2**31 - 1)), draw(st.sampled_from(model.tasks)), model.name, x, y, yaw,
        draw(_between(MASS_RANGE)), draw(_between(FRICTION_RANGE)), *base, terrain=terrain,
    )  # fmt: skip
    rocks: list[Rock] = []
    for _ in range(draw(st.integers(0, MAX_ROCKS))):
        at = x + draw(_between((-1.5, 1.5))), y + draw(_between((-1.5, 1.5)))
        rock = Rock(
            *at, draw(_between(ROCK_SIZE_RANGE)), draw(_between((0.02, 0.3))), draw(_between((0.0, 0.95))),
            draw(_between((-7, 7))), draw(st.integers(0, 10**6)), float(terrain.height(*at)),
        )  # fmt: skip
        try:
            made = dataclasses.replace(made, rocks=(*rocks, rock))
        except ValueError as error:
            assert "lies" in str(error)  # in the astronaut, or under the base
        else:
            rocks.append(rock)
    return made


@settings(max_examples=60, deadline=None)
@given(scenes(), st.integers(0, 2**31))
def test_any_scene_in_range_builds_steps_and_serialises(scene: Scene, chance: int) -> None:
    assert Scene.from_json(scene.to_json()) == scene
    env, rng = _shared_env(), np.random.default_rng(chance)
    observation, _ = env.reset_flat(options={"scene": scene})
    for _ in range(3):
        assert np.all(np.isfinite(observation)) and np.abs(observation).max() <= BOUND
        observation, reward, *_ = env.step_flat(rng.uniform(-1, 1, JOINTS))
        assert math.isfinite(reward)


@lru_cache(maxsize=1)
def _shared_env() -> LunarRescueEnv:
    return LunarRescueEnv()


def _set(raw: dict[str, Any], path: tuple[Any, ...], value: Any) -> None:
    for key in path[:-1]:
        raw = raw[key]
    raw[path[-1]] = value


_WRONG_NUMBERS = st.sampled_from([-1e9, 1e9, float("nan"), float("inf"), "many", None, True, [1.0]])
_NUMBERS = [
    *((name,) for name in ("mass", "friction", "astronaut_x", "astronaut_yaw", "base_x", "base_y", "base_yaw")),
    *(("terrain", name) for name in ("slope", "downhill", "relief", "x", "yaw")),
    *(("rocks", 0, name) for name in ("x", "y", "diameter", "height", "buried", "yaw", "shape", "ground")),
]
_WRONG_WORDS = [("task",), ("posture",), ("terrain", "kind"), ("terrain", "patch")]


def _rough_with_rocks() -> dict[str, Any]:
    drawn = next(s for s in map(sample_scene, range(100)) if s.rocks and s.terrain.rough)
    raw: dict[str, Any] = json.loads(drawn.to_json())
    return raw


@settings(max_examples=150, deadline=None)
@given(st.sampled_from(_NUMBERS), _WRONG_NUMBERS)
def test_numbers_out_of_range_are_refused_by_name(path: tuple[Any, ...], value: Any) -> None:
    raw = _rough_with_rocks()
    _set(raw, path, value)
    with pytest.raises(ValueError, match="Scene") as error:
        Scene.from_json(json.dumps(raw))
    named = "Scene"
    for part in path:
        named += f"[{part}]" if isinstance(part, int) else f".{part}"
    assert named in str(error.value)


@settings(max_examples=60, deadline=None)
@given(st.sampled_from(_WRONG_WORDS), st.text(max_size=8) | st.integers() | st.none())
def test_words_that_nobody_knows_are_refused_by_name(path: tuple[Any, ...], value: Any) -> None:
    raw = _rough_with_rocks()
    _set(raw, path, value)
    with pytest.raises(ValueError, match=str(path[-1])):
        Scene.from_json(json.dumps(raw))


@settings(max_examples=60, deadline=None)
@given(
    st.recursive(
        st.none() | st.booleans() | st.floats() | st.text(), lambda c: st.lists(c) | st.dictionaries(st.text(), c)
    )
)
def test_other_json_is_refused(raw: Any) -> None:
    with pytest.raises(ValueError, match="Scene"):
        Scene.from_json(json.dumps(raw))


def test_what_cannot_lie_there_is_refused() -> None:
    scene = next(s for s in map(sample_scene, range(100)) if s.rocks and s.terrain.rough)
    stone = scene.rocks[0]

    def moved(x: float, y: float) -> dict[str, Any]:
        return {"rocks": (dataclasses.replace(stone, x=x, y=y, ground=float(scene.terrain.height(x, y))),)}

    for change, words in (
        (moved(scene.astronaut_x, scene.astronaut_y), "in the astronaut"),
        (moved(scene.base_x, scene.base_y), "under the robot"),
        ({"base_x": scene.astronaut_x, "base_y": scene.astronaut_y}, "base_x"),
        ({"terrain": dataclasses.replace(scene.terrain, x=scene.terrain.x + 0.5)}, "terrain"),
        ({"terrain": dataclasses.replace(scene.terrain, yaw=scene.terrain.yaw + 0.5)}, "terrain"),
        ({"terrain": "rough"}, "terrain"),
        ({"rocks": (dataclasses.replace(stone, ground=stone.ground + 0.3),)}, r"rocks\[0\].ground"),
        ({"rocks": None}, "rocks"),
        ({"rocks": [1]}, "rocks"),
        ({"seed": -7}, "seed"),
        ({"seed": 2.5}, "seed"),
        ({"mass": "x"}, "mass"),
        ({"posture": ["a"]}, "posture"),
        ({"rocks": scene.rocks * 8}, "rocks"),
    ):
        with pytest.raises(ValueError, match=words):
            dataclasses.replace(scene, **change)
    with pytest.raises(ValueError, match="slope"):
        Terrain("smooth", 3.0)
    lying = sample_scene(3, posture="left_side_curled")
    behind = 2 * lying.astronaut_x - lying.base_x, 2 * lying.astronaut_y - lying.base_y
    with pytest.raises(ValueError, match="base_x, base_y"):
        dataclasses.replace(lying, base_x=behind[0], base_y=behind[1], rocks=())
    for text in ("[" * 100_000, '{"seed": ' + "9" * 5000 + "}", '{"seed": 1' + "0" * 400 + "}"):
        with pytest.raises(ValueError, match="Scene"):
            Scene.from_json(text)


@pytest.mark.process
def test_heldout_scenes_have_what_no_training_scene_has() -> None:
    drawn = {name: [sample_scene(seeds.start + i) for i in range(400)] for name, seeds in SPLITS.items()}
    held = [scene for name in HELD_OUT for scene in drawn[name]]
    others = [scene for name in SPLITS if name not in HELD_OUT for scene in drawn[name]]
    for name in HELD_OUT:
        assert {s.posture for s in drawn[name]} == set(postures(name))
    assert {s.posture for s in others} == set(postures())
    inside = [any(low <= s.mass <= high for low, high in HELDOUT_MASSES) for s in [*held, *others]]
    assert all(inside[: len(held)]) and not any(inside[len(held) :])
    for part in (lambda s: {r.shape for r in s.rocks}, lambda s: {s.terrain.relief} if s.terrain.rough else set()):
        there, elsewhere = (set().union(*map(part, group)) for group in (held, others))
        assert there and elsewhere and not there & elsewhere


def _apart(a: Limbs, b: Limbs) -> tuple[int, float]:
    """Return how many joints are 15 degrees apart, and the mean distance of key points [cm]."""
    angles = np.abs(np.subtract(dataclasses.astuple(a), dataclasses.astuple(b)))
    points = [keypoints(limbs) - mass_properties(limbs).centre for limbs in (a, b)]
    return int((angles >= 15.0).sum()), float(100 * np.linalg.norm(points[0] - points[1], axis=1).mean())


@pytest.mark.parametrize("split", ["train", *HELD_OUT])
def test_postures_are_not_each_others_mirror_images_and_held_out_ones_are_far_from_training(split: str) -> None:
    known = postures()
    for posture in postures(split).values():
        for other in known.values():
            if other is posture:
                continue
            for attitude, limbs in ((other.attitude, other.limbs), mirrored(other)):
                if attitude == posture.attitude:
                    joints, centimetres = _apart(posture.limbs, limbs)
                    least = 4.0 if split == "train" else 8.0
                    assert joints >= 2 or centimetres >= least, (posture.name, other.name, joints, centimetres)
    assert {p.attitude for p in postures(split).values()} == {"supine", "prone", "left_side", "right_side"}


def test_the_base_stands_askew_within_reach() -> None:
    """Over training scenes the base is up to 0.25 m beside the middle of the targets and 20 degrees askew."""
    aside, askew, reach = [], [], []
    for scene in map(sample_scene, range(500)):
        areas = target_areas(scene.model, scene.side, scene.task)
        c, s = math.cos(scene.astronaut_yaw), math.sin(scene.astronaut_yaw)
        dx, dy = scene.base_x - scene.astronaut_x, scene.base_y - scene.astronaut_y
        along, away = c * dx + s * dy, c * dy - s * dx
        aside.append(along - areas.offsets[:, 0].mean())
        turned = scene.base_yaw - scene.astronaut_yaw + scene.side * math.pi / 2
        askew.append(math.degrees(math.remainder(turned, 2 * math.pi)))
        reach.append(np.hypot(areas.offsets[:, 0] - along, areas.offsets[:, 1] - away).max())
    assert -0.25 <= min(aside) < -0.22 and 0.22 < max(aside) <= 0.25
    assert -20.0 <= min(askew) < -17.0 and 17.0 < max(askew) <= 20.0
    assert np.std(askew) > 7.0 and np.std(aside) > 0.1
    assert max(reach) < 1.5


def test_rocks_lie_on_the_straight_ways_in() -> None:
    """In most scenes with rocks one lies within a plate's width of the straight way to a target, before the body."""
    blocked = []
    for scene in (s for s in map(sample_scene, range(300)) if s.rocks):
        areas = target_areas(scene.model, scene.side, scene.task)
        c, s = math.cos(scene.astronaut_yaw), math.sin(scene.astronaut_yaw)
        away = np.array([(r.x - scene.astronaut_x, r.y - scene.astronaut_y) for r in scene.rocks])
        own = away @ np.array([[c, -s], [s, c]])
        sizes = np.array([r.diameter / 2 for r in scene.rocks])
        blocked.append(
            any(
                np.any((np.abs(own[:, 0] - x) < sizes + 0.12) & (0 < scene.side * (own[:, 1] - y)) & (
                    scene.side * (own[:, 1] - y) < 1.0
                ))
                for x, y in areas.offsets[:, :2]
            )
        )  # fmt: skip
    assert np.mean(blocked) > 0.5


def test_the_documented_ranges_are_used() -> None:
    drawn = [sample_scene(seed) for seed in range(600)]
    assert {len(s.rocks) for s in drawn} == set(range(MAX_ROCKS + 1))
    assert 0.4 < np.mean([s.terrain.rough for s in drawn]) < 0.6
    assert max(s.terrain.slope for s in drawn) > 0.95 * MAX_SLOPE
    for values, bounds in (([s.mass for s in drawn], MASS_RANGE), ([s.friction for s in drawn], FRICTION_RANGE)):
        width = bounds[1] - bounds[0]
        assert min(values) < bounds[0] + 0.03 * width and max(values) > bounds[1] - 0.03 * width
    sizes = [r.diameter for s in drawn for r in s.rocks]
    # N(>=D) ~ D^exponent: this share of the rocks is at least half as large again as the smallest.
    assert np.mean(np.array(sizes) >= 0.15) == pytest.approx(1.5**ROCK_EXPONENT, abs=0.06)


@pytest.mark.parametrize("change", ["missing", "unknown", "type", "rocks", "text"])
def test_bad_json_is_refused_by_name(change: str) -> None:
    raw = json.loads(sample_scene(3).to_json())
    if change == "missing":
        del raw["mass"]
    elif change == "unknown":
        raw["colour"] = 1
    elif change == "type":
        raw["mass"] = "heavy"
    elif change == "rocks":
        raw["rocks"] = [{"x": 1.0}]
    text = "not json" if change == "text" else json.dumps(raw)
    with pytest.raises(ValueError, match="Scene"):
        Scene.from_json(text)


@pytest.mark.parametrize("seed", [-1, 1.5, "a", True])
def test_bad_seeds_are_refused(seed: Any) -> None:
    with pytest.raises(ValueError, match="seed"):
        sample_scene(seed)


def test_posture_without_that_task_is_refused() -> None:
    with pytest.raises(ValueError, match="supine_straight"):
        sample_scene(0, posture="supine_straight", task="turn_over")


def _broken(change: str) -> dict[str, Any]:
    document: dict[str, Any] = json.loads(DATA_FILE.read_text())
    entry = document["postures"][4]
    match change:
        case "left_knee_flexion":
            del entry["limbs"]["left_knee_flexion"]
        case "right_hip_abduction":
            entry["limbs"]["right_hip_abduction"] = 400
        case "tail":
            entry["limbs"]["tail"] = 1.0
        case "attitude":
            entry["attitude"] = "floating"
        case "rest.height":
            entry["rest"]["height"] = "low"
        case "rest.quaternion":
            entry["rest"]["quaternion"] = [0, 0, 0, 2]
        case "twice":
            document["postures"].append(document["postures"][0])
        case "postures":
            document = {"postures": []}
    return document


@pytest.mark.parametrize(
    "change",
    [
        "left_knee_flexion",
        "right_hip_abduction",
        "tail",
        "attitude",
        "rest.height",
        "rest.quaternion",
        "twice",
        "postures",
    ],
)
def test_broken_posture_file_is_refused_by_name(change: str, tmp_path: Path) -> None:
    path = tmp_path / "postures.json"
    path.write_text(json.dumps(_broken(change)))
    with pytest.raises(ValueError, match=change) as error:
        load_postures(path)
    assert str(path) in str(error.value)


def test_missing_or_cut_posture_file(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no such posture file"):
        load_postures(tmp_path / "none.json")
    cut = tmp_path / "cut.json"
    cut.write_text(DATA_FILE.read_text()[:500])
    with pytest.raises(ValueError, match="JSON"):
        load_postures(cut)


def test_mass_properties_of_a_straight_suit() -> None:
    posture = postures()["supine_straight"]
    properties = mass_properties(posture.limbs)
    parts = suit_parts(posture.limbs)
    # By hand: the centre of gravity is the mass-weighted mean of the parts' centres.
    expected = sum(p.mass_fraction * np.array(p.position) for p in parts)
    assert properties.centre == pytest.approx(expected)
    assert sum(p.mass_fraction for p in parts) == pytest.approx(1.0)
    assert abs(properties.centre[1]) < 1e-9  # the posture is symmetric
    assert np.all(np.diff(properties.inertia) >= 0) and properties.inertia[0] > 0.01


def test_targets_lie_under_the_body_on_both_sides_of_its_centre() -> None:
    for posture in postures().values():
        surface = posture.resting_surface()
        for side in approach_sides(posture):
            for task in posture.tasks:
                areas = target_areas(posture, side, task)
                assert areas.offsets[0, 0] > 0 > areas.offsets[1, 0]
                assert np.all(areas.clearance > 0.05)
                for offset in areas.offsets:
                    near = np.linalg.norm(surface[:, :2] - offset[:2], axis=1) < 0.1
                    assert surface[near, 2].max() > offset[2] + posture.rest.height
