"""Demonstrations: rescues as scene seeds and actions, which the environment plays back into what a learner sees.

A rescue repeats exactly from its scene and its actions, so no observation is stored. What was done is kept beside what
the demonstrator wanted: under noise the two differ, and the second is what a learner should imitate.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from safetensors import safe_open
from safetensors.torch import save_file

from lunar_rescue import ENVIRONMENT_VERSION, LunarRescueEnv, sample_scene
from lunar_rescue.physics.robot import JOINTS
from lunar_rescue.rewards import RewardWeights
from lunar_rescue.scenes.splits import TRAIN
from reproduce.learning.actions import to_outputs
from reproduce.learning.config import PlacesConfig
from reproduce.learning.mirror import Mirror
from reproduce.learning.way_in import WayIn
from reproduce.storage.errors import UserError
from reproduce.storage.files import write_atomically
from reproduce.storage.policies import read_tensors
from reproduce.storage.processes import map_in_processes

Floats = NDArray[np.float32]

FORMAT = "lunar-rescue demonstrations 1"
LARGEST = 500_000_000  # bytes of a file
FEW = 16
#: Tensors of a file: of each demonstration seed, number of steps and first step to imitate, then all steps end to end.
TENSORS = {"seeds": th.int64, "lengths": th.int64, "begins": th.int64, "actions": th.float32, "wanted": th.float32}


@dataclass(frozen=True)
class Demonstration:
    """One rescue that succeeded."""

    seed: int  # of its scene, a training scene
    actions: Floats  # what was done (steps, 11), Eq. 3's actions
    wanted: Floats  # what the demonstrator wanted (steps, 11)
    begin: int = 0  # first step to imitate; a recovery begins where somebody else had led


@dataclass(frozen=True)
class PlayedBack:
    """A demonstration as a learner would have seen it, in its own view (``reproduce.learning.mirror``)."""

    observations: Floats  # (steps, SIZE), or more with the way in
    outputs: Floats  # what the network should put out (steps, 11), in [-1, 1]
    taken: Floats  # outputs that lead to what was done (steps, 11), which noise made of ``outputs``
    rewards: Floats  # the environment's (steps,)
    returns: Floats  # discounted sum of the environment's rewards from each step on (steps,)
    begin: int  # first step to imitate


def write_demonstrations(path: Path, demonstrations: Sequence[Demonstration], about: dict[str, str]) -> None:
    """Write demonstrations into one safetensors file; ``about`` goes into its header."""
    columns: dict[str, Any] = {
        "seeds": [d.seed for d in demonstrations],
        "lengths": [len(d.actions) for d in demonstrations],
        "begins": [d.begin for d in demonstrations],
    }
    columns |= {
        name: np.concatenate([np.zeros((0, JOINTS), np.float32), *(getattr(d, name) for d in demonstrations)])
        for name in ("actions", "wanted")
    }
    tensors = {name: th.from_numpy(np.asarray(columns[name])).to(kind) for name, kind in TENSORS.items()}
    header = {**about, "format": FORMAT, "environment_version": ENVIRONMENT_VERSION}
    write_atomically(path, lambda temporary: save_file(tensors, temporary, metadata=header))


def read_demonstrations(path: Path) -> tuple[list[Demonstration], dict[str, str]]:
    """Read and check a file of demonstrations; return them and the file's header.

    Raises:
        UserError: One line that names the file and what is wrong: no such file, another format or environment, tensors
            that are cut or do not fit together, seeds that are not training scenes, actions out of range.
    """
    tensors = read_tensors(path, LARGEST)
    with safe_open(path, framework="pt") as file:
        header = dict(file.metadata() or {})
    for key, expected in (("format", FORMAT), ("environment_version", ENVIRONMENT_VERSION)):
        if header.get(key) != expected:
            raise UserError(f"{path}: {key}: expected {expected!r}, got {header.get(key)!r:.60}")
    if {name: tensor.dtype for name, tensor in tensors.items()} != TENSORS:
        raise UserError(f"{path}: expected tensors {', '.join(TENSORS)} of their types, got {', '.join(tensors)}")
    seeds, lengths, begins, actions, wanted = (tensors[name].numpy() for name in TENSORS)
    count, steps = len(seeds), int(lengths.sum())
    shapes = {"lengths": (count,), "begins": (count,), "actions": (steps, JOINTS), "wanted": (steps, JOINTS)}
    for name, shape in shapes.items():
        if tuple(tensors[name].shape) != shape:
            raise UserError(f"{path}: {name}: expected shape {shape}, got {tuple(tensors[name].shape)}")
    if not all(seed in TRAIN for seed in seeds.tolist()):
        raise UserError(f"{path}: seeds: expected training scenes, {TRAIN.start} to {TRAIN.stop - 1}")
    if not ((lengths > 0) & (begins >= 0) & (begins < lengths)).all():
        raise UserError(f"{path}: begins: expected steps of their demonstrations")
    if steps and max(np.abs(actions).max(), np.abs(wanted).max()) > 1.0:
        raise UserError(f"{path}: actions: expected numbers in [-1, 1]")
    ends = np.cumsum(lengths)[:-1]
    rows = zip(seeds, np.split(actions, ends), np.split(wanted, ends), begins, strict=True)
    return [Demonstration(int(seed), done, label, int(begin)) for seed, done, label, begin in rows], header


_STATE: dict[str, Any] = {}


def _prepare(weights: RewardWeights, gamma: float, mirrored: bool, places: PlacesConfig | None) -> None:
    _STATE.update(env=LunarRescueEnv(weights=weights), gamma=gamma, mirrored=mirrored, places=places)


def _play(demonstration: Demonstration) -> PlayedBack | None:
    env, mirror, way = _STATE["env"], Mirror(1), WayIn(1, _STATE["places"])
    seen, _ = env.reset_flat(options={"scene": sample_scene(demonstration.seed)})
    if _STATE["mirrored"]:
        mirror.begin(seen[None], np.ones(1, bool))
    observations, rewards, success = [], [], False
    for action in demonstration.actions:
        observations.append(way.view(mirror.observations(seen[None]))[0])
        seen, reward, _, _, info = env.step_flat(action)
        rewards.append(reward)
        success = info["is_success"]
    if not success:
        return None
    returns = np.zeros(len(rewards), np.float32)
    total = 0.0
    for step in reversed(range(len(rewards))):
        total = rewards[step] + _STATE["gamma"] * total
        returns[step] = total
    views = np.array(observations)
    wanted, taken = (mirror_rows(mirror, rows) for rows in (demonstration.wanted, demonstration.actions))
    told = np.array(rewards, np.float32)
    return PlayedBack(views, to_outputs(views, wanted), to_outputs(views, taken), told, returns, demonstration.begin)


def mirror_rows(mirror: Mirror, actions: Floats) -> Floats:
    """Return the actions (steps, 11) of one environment as its learner sees them."""
    return np.concatenate([mirror.actions(action[None]) for action in actions])


def play_back(
    demonstrations: Iterable[Demonstration],
    *,
    weights: RewardWeights,
    gamma: float = 0.99,
    mirrored: bool = True,
    places: PlacesConfig | None = None,
    workers: int | None = None,
) -> list[PlayedBack]:
    """Let the environment play demonstrations back, in as many processes as there are cores.

    Args:
        demonstrations: What to play back.
        weights: Of the environment's reward, whose returns a critic learns.
        gamma: Discount of the returns.
        mirrored: Whether the learner sees scenes through ``reproduce.learning.mirror``.
        places: To where the learner sees the way, see ``reproduce.learning.way_in``; None leaves it out.
        workers: Number of processes; None is one a core.

    Raises:
        UserError: Where one does not end in a rescue: the file is not of this environment.
    """
    everything, how = list(demonstrations), (weights, gamma, mirrored, places)
    if len(everything) <= FEW:  # starting processes would take longer
        _prepare(*how)
        played = list(map(_play, everything))
        _STATE.pop("env").close()
    else:
        played = map_in_processes(_play, everything, workers, _prepare, how)
    failed = sum(one is None for one in played)
    if failed:
        raise UserError(f"demonstrations: {failed} of {len(played)} do not end in a rescue when they are played back")
    return [one for one in played if one is not None]
