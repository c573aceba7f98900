from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lunar_rescue.postures import DATA_FILE, load_postures, postures
from lunar_rescue.rocks import MAX_ROCKS
from lunar_rescue.scene import TASKS, Scene, sample_scene, task_distribution
from lunar_rescue.suit import mass_properties, suit_parts
from lunar_rescue.targets import approach_sides, target_areas


def test_twenty_postures_of_four_attitudes() -> None:
    assert len(postures()) == 20
    assert sorted({p.attitude for p in postures().values()}) == ["left_side", "prone", "right_side", "supine"]


def test_both_tasks_occur() -> None:
    assert {task for _, task in task_distribution()} == set(TASKS)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**31 - 1))
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
        vertices, marks = rock.vertices(), rock.marks()
        assert vertices[:, 2].min() < rock.ground < vertices[:, 2].max()
        assert marks.shape == (5, 3)
        assert marks[0, 2] == vertices[:, 2].max()
        assert np.all(marks[:, 2] > rock.ground)


@pytest.mark.parametrize(
    ("field", "value", "name"),
    [
        ("mass", 1000.0, "mass"),
        ("mass", float("nan"), "mass"),
        ("friction", 0.1, "friction"),
        ("posture", "standing", "posture"),
        ("task", "dance", "task"),
        ("terrain", "water", "terrain"),
        ("base_x", float("inf"), "base_x"),
    ],
)
def test_bad_scenes_are_refused_by_name(field: str, value: Any, name: str) -> None:
    with pytest.raises(ValueError, match=name):
        dataclasses.replace(sample_scene(3), **{field: value})


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
                    assert surface[near, 2].max() > offset[2] + posture.rest_height
