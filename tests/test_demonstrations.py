"""Demonstrations: stored, refused, played back as they were; imitation on cases worked by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from safetensors.torch import load_file, save_file

from lunar_rescue import LunarRescueEnv, RewardWeights, sample_scene
from lunar_rescue.observation import SIZE, SLICES
from lunar_rescue.physics.robot import JOINTS
from reproduce.baselines.planner.planner import RescuePlanner
from reproduce.baselines.planner.rollout import Noise
from reproduce.experiments.demonstrate import demonstrate, demonstrate_scene
from reproduce.hrl_dcs.config import GoalConfig
from reproduce.hrl_dcs.hindsight import commanded, lln_example, reached, sgn_examples
from reproduce.hrl_dcs.policy import HighLevel
from reproduce.hrl_dcs.subgoals import RescueGoals
from reproduce.learning import playback_files
from reproduce.learning.actions import LARGEST_CHANGE, to_environment, to_outputs
from reproduce.learning.config import ImitationConfig, PriorConfig
from reproduce.learning.demonstrations import (
    Demonstration,
    PlayedBack,
    play_back,
    read_demonstrations,
    write_demonstrations,
)
from reproduce.learning.imitation import Example, Imitation, evaluate, imitation_losses
from reproduce.learning.networks import Memory, NetworkSpec
from reproduce.learning.playback_files import play_back_once
from reproduce.storage.errors import UserError

Floats = np.ndarray


def _demonstration(seed: int, steps: int, begin: int = 0) -> Demonstration:
    rng = np.random.default_rng(seed)
    actions, wanted = rng.uniform(-1, 1, (2, steps, JOINTS)).astype(np.float32)
    return Demonstration(seed, actions, wanted, begin)


def test_demonstrations_are_read_as_they_were_written(tmp_path: Path) -> None:
    written, path = [_demonstration(5, 3), _demonstration(1_999_999_999, 7, 2)], tmp_path / "x.safetensors"
    write_demonstrations(path, written, {"scenes": "2"})
    read, header = read_demonstrations(path)
    assert [(d.seed, d.begin) for d in read] == [(5, 0), (1_999_999_999, 2)] and header["scenes"] == "2"
    for one, other in zip(written, read, strict=True):
        np.testing.assert_array_equal(one.actions, other.actions)
        np.testing.assert_array_equal(one.wanted, other.wanted)


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"header": {"format": "pictures"}}, "format: expected 'lunar-rescue demonstrations 1', got 'pictures'"),
        ({"header": {"environment_version": "1.0"}}, "environment_version: expected '2.0', got '1.0'"),
        ({"seeds": th.tensor([5, 2_000_000_000])}, "seeds: expected training scenes"),
        ({"seeds": th.tensor([5])}, "lengths: expected shape (1,), got (2,)"),
        ({"lengths": th.tensor([3, 8])}, "actions: expected shape (11, 11), got (10, 11)"),
        ({"begins": th.tensor([0, 7])}, "begins"),
        ({"actions": th.full((10, 11), 1.5)}, "actions: expected numbers in [-1, 1]"),
        ({"actions": th.full((10, 11), th.nan)}, "not finite"),
        ({"wanted": th.zeros(10, 11).double()}, "of their types"),
        ({"more": th.zeros(1)}, "expected tensors seeds, lengths"),
    ],
)
def test_foreign_files_are_refused_in_one_line(changes: dict[str, Any], word: str, tmp_path: Path) -> None:
    path = tmp_path / "x.safetensors"
    write_demonstrations(path, [_demonstration(5, 3), _demonstration(6, 7)], {})
    header = {"format": "lunar-rescue demonstrations 1", "environment_version": "2.0", **changes.pop("header", {})}
    save_file({**load_file(path), **changes}, path, metadata=header)
    with pytest.raises(UserError) as error:
        read_demonstrations(path)
    assert word in str(error.value) and str(path) in str(error.value) and "\n" not in str(error.value)


def test_cut_files_are_refused_and_stay(tmp_path: Path) -> None:
    path = tmp_path / "x.safetensors"
    write_demonstrations(path, [_demonstration(5, 3)], {})
    path.write_bytes(whole := path.read_bytes()[:-1])
    for call in (lambda: read_demonstrations(path), lambda: demonstrate(1, path, quiet=True)):
        with pytest.raises(UserError, match="not a readable safetensors file"):
            call()
    assert path.read_bytes() == whole
    with pytest.raises(UserError, match="scenes: expected at least 1"):
        demonstrate(0, path)
    with pytest.raises(UserError, match="first seed: expected training scenes"):
        demonstrate(1, path, first_seed=2_000_000_000)


def test_outputs_are_the_inverse_of_actions() -> None:
    rng = np.random.default_rng(0)
    observations = rng.uniform(-0.3, 0.3, (50, SIZE)).astype(np.float32)
    outputs = rng.uniform(-1, 1, (50, JOINTS)).astype(np.float32)
    np.testing.assert_allclose(to_outputs(observations, to_environment(observations, outputs)), outputs, atol=1e-5)
    far = to_outputs(observations, np.ones((50, JOINTS), np.float32))
    assert (far == 1.0).all()  # further than a step can go


def test_noise_has_its_deviation_and_its_memory() -> None:
    noise = Noise(np.random.default_rng(0), 0.02)
    drawn = np.array([noise.draw() for _ in range(4000)])
    assert drawn.std() == pytest.approx(0.02, rel=0.03)
    assert np.mean(drawn[1:] * drawn[:-1]) / 0.02**2 == pytest.approx(0.7, abs=0.03)


@pytest.fixture(scope="module")
def rescues() -> list[Demonstration]:
    planner = RescuePlanner()
    made = demonstrate_scene(1_500_000_003, planner, (0.1, 0.1))
    planner.close()
    return made


def test_what_was_wanted_under_noise_is_not_what_was_done(rescues: list[Demonstration]) -> None:
    plain, *noisy = rescues
    np.testing.assert_array_equal(plain.actions, plain.wanted)
    for one in noisy:
        away = one.actions - one.wanted
        assert 0.3 < away.std() / (0.1 * LARGEST_CHANGE) < 2.0


def test_a_rescue_is_played_back_as_it_was_seen(rescues: list[Demonstration], env: LunarRescueEnv) -> None:
    (played,) = play_back(rescues[:1], weights=RewardWeights(), gamma=0.5, mirrored=False, workers=1)
    seen, _ = env.reset_flat(options={"scene": sample_scene(rescues[0].seed)})
    rewards = []
    for step, action in enumerate(rescues[0].actions):
        np.testing.assert_array_equal(played.observations[step], seen)
        sent = to_environment(seen[None], played.outputs[step : step + 1])[0]
        whole = np.abs(played.outputs[step]) < 1.0  # what is further away than a step can go is cut
        np.testing.assert_allclose(sent[whole], action[whole], atol=2e-5)
        assert (np.sign(action - sent)[~whole] * np.sign(played.outputs[step])[~whole] >= 0).all()
        seen, reward, *_ = env.step_flat(action)
        rewards.append(reward)
    assert (np.abs(played.outputs) < 1.0).mean() > 0.5
    assert played.returns[-2] == pytest.approx(rewards[-2] + 0.5 * rewards[-1], abs=1e-5)
    cut = replace(rescues[0], actions=rescues[0].actions[:-1], wanted=rescues[0].wanted[:-1])
    with pytest.raises(UserError, match="1 of 1 do not end in a rescue"):
        play_back([cut], weights=RewardWeights(), workers=1)


def test_demonstrations_are_played_back_once_for_a_view(
    rescues: list[Demonstration], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    view = {"weights": RewardWeights(), "gamma": 0.5, "mirrored": True}
    first, seconds = play_back_once(tmp_path, rescues, **view)
    assert seconds > 0

    def play_again(*args: Any, **kwargs: Any) -> list[PlayedBack]:
        raise RuntimeError("played again")

    monkeypatch.setattr(playback_files, "play_back", play_again)
    again, counted = play_back_once(tmp_path, rescues, **view)
    assert counted == seconds and len(again) == len(first)
    for one, other in zip(first, again, strict=True):
        for name, value in vars(one).items():
            np.testing.assert_array_equal(value, getattr(other, name), strict=True)
    (file,) = tmp_path.glob("played_*.safetensors")
    for changed_view, some in ((view | {"gamma": 0.9}, rescues), (view, rescues[:1])):
        with pytest.raises(RuntimeError, match="played again"):
            play_back_once(tmp_path, some, **changed_view)
    file.write_bytes(file.read_bytes()[:-100])
    with pytest.raises(RuntimeError, match="played again"):
        play_back_once(tmp_path, rescues, **view)


@pytest.mark.process
def test_a_file_is_gone_on_with_where_it_ends(tmp_path: Path) -> None:
    path, lines = tmp_path / "x.safetensors", list[str]()
    kind: Any = {"first_seed": 1_500_000_003, "deviations": (), "tell": lines.append, "quiet": True}
    first, _ = demonstrate(1, path, **kind)
    both, seconds = demonstrate(2, path, **kind)
    assert seconds > 0
    assert [d.seed for d in first] == [1_500_000_003] and [d.seed for d in both] == [1_500_000_003, 1_500_000_004]
    assert "2 rescues of 2 scenes" in lines[1]
    with pytest.raises(UserError, match=r"deviations: holds those of \[\], not of \[0.3\]"):
        demonstrate(3, path, **{**kind, "deviations": (0.3,)})


def _examples(count: int, rng: np.random.Generator) -> list[Example]:
    """Return episodes in which the outputs are what the first observations were one step before."""
    examples = []
    for _ in range(count):
        seen = rng.uniform(-1, 1, (int(rng.integers(4, 9)), 6)).astype(np.float32)
        wanted = np.concatenate([np.zeros((1, 2), np.float32), 0.5 * seen[:-1, :2]]).astype(np.float32)
        examples.append(Example(seen, wanted, seen.sum(axis=1)))
    return examples


def test_only_steps_that_count_enter_the_loss() -> None:
    network = NetworkSpec(6, 2, 16, False).build()
    rng = np.random.default_rng(0)
    long, short = _examples(2, rng)
    long = Example(np.tile(long.observations, (3, 1))[:9], np.zeros((9, 2), np.float32), np.zeros(9, np.float32), 4)
    with th.no_grad():
        both = imitation_losses(network, [long, short])
        means, values = evaluate(network, th.from_numpy(long.observations)[:, None])
        others, worth = evaluate(network, th.from_numpy(short.observations)[:, None])
    away = np.concatenate([(means[4:, 0].numpy() ** 2).ravel(), ((others[:, 0].numpy() - short.outputs) ** 2).ravel()])
    assert float(both[0]) == pytest.approx(away.mean(), rel=1e-5)
    off = np.concatenate([values[4:, 0].numpy() ** 2, (worth[:, 0].numpy() - short.returns) ** 2])
    assert float(both[1]) == pytest.approx(off.mean(), rel=1e-5)


def test_whole_episodes_are_put_out_as_they_are_when_acting_step_by_step() -> None:
    network = NetworkSpec(6, 2, 16, False).build()
    seen = np.random.default_rng(0).uniform(-1, 1, (5, 3, 6)).astype(np.float32)
    memory = Memory(network, 3)
    acted = np.array([memory.act(step, np.arange(3)) for step in seen])
    with th.no_grad():
        means, _ = evaluate(network, th.from_numpy(seen))
    np.testing.assert_allclose(np.clip(means.numpy(), -1, 1), acted, atol=1e-5)


@pytest.mark.process
def test_a_network_learns_what_needs_a_memory() -> None:
    th.manual_seed(0)
    network, rng = NetworkSpec(6, 2, 32, False).build(), np.random.default_rng(0)
    config = ImitationConfig(epochs=60, episodes=16, learning_rate=1e-2)
    imitation = Imitation(network, _examples(200, rng), config, 0)
    losses = [imitation.epoch() for _ in range(60)]
    assert losses[0]["imitation_loss"] > 0.05 and losses[-1]["value_loss"] < losses[0]["value_loss"]
    with th.no_grad():
        assert float(imitation_losses(network, _examples(50, rng))[0]) < 0.01


def _played(ends: Any, begin: int = 0) -> PlayedBack:
    """Return a demonstration whose arm ends are known, (t, 6) [m], and nothing else."""
    observations = np.zeros((len(ends), SIZE), np.float32)
    for arm, columns in (("P_A", slice(0, 3)), ("P_B", slice(3, 6))):
        at = SLICES[arm].start + 15
        observations[:, at : at + 3] = ends[:, columns]
    outputs = np.full((len(ends), JOINTS), 0.25, np.float32)
    return PlayedBack(
        observations, outputs, outputs, np.zeros(len(ends), np.float32), np.arange(len(ends), dtype=np.float32), begin
    )


def test_hindsight_sub_goals_are_where_the_arms_were_n_steps_later() -> None:
    ends = np.repeat(0.1 * np.arange(7)[:, None], 6, axis=1).astype(np.float32)  # 0.1 m a step
    assert reached(ends, 3)[:, 0] == pytest.approx([0.3, 0.3, 0.3, 0.6, 0.6, 0.6, 0.6])
    goals = RescueGoals(GoalConfig(reach=0.5, seen="place"), PriorConfig())
    first, second, third = sgn_examples(goals, _played(ends, begin=4), 3)
    # From 0, 0.3 and 0.6 m to 0.3, 0.6 and 0.6 m (the end), in units of 0.5 m; then from 0.1 m on, and from 0.2 m.
    assert first.outputs[:, 0] == pytest.approx([0.6, 0.6, 0.0]) and first.returns == pytest.approx([0, 3, 6])
    assert second.outputs[:, 0] == pytest.approx([0.6, 0.4]) and third.outputs[:, 5] == pytest.approx([0.6, 0.2])
    assert (first.begin, second.begin, third.begin) == (2, 1, 1)  # the first decisions at step 4 or later
    example = lln_example(goals, _played(ends, begin=4), reached(ends, 3))
    assert example.observations.shape == (7, SIZE + 6) and example.begin == 4
    assert example.observations[3, SIZE:] == pytest.approx([0.6] * 6) and (example.outputs == 0.25).all()


def test_lln_also_learns_under_the_sub_goals_that_sgn_sets() -> None:
    goals, interval = RescueGoals(GoalConfig(), PriorConfig()), 3
    sgn = NetworkSpec(SIZE, 6, 16, True).build()
    sgn.set_training_mode(False)
    rng = np.random.default_rng(0)
    played = [_played(rng.uniform(0, 1, (steps, 6)).astype(np.float32)) for steps in (5, 8)]
    for one, subgoals in zip(played, commanded(sgn, goals, played, interval), strict=True):
        high = HighLevel(sgn, goals, interval, 1)
        for step, row in enumerate(one.observations):
            high.advance(row[None], np.array([step == 0]))
            assert subgoals[step] == pytest.approx(high.subgoals[0], abs=1e-5)
        assert (subgoals[0] == subgoals[2]).all() and (subgoals[2] != subgoals[3]).any()
