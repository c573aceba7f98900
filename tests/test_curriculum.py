"""Which scenes a training draws, how its rates are weighed, and goals over any environment."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from gymnasium import spaces

from lunar_rescue.observation import SLICES
from lunar_rescue.scenes.postures import postures
from lunar_rescue.scenes.sampling import EASY_POSTURE, easy_scene
from lunar_rescue.scenes.scene import MASS_RANGE
from reproduce.experiments.methods import METHODS
from reproduce.hrl_dcs.goals import PlainGoals
from reproduce.learning.training import episode_summary, make_environments
from reproduce.learning.worker_process import EnvOptions, scene_options


def test_easy_scenes_have_one_posture_no_rocks_and_the_lightest_astronaut() -> None:
    scenes = [easy_scene(seed) for seed in range(3)]
    assert {(s.posture, s.mass, s.rocks) for s in scenes} == {(EASY_POSTURE, MASS_RANGE[0], ())}
    assert len({s.base_x for s in scenes}) == 3  # robot and astronaut still stand anywhere
    config = replace(METHODS["hrl_dcs"].config("smoke"), n_envs=2, scenes="easy")
    venv = make_environments(config, 0)
    try:
        assert not venv.reset()[:, SLICES["P_E"]].any()  # no obstacle is seen
    finally:
        venv.close()
    with pytest.raises(ValueError, match="scenes"):
        replace(config, scenes="hard")


def test_lying_postures_are_drawn_more_often_and_rates_are_weighed_back() -> None:
    names = [name for name, p in postures().items() for _ in range(1 if p.attitude.endswith("side") else 3)]
    drawn = Counter(scene_options(seed, EnvOptions({}, tuple(names)))["posture"] for seed in range(len(names)))
    lying = {name for name, p in postures().items() if not p.attitude.endswith("side")}
    assert {drawn[name] for name in lying} == {3} and {drawn[name] for name in set(postures()) - lying} == {1}
    common = {"both_arms_under": True, "exr": 1.0, "inr": 1.0, "steps": 5}
    episodes = [{"posture": "prone_crawl", "is_success": False, **common} for _ in range(3)]
    episodes.append({"posture": EASY_POSTURE, "is_success": True, **common})
    assert episode_summary(episodes, 3)["success"] == pytest.approx(0.5)
    assert episode_summary(episodes)["success"] == pytest.approx(0.25)
    assert np.isnan(episode_summary([])["success"])
    with pytest.raises(ValueError, match="lying_weight"):
        replace(METHODS["hrl_dcs"].config("smoke"), lying_weight=0)


def test_plain_goals_measure_from_where_the_state_is() -> None:
    seen = spaces.Box(-1.0, 1.0, (3,), np.float32)
    goals = PlainGoals(seen, spaces.Box(-2.0, 6.0, (1,), np.float32), lambda o: o[:, :2], reach=0.5)
    observations = np.array([[0.1, 0.2, 9.0]], np.float32)
    goals.update(observations, np.array([True]))
    subgoals = goals.subgoals(np.array([[1.0, -9.0]], np.float32))
    assert subgoals[0] == pytest.approx([0.6, -0.3])
    assert goals.distances(observations, subgoals)[0, 0] == pytest.approx(0.5 * 2**0.5)
    view = goals.view(observations, subgoals, np.array([0.4], np.float32))
    assert view[0] == pytest.approx([0.1, 0.2, 9.0, 0.6, -0.3, 0.5, -0.5, 0.4]) and view.shape[1] == goals.view_size
    acts = goals.actions_of(observations, np.array([[-5.0], [0.0], [1.0]], np.float32))
    assert acts[:, 0] == pytest.approx([-2.0, 2.0, 6.0])
    with pytest.raises(ValueError, match="action_space"):
        PlainGoals(seen, spaces.Box(-np.inf, np.inf, (1,), np.float32), lambda o: o, 1.0)
    with pytest.raises(ValueError, match="observation_space"):
        PlainGoals(spaces.Box(0.0, 1.0, (2, 2), np.float32), seen, lambda o: o, 1.0)
