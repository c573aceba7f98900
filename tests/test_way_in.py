"""The way in as a prior: where it leads, in the mirrored view too, and the same in training, playback and acting."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from lunar_rescue import LunarRescueEnv, sample_scene
from lunar_rescue.observation import SIZE, SLICES
from lunar_rescue.physics.kinematics import END, ArmChain
from lunar_rescue.physics.robot import ARM_WINDOW, ARMS, INITIAL_ARM, JOINTS, WAIST, WAIST_WINDOW
from reproduce.experiments.evaluate import act_out
from reproduce.experiments.methods import METHODS, load_policy
from reproduce.experiments.presets import changed
from reproduce.learning.config import PlacesConfig
from reproduce.learning.demonstrations import Demonstration, play_back
from reproduce.learning.mirror import ACTIONS, mirror_observations
from reproduce.learning.way_in import PLACES, WAY_SIZE, WayIn, joints_at_places
from reproduce.storage.errors import UserError
from reproduce.storage.files import read_json, write_json
from reproduce.storage.policies import save_policy

Floats = NDArray[np.float32]
CONFIG = PlacesConfig()
GOALS = SLICES["P_G"].start


@pytest.fixture(scope="module")
def seen() -> Iterator[Floats]:
    """Return the first observations of four training scenes (4, SIZE)."""
    env = LunarRescueEnv()
    scenes = [sample_scene(1_500_000_000 + index) for index in range(4)]
    yield np.stack([env.reset_flat(options={"scene": scene})[0] for scene in scenes])
    env.close()


def _ends(action: Floats) -> NDArray[np.float64]:
    """Return where both ends are with the joints where an action (11,) asks for, (2, 3) [m]."""
    waist = np.array([action[WAIST] * WAIST_WINDOW])
    chains = [ArmChain(waist, action[None, arm.joints] * ARM_WINDOW + INITIAL_ARM) for arm in ARMS]
    return np.array([c.points[0, END] * [1, arm.side, 1] for c, arm in zip(chains, ARMS, strict=True)])


def test_joints_lead_above_the_slide_to_where_it_begins_and_under(seen: Floats) -> None:
    actions = joints_at_places(seen, CONFIG)
    assert actions.shape == (4, PLACES, JOINTS)
    for row, (above, begin, under) in zip(seen, actions, strict=True):
        targets = row[GOALS : GOALS + 6].reshape(2, 3)
        ends = np.stack([row[SLICES[key].start + 15 : SLICES[key].start + 18] for key in ("P_A", "P_B")])
        entries = ends + row[GOALS + 12 : GOALS + 18].reshape(2, 3)
        assert _ends(under) == pytest.approx(targets, abs=0.03)
        # The slide begins 4 cm further out than the entry, at the height of the target; the hover is 0.4 m above.
        way = (entries - targets)[:, :2]
        out = entries[:, :2] + 0.04 * way / np.linalg.norm(way, axis=1, keepdims=True)
        assert _ends(begin) == pytest.approx(np.column_stack([out, targets[:, 2]]), abs=0.05)
        assert _ends(above) == pytest.approx(np.column_stack([out, targets[:, 2] + 0.4]), abs=0.05)
        assert np.degrees(under[WAIST] * WAIST_WINDOW) == pytest.approx(40.0, abs=1e-3)
        assert above[WAIST] < begin[WAIST] < under[WAIST]


def test_a_mirror_image_has_the_mirrored_way(seen: Floats) -> None:
    straight = joints_at_places(seen, CONFIG)
    assert joints_at_places(mirror_observations(seen), CONFIG) == pytest.approx(straight[..., ACTIONS], abs=1e-3)


def test_the_way_is_the_difference_of_the_joints_seen_twice(seen: Floats) -> None:
    view = WayIn(4, CONFIG).view(seen)
    assert view.shape == (4, SIZE + WAY_SIZE) and view.dtype == np.float32
    assert np.array_equal(view[:, :SIZE], seen)
    angles = np.concatenate([seen[:, SLICES[key].start :][:, :5] for key in ("P_A", "P_B")], axis=1)
    waist = seen[:, SLICES["P_W"].start]
    way = view[:, SIZE:].reshape(4, 2, PLACES, JOINTS)
    places = joints_at_places(seen, CONFIG)
    assert way[:, 0, :, :10] == pytest.approx(places[:, :, :10] - angles[:, None], abs=1e-6)
    assert way[:, 0, :, WAIST] == pytest.approx(places[:, :, WAIST] - waist[:, None], abs=1e-6)
    assert way[:, 1] == pytest.approx(np.clip(6.0 * way[:, 0], -1, 1), abs=1e-6)
    assert WayIn(4, None).view(seen) is seen


def test_places_are_solved_anew_where_targets_move(seen: Floats) -> None:
    way = WayIn(4, CONFIG)
    before = way.view(seen)
    moved = seen.copy()
    moved[0, GOALS] += 0.5 * CONFIG.moved
    moved[1, GOALS] += 10 * CONFIG.moved
    after = way.view(moved)
    assert np.array_equal(after[[0, 2, 3], SIZE:], before[[0, 2, 3], SIZE:])
    assert np.abs(after[1, SIZE:] - before[1, SIZE:]).max() > 0.01
    second = seen.copy()
    second[:, GOALS] += 10 * CONFIG.moved
    second[:2, SLICES["phase"]] = [1.0, 0.5]  # process 2 is reached
    last = way.view(second)
    assert np.array_equal(last[:2, SIZE:], after[:2, SIZE:]) and not np.array_equal(last[2:, SIZE:], after[2:, SIZE:])
    way.begin(np.array([True, True, False, False]))
    again = way.view(seen)
    assert np.array_equal(again[:2, SIZE:], before[:2, SIZE:])


@pytest.mark.process
@pytest.mark.parametrize("name", ["hrl_dcs", "ppo_lstm", "fun", "sac"])
def test_a_method_trains_and_acts_with_it(name: str, tmp_path: Path) -> None:
    sizes = {"n_envs": 2, "steps": 32, "priors.way_in": True}
    for section, values in (("low", {"n_steps": 16, "batch_size": 16}), ("sac", {"n_steps": 16, "learning_starts": 4})):
        if hasattr(METHODS[name].config("smoke"), section):
            sizes |= {f"{section}.{key}": value for key, value in values.items()}
    config = changed(METHODS[name].config("smoke"), sizes)
    train = METHODS[name].train
    assert train
    with closing(train(config, 0)) as training:
        assert training.update(0)["episodes"] >= 0
        save_policy(tmp_path, name, training.networks(), config.policy)
    method, policy = load_policy(tmp_path)
    assert method.name == name
    env = LunarRescueEnv()
    actions = [action for action, _, _ in act_out(env, policy, sample_scene(1_500_000_000))]
    env.close()
    assert np.abs(actions).max() <= 1.0
    raw = read_json(tmp_path / "policy.json", "policy")
    write_json(tmp_path / "policy.json", {**raw, "places": None})
    with pytest.raises(UserError, match=f"expected observations and actions .{SIZE}"):
        load_policy(tmp_path)


def test_playback_sees_what_a_policy_sees(monkeypatch: pytest.MonkeyPatch) -> None:
    seed = 1_500_000_000
    env = LunarRescueEnv()
    observation, _ = env.reset_flat(options={"scene": sample_scene(seed)})
    way, views = WayIn(1, CONFIG), []
    hold = np.zeros((3, JOINTS), np.float32)
    step = env.step_flat
    for action in hold:
        views.append(way.view(observation[None])[0])
        observation, *_ = step(action)
    env.close()

    def rescued(self: LunarRescueEnv, action: Floats, step: object = LunarRescueEnv.step_flat) -> object:
        seen, reward, terminated, truncated, info = step(self, action)  # type: ignore[operator]
        return seen, reward, terminated, truncated, {**info, "is_success": True}

    monkeypatch.setattr(LunarRescueEnv, "step_flat", rescued)  # holding still rescues nobody, and others are refused
    from lunar_rescue.rewards import RewardWeights

    played = play_back([Demonstration(seed, hold, hold)], weights=RewardWeights(), mirrored=False, places=CONFIG)
    assert np.array_equal(played[0].observations, np.array(views))
