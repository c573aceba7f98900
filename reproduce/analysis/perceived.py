"""What the camera sees and what the embedding makes of it: figures and sentences of notebook 8."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import seaborn as sns
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lunar_rescue import sample_scene
from lunar_rescue.arrays import Floats
from lunar_rescue.observation import SLICES
from lunar_rescue.physics.robot import WAIST
from lunar_rescue.pictures.head import HEIGHT, RANGE, WIDTH, pixels
from lunar_rescue.scenes.postures import postures
from lunar_rescue.scenes.suit import KEYPOINT_NAMES
from lunar_rescue.seeing import SeeingEnv
from reproduce.analysis.trainings import percent
from reproduce.experiments.evaluate import find_policy
from reproduce.experiments.methods import METHODS
from reproduce.experiments.perceive import ESTIMATED
from reproduce.perception.estimator import FOLDER, EstimatedEnv, load_embedding
from reproduce.perception.frames import rocks_shown
from reproduce.perception.measuring import ERRORS, errors, first_picture
from reproduce.storage.files import read_json

MISSING = "The embedding was not evaluated yet: `reproduce perceive train`, then `reproduce perceive evaluate`."
GOALS = {
    "posture_right": ("posture right", ">=", 0.97, "{:.1%}"),
    "centre_cm_median": ("centre of gravity, median [cm]", "<=", 3.0, "{:.2f}"),
    "attitude_deg_median": ("attitude, median [deg]", "<=", 5.0, "{:.2f}"),
    "rock_precision": ("rocks, precision", ">=", 0.9, "{:.3f}"),
    "rock_recall": ("rocks in view, recall", ">=", 0.9, "{:.3f}"),
}
KEPT = 0.85  # of its rescues on true states, at least, a policy is to keep on estimates
_BONES = ("head left_shoulder left_elbow left_hand", "head right_shoulder right_elbow right_hand",
          "left_shoulder left_hip left_knee left_foot", "right_shoulder right_hip right_knee right_foot",
          "left_hip right_hip", "left_shoulder right_shoulder")  # fmt: skip
_TRUE, _SEEN = "#35d07f", "#ff4fd8"


def is_trained(folder: Path = FOLDER) -> bool:
    """Tell whether a folder has weights and an evaluation of them."""
    return (folder / "policy.safetensors").is_file() and (folder / "evaluation.json").is_file()


def camera_views(count: int, first_seed: int) -> Figure:
    """Draw what the head camera sees first: colour, depth, and what is what in it, which the robot is not told."""
    figure, axes = plt.subplots(3, count, figsize=(2.6 * count, 6.0), layout="constrained", squeeze=False)
    with closing(SeeingEnv()) as env:
        for column in range(count):
            env.reset_flat(options={"scene": sample_scene(first_seed + column)})
            axes[0, column].imshow(env.sight.colour)
            axes[1, column].imshow(env.sight.depth / 1000, cmap="viridis", vmin=0.5, vmax=RANGE)
            axes[2, column].imshow(env.head.parts.clip(0, 3), cmap="Set2", vmin=0, vmax=7, interpolation="nearest")
            axes[0, column].set_title(env.episode.scene.posture.replace("_", " "), fontsize=9)
    for axis, name in zip(axes[:, 0], ("colour", "depth", "parts"), strict=True):
        axis.set_ylabel(name)
    for axis in axes.flat:
        axis.set(xticks=[], yticks=[])
    return figure


def skeletons(seed: int, count: int, where: str = "scripted", folder: Path = FOLDER) -> tuple[Figure, pd.DataFrame]:
    """Act out a rescue on estimates; return a strip of what is seen, key points drawn over it, and errors by step.

    Green is where body and rocks are, magenta where the embedding takes them to be.
    """
    frames, rows, policy, done = [], [], find_policy(where)[1], False
    with closing(EstimatedEnv(load_embedding(folder))) as env:
        observation, _ = env.reset_flat(options={"scene": sample_scene(seed)})
        while not done:
            frames.append(
                (env.sight.colour, float(env.episode.robot.angles[WAIST]), observation, env.truth, rocks_shown(env))
            )
            rows.append({"step": env.episode.steps, "process": env.episode.process, **errors(observation, env.truth)})
            action = policy.act(observation[None], np.array([env.episode.steps == 0]))[0]
            observation, _, terminated, truncated, _ = env.step_flat(action)
            done = terminated or truncated
    figure, axes = plt.subplots(2, -(-count // 2), figsize=(13, 5.4), layout="constrained")
    for axis, index in zip(axes.flat, np.linspace(0, len(frames) - 1, count).round().astype(int), strict=False):
        _draw(axis, *frames[index])
        axis.set_title(f"step {rows[index]['step']}, {rows[index]['centre_cm']:.1f} cm", fontsize=9)
    return figure, pd.DataFrame(rows)


def _draw(axis: Axes, colour: Any, waist: float, estimate: Floats, truth: Floats, rocks: Any) -> None:
    axis.imshow(colour, extent=(0, WIDTH, HEIGHT, 0))
    for observation, shade in ((truth, _TRUE), (estimate, _SEEN)):
        points = pixels(observation[SLICES["P_P"]][15:].reshape(-1, 3).astype(np.float64), waist)
        for bone in _BONES:
            index = [KEYPOINT_NAMES.index(name) for name in bone.split()]
            axis.plot(points[index, 0], points[index, 1], color=shade, lw=1.2, marker=".", ms=4)
    said = estimate[SLICES["P_E"]].reshape(-1, 5)
    tops = pixels(said[said[:, 4] > 0, :3].astype(np.float64).reshape(-1, 3), waist)
    axis.scatter(tops[:, 0], tops[:, 1], s=60, facecolors="none", edgecolors=_SEEN)
    y, x = np.nonzero(rocks)
    axis.scatter(x + 0.5, y + 0.5, s=1, color=_TRUE)
    axis.set(xlim=(0, WIDTH), ylim=(HEIGHT, 0), xticks=[], yticks=[])


def confusion(rows: pd.DataFrame) -> Figure:
    """Draw which posture is taken for which, in shares of the posture's first pictures."""
    table = pd.crosstab(rows["posture"], rows["recognised"], normalize="index")
    names = list(postures())
    own = [name for name in dict.fromkeys([*names, *sorted(rows["posture"].unique())]) if name in table.index]
    figure, axis = plt.subplots(figsize=(9, 0.35 * len(own) + 2), layout="constrained")
    shares = table.reindex(index=own, columns=names, fill_value=0.0)
    sns.heatmap(shares, ax=axis, cmap="rocket_r", vmin=0, vmax=1, cbar_kws={"label": "share"}, linewidths=0.3)
    axis.set(xlabel="recognised", ylabel="posture")
    return figure


def along_rescues(rows: pd.DataFrame) -> Figure:
    """Draw medians and nine tenths of the errors along rescues, and the errors by how much of the suit is hidden."""
    figure, axes = plt.subplots(1, 2, figsize=(12, 4), layout="constrained")
    for name, label in (("centre_cm", "centre of gravity [cm]"), ("attitude_deg", "attitude [deg]")):
        middle, high = (rows.groupby("step")[name].quantile(share) for share in (0.5, 0.9))
        axes[0].plot(middle.index, middle, label=label)
        axes[0].fill_between(middle.index, middle, high, alpha=0.2)
    axes[0].set(xlabel="step", ylabel="median, up to the 90th percentile", ylim=(0, None))
    axes[0].legend()
    band = (10 * rows["hidden"]).clip(0, 9).astype(int)
    sns.boxplot(x=10 * band, y=rows["centre_cm"], ax=axes[1], showfliers=False)
    axes[1].set(xlabel="suit hidden by the arms, from [%]", ylabel="centre of gravity [cm]")
    return figure


def worst(rows: pd.DataFrame, count: int, folder: Path = FOLDER) -> Figure:
    """Draw the first pictures whose key points are furthest off, with what was seen in them."""
    figure, axes = plt.subplots(1, count, figsize=(3.2 * count, 3.0), layout="constrained", squeeze=False)
    with closing(EstimatedEnv(load_embedding(folder))) as env:
        for axis, seed in zip(axes[0], rows.nlargest(count, "keypoints_cm")["seed"], strict=True):
            row = first_picture(env, int(seed))
            estimate = env.estimator.fill(env.sight, env.truth.copy(), True)
            _draw(axis, env.sight.colour, 0.0, estimate, env.truth, rocks_shown(env))
            words = f"{row['posture']}\nas {row['recognised']}, {row['keypoints_cm']:.0f} cm"
            axis.set_title(words.replace("_", " "), fontsize=8)
    return figure


def goals(folder: Path = FOLDER) -> pd.DataFrame:
    """Return what was measured of first pictures and of rescues beside what was asked for; empty where nothing was.

    Nothing was asked of held-out scenes, whose postures are none that can be recognised.
    """
    table = []
    for name, path in (("validation", "evaluation.json"), ("validation-heldout", "heldout_evaluation.json")):
        if (folder / path).is_file():
            told = read_json(folder / path, "evaluation of the embedding")["first_pictures"]
            asked = [key for key in GOALS if name == "validation" or key != "posture_right"]
            table += [_goal(name, told[key], *GOALS[key]) for key in asked]
    for told, line in _compared(folder):
        if line["state"] == ESTIMATED and (kept := line["of_true_state"]) is not None:
            words = f"rescues kept on estimates, {METHODS[told['method']].title}"
            table.append(_goal(told["split"], kept, words, ">=", KEPT, "{:.1%}"))
    return pd.DataFrame(table, columns=["scenes", "what", "measured", "asked", "met"])


def _goal(scenes: str, value: float, words: str, sign: str, goal: float, form: str) -> dict[str, str]:
    """Return the row of a figure, which is held to its goal on validation scenes alone."""
    row = {"scenes": scenes, "what": words, "measured": form.format(value), "asked": "", "met": ""}
    if scenes == "validation":
        met = value >= goal if sign == ">=" else value <= goal
        row |= {"asked": f"{sign} {form.format(goal)}", "met": "yes" if met else "no"}
    return row


def occlusion(folder: Path = FOLDER) -> pd.DataFrame:
    """Return shares of right postures and medians of errors along rescues by what the arms hide of the suit."""
    if not is_trained(folder):
        return pd.DataFrame()
    bands = read_json(folder / "evaluation.json", "evaluation of the embedding")["along_rescues"]["by_occlusion"]
    hidden = [f"{100 * band['hidden_from']:.0f} to {100 * band['hidden_to']:.0f} %" for band in bands]
    return pd.DataFrame(bands, index=pd.Index(hidden, name="hidden"))[["pictures", "posture_right", *ERRORS]].round(2)


def states(folder: Path = FOLDER) -> pd.DataFrame:
    """Return success on true, noisy and estimated states of each policy that was compared; may be empty."""
    table = []
    for told, row in _compared(folder):
        success = percent(row["success_rate"], (row["wilson_low"], row["wilson_high"]))
        place = {"policy": told["method"], "scenes": told["split"], "acts on": row["state"], "tests": row["tests"]}
        kept = "" if row["of_true_state"] is None else f"{row['of_true_state']:.1%}"
        table.append({**place, "success": success, "of true state": kept})
    return pd.DataFrame(table, columns=["policy", "scenes", "acts on", "tests", "success", "of true state"])


def _compared(folder: Path) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
    """Yield each comparison of states, and the row of each state in it."""
    for path in sorted(folder.glob("*rescues_*.json")):
        told = read_json(path, "comparison of states")
        yield from ((told, row) for row in told["states"])


def rows_of(name: str, folder: Path = FOLDER) -> pd.DataFrame:
    """Return the rows of an evaluation, ``first_pictures`` or ``along_rescues``; empty where there are none."""
    path = folder / f"{name}.csv"
    return pd.read_csv(path) if path.is_file() else pd.DataFrame()


def in_words(rows: pd.DataFrame) -> str:
    """Say how the errors along one rescue go."""
    process = rows.groupby("process")[["centre_cm", "attitude_deg"]].median()
    said = [
        f"in process {p}: {row['centre_cm']:.1f} cm, {row['attitude_deg']:.1f} deg" for p, row in process.iterrows()
    ]
    return f"Medians over {len(rows)} pictures, " + "; ".join(said) + "."
