"""Train and test the embedding observation module (P10), and hold policies on its estimates against the true state."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from lunar_rescue import sample_scene
from lunar_rescue.disturbances import NOTHING, Disturbance
from lunar_rescue.disturbed import DisturbedEnv
from lunar_rescue.scenes.splits import HELD_OUT, SPLITS, split_of
from reproduce.experiments.evaluate import find_policy, run_episode
from reproduce.experiments.pool import map_scenes, scene_seeds
from reproduce.experiments.rows import wilson
from reproduce.perception import measuring, training
from reproduce.perception.estimator import FOLDER, EstimatedEnv, load_embedding
from reproduce.storage.errors import UserError
from reproduce.storage.files import check_writable, locked, read_json, write_json
from reproduce.storage.provenance import provenance, write_table

TRUE, NOISY, ESTIMATED = "true state", "true state with noise", "estimated state"
STATES = (TRUE, NOISY, ESTIMATED)
EVALUATION = ("first_pictures.csv", "along_rescues.csv", "evaluation.json")
ALONG = 25  # scenes of an evaluation, for each thousand, that are acted out
_STATE: dict[str, Any] = {}


def train_embedding(
    actors: Sequence[str],
    out: Path,
    config: training.EmbeddingConfig,
    *,
    resume: bool = False,
    tell: Callable[[str], object] = print,
) -> None:
    """Train the embedding on frames of rescues by ``actors``, run folders or methods that do not learn."""
    policies = [find_policy(where)[1] for where in actors]
    training.train(config, policies, out, actors=actors, resume=resume, tell=tell)


def _prepare(folder: str, where: str | None, noise: dict[str, float] | None) -> None:
    import torch as th

    th.set_num_threads(1)
    _STATE["env"] = EstimatedEnv(load_embedding(Path(folder)))
    if where:
        _STATE["policy"] = find_policy(where)[1]
    if noise is not None:
        _STATE["noise"], _STATE["true"] = noise, DisturbedEnv()


def _look(seed: int) -> dict[str, Any]:
    return measuring.first_picture(_STATE["env"], seed)


def _along(seed: int) -> list[dict[str, Any]]:
    return measuring.rescue_pictures(_STATE["env"], _STATE["policy"], seed)


def _rescue(seed: int) -> list[dict[str, Any]]:
    """Act one scene out on each kind of state and return a row each."""
    scene, policy, rows = sample_scene(seed), _STATE["policy"], []
    for state in STATES:
        if state == ESTIMATED:
            row = run_episode(_STATE["env"], policy, scene)
        else:
            what = Disturbance(seed=seed, **_STATE["noise"]) if state == NOISY else NOTHING
            row = run_episode(_STATE["true"], policy, scene, disturbance=what)
        rows.append({"state": state, **row})
    return rows


def evaluate_embedding(
    tests: int,
    first_seed: int,
    *,
    folder: Path = FOLDER,
    where: str = "scripted",
    tell: Callable[[str], object] = print,
    quiet: bool = False,
) -> dict[str, Any]:
    """Test the embedding of a folder on first pictures of ``tests`` scenes and along rescues of some of them.

    Writes ``first_pictures.csv``, ``along_rescues.csv`` and ``evaluation.json`` into the folder (for held-out scenes
    ``heldout_`` before the names), and returns the summary. ``where`` says who acts, on estimates.

    Raises:
        UserError: On numbers out of range, weights that do not load, or a place that cannot be written.
    """
    seeds = scene_seeds(tests, first_seed)
    load_embedding(folder)
    paths = [folder / f"{_prefix(first_seed)}{name}" for name in EVALUATION]
    for path in paths:
        check_writable(path)
    with locked(folder, "evaluation of the embedding"):
        begun = time.monotonic()
        looked = pd.DataFrame(map_scenes(_look, seeds, _prepare, (str(folder), None, None), title="look", quiet=quiet))
        seconds, acted = time.monotonic() - begun, seeds[: max(1, tests * ALONG // 1000)]
        nested = map_scenes(_along, acted, _prepare, (str(folder), where, None), title="rescue", quiet=quiet)
        frames = pd.DataFrame([row for scene in nested for row in scene])
        told = {
            **{"split": split_of(first_seed), "first_seed": first_seed, "policy": where},
            "first_pictures": measuring.summarise_first(looked),
            "along_rescues": measuring.summarise_rescues(frames),
            **{"seconds_a_first_picture": round(seconds / tests, 4), "speed": speed(folder), "origin": provenance()},
        }
        for path, table in zip(paths, (looked, frames), strict=False):
            write_table(path, table.round(5))
        write_json(paths[-1], told)
    _tell(told, tell)
    return told


def _prefix(first_seed: int) -> str:
    """Return what names of files begin with: nothing, or what says that the scenes are held out."""
    return "heldout_" if split_of(first_seed) in HELD_OUT else ""


def speed(folder: Path = FOLDER, pictures: int = 100) -> dict[str, float]:
    """Measure milliseconds of a picture, of the embedding of one, and of a step of the environment on true states."""
    import numpy as np
    import torch as th

    th.set_num_threads(1)
    env, begin = EstimatedEnv(load_embedding(folder)), SPLITS["train"].start
    own, _ = env.reset_flat(options={"scene": sample_scene(begin)})
    calls: dict[str, Callable[[], object]] = {
        "picture_ms": lambda: env.head.look(env.episode),
        "embedding_ms": lambda: env.estimator.fill(env.sight, own, False),
        "step_with_both_ms": lambda: env.step_flat(np.zeros(11)),
    }
    result = {}
    for name, call in calls.items():
        begun = time.perf_counter()
        for _ in range(pictures):
            call()
        result[name] = round(1000 * (time.perf_counter() - begun) / pictures, 3)
    env.close()
    return {**result, "pictures_per_s": round(1000 / result["picture_ms"], 1)}


def compare_states(
    where: str | Path,
    tests: int,
    first_seed: int,
    *,
    folder: Path = FOLDER,
    json: Path | None = None,
    tell: Callable[[str], object] = print,
    quiet: bool = False,
) -> dict[str, Any]:
    """Test a policy on the same scenes on true states, with noise of the embedding's size, and on its estimates.

    Writes ``rescues_METHOD.csv``, a row a rescue, and ``rescues_METHOD.json`` into the embedding's folder.

    Raises:
        UserError: Where the embedding was not evaluated yet, or as ``evaluate`` does.
    """
    seeds, method = scene_seeds(tests, first_seed), find_policy(where)[0].name
    load_embedding(folder)
    noise = _measured_noise(folder)
    table, summary = (folder / f"{_prefix(first_seed)}rescues_{method}.{ending}" for ending in ("csv", "json"))
    for path in filter(None, (table, summary, json)):
        check_writable(path)
    arguments = (str(folder), str(where), noise)
    nested = map_scenes(_rescue, seeds, _prepare, arguments, title=f"states {method}", quiet=quiet)
    rows = pd.DataFrame([row for scene in nested for row in scene])
    told = {"method": method, "split": split_of(first_seed), "first_seed": first_seed, "noise": noise}
    told |= {"states": (table_of_states := summarise_states(rows)), "origin": provenance()}
    write_table(table, rows)
    for path in filter(None, (summary, json)):
        write_json(path, told)
    for row in table_of_states:
        rate, low, high = (100 * row[key] for key in ("success_rate", "wilson_low", "wilson_high"))
        tell(f"{row['state']}: {row['successes']} of {row['tests']}, {rate:.1f} % [{low:.1f}, {high:.1f}]")
    return told


def summarise_states(rows: pd.DataFrame) -> list[dict[str, Any]]:
    """Return success with Wilson's interval on each kind of state, and its share of that on the true state."""
    whole, table = int(rows.loc[rows["state"] == TRUE, "success"].sum()), []
    for state, group in rows.groupby("state", sort=False):
        tests, count = len(group), int(group["success"].sum())
        low, high = wilson(count, tests)
        counts = {"state": state, "tests": tests, "successes": count, "success_rate": count / tests}
        kept = count / whole if whole else None
        table.append({**counts, "wilson_low": low, "wilson_high": high, "of_true_state": kept})
    return table


def _measured_noise(folder: Path) -> dict[str, float]:
    """Return noise of the size of the embedding's errors, as its evaluation has them."""
    told = read_json(folder / "evaluation.json", "evaluation of the embedding (reproduce perceive evaluate)")
    try:
        return measuring.noise(told)
    except (KeyError, TypeError):
        raise UserError(f"{folder / 'evaluation.json'}: no evaluation of an embedding") from None


def _tell(told: dict[str, Any], tell: Callable[[str], object]) -> None:
    for name in ("first_pictures", "along_rescues"):
        part = told[name]
        words = f"{name.replace('_', ' ')}: posture right in {100 * part['posture_right']:.1f} %"
        words += f", centre {part['centre_cm_median']:.1f} cm, attitude {part['attitude_deg_median']:.1f} deg (medians)"
        if "rock_recall" in part:
            words += f", rocks: precision {part['rock_precision']:.3f}, recall {part['rock_recall']:.3f}"
        tell(words)
