"""Figures of the notebooks; each takes data and returns a Matplotlib figure."""

import dataclasses
import textwrap
from collections.abc import Sequence
from contextlib import closing

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import seaborn as sns
from matplotlib.figure import Figure
from numpy.typing import NDArray

from lunar_rescue import RewardWeights, Scene, postures, rewards, sample_scene
from lunar_rescue.disturbances import KINDS
from lunar_rescue.env import LunarRescueEnv
from lunar_rescue.episode import Episode
from lunar_rescue.pictures.camera import GALLERY_TURN, TURN, scene_camera
from lunar_rescue.pictures.overlay import draw_overlay
from lunar_rescue.pictures.rendering import Studio
from lunar_rescue.scenes.postures import all_postures
from lunar_rescue.scenes.rocks import rock_marks
from lunar_rescue.scenes.scene import body_surface
from reproduce.analysis.trainings import smooth
from reproduce.experiments.methods import METHODS
from reproduce.experiments.stress import NONE

sns.set_theme(context="notebook", style="whitegrid")


def posture_gallery() -> Figure:
    """Draw P8, a picture of each of the 20 postures, from beyond the body, without rocks."""
    scenes = [(name, dataclasses.replace(sample_scene(0, posture=name), rocks=())) for name in postures()]
    return picture_grid(first_pictures(scenes, GALLERY_TURN, astronaut=True), columns=5)


def training_environments(count: int = 16, first_seed: int = 0) -> Figure:
    """Draw F4, as many environments as train together, in one picture."""
    scenes = [(f"agent {i + 1}", sample_scene(first_seed + i)) for i in range(count)]
    return picture_grid(first_pictures(scenes), columns=4)


def grounds(count: int = 4, first_seed: int = 0) -> Figure:
    """Draw unstructured ground: level, then rough from gentle to steep, with rocks."""
    scenes = [scene for scene in (sample_scene(first_seed + i) for i in range(200)) if len(scene.rocks) >= 3]
    level = next(scene for scene in scenes if not scene.terrain.rough)
    rough = sorted((scene for scene in scenes if scene.terrain.rough), key=lambda scene: scene.terrain.slope)
    steps = np.linspace(0, len(rough) - 1, count - 1).round().astype(int)
    panels = [("level", level)] + [(f"slope {rough[i].terrain.slope:.0f}°", rough[i]) for i in steps]
    return picture_grid(first_pictures([(f"{t}, {len(s.rocks)} rocks", s) for t, s in panels], size=(480, 352)), count)


def watched_distances(episode: Episode, size: tuple[int, int] = (720, 528)) -> NDArray[np.uint8]:
    """Return F2 as a picture, (height, width, 3): targets, mark points and the distances that rewards are made of."""
    camera = scene_camera(episode.scene, size)
    with closing(Studio()) as studio:
        return draw_overlay(studio.picture(episode, camera), episode, camera)


def first_pictures(
    scenes: Sequence[tuple[str, Scene]], turn: float = TURN, astronaut: bool = False, size: tuple[int, int] = (320, 240)
) -> list[tuple[str, NDArray[np.uint8]]]:
    """Return each title with a picture, ``size`` (width, height) [px], of its scene's beginning.

    The camera stands ``turn`` [deg] beside the line from robot to astronaut; ``astronaut`` has it look at them alone.
    """
    pictures = []
    with closing(LunarRescueEnv()) as env, closing(Studio()) as studio:
        for title, scene in scenes:
            env.reset(options={"scene": scene})
            camera = scene_camera(scene, size, turn)
            if astronaut:
                place = (scene.astronaut_x, scene.astronaut_y, 0.30)
                camera = dataclasses.replace(camera, target=place, distance=0.85 * camera.distance)
            pictures.append((title, studio.picture(env.episode, camera)))
    return pictures


def picture_grid(pictures: Sequence[tuple[str, NDArray[np.uint8]]], columns: int) -> Figure:
    """Draw pictures with their titles in a grid."""
    rows = -(-len(pictures) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(3.0 * columns, 2.5 * rows), layout="constrained", squeeze=False)
    figure.get_layout_engine().set(w_pad=0.02, h_pad=0.02, wspace=0, hspace=0)  # type: ignore[union-attr, call-arg]
    for axis in axes.flat:
        axis.axis("off")
    for axis, (title, image) in zip(axes.flat, pictures, strict=False):
        axis.imshow(image, interpolation="antialiased")
        axis.set_title(title.replace("_", " "), fontsize=9)
    return figure


def reward_terms(weights: RewardWeights, max_steps: int) -> Figure:
    """Draw P5, each term of Eq. 2 over its argument."""
    figure, axes = plt.subplots(2, 2, figsize=(10, 7), layout="constrained")
    change, distance = np.linspace(-0.5, 0.5, 201), np.linspace(0.01, 1.0, 200)
    moved, steps = np.linspace(0, 1.6, 50), np.arange(0, max_steps + 1)
    for form in ("literal", "signed"):
        values = [rewards.approach(1.0, 1.0 - c, beta=weights.beta, form=form) for c in change]
        axes[0, 0].plot(change, values, label=form)
    axes[0, 0].legend()
    axes[0, 1].plot(distance, [rewards.obstacle_avoidance(d[None], rho=weights.rho, xi=weights.xi) for d in distance])
    axes[1, 0].plot(moved, [rewards.joint_motion(m[None], varphi=weights.varphi) for m in moved])
    axes[1, 1].plot(steps, [weights.time_bonus * rewards.time_bonus(int(s), max_steps) for s in steps])
    labels = {
        "approach": "D_m - D [m]",
        "obstacle avoidance (AAPF), one joint and one mark": "D [m]",
        "joint motion": "sum of |joint changes| in a step [rad]",
        "time bonus at completion": "steps",
    }
    for axis, (title, label) in zip(axes.flat, labels.items(), strict=True):
        axis.set(title=title, xlabel=label, ylabel="reward")
    axes[1, 1].set(ylim=(0, None))
    return figure


def aapf_field(scene: Scene, joints: NDArray[np.float64], weights: RewardWeights, height: float = 0.05) -> Figure:
    """Draw F2, the AAPF term of one point moved over the ground at ``height`` [m], with mark points and the body.

    The scene has at least one rock; ``joints`` are positions of both arms (12, 3) [m].
    """
    marks = rock_marks(scene.rocks)
    line = np.linspace(-1.3, 1.3, 121)  # m, round the astronaut
    x, y = np.meshgrid(scene.astronaut_x + line, scene.astronaut_y + line)
    points = np.stack([x, y, np.full_like(x, height)], axis=-1)
    distances = np.linalg.norm(points[:, :, None, :] - marks, axis=-1) + 1e-3
    field = -weights.rho * np.log((weights.xi / distances).sum(axis=-1) + 1.0)
    figure, axis = plt.subplots(figsize=(8, 6.5), layout="constrained")
    mesh = axis.pcolormesh(x, y, field, cmap="magma", shading="auto")
    figure.colorbar(mesh, ax=axis, label="obstacle avoidance reward of one point")
    body = body_surface(scene)
    axis.scatter(body[::5, 0], body[::5, 1], s=1, color="white", alpha=0.25, label="astronaut")
    axis.scatter(marks[:, 0], marks[:, 1], marker="x", color="cyan", label="mark points")
    for name, arm, colour in (("A", joints[:6], "tab:blue"), ("B", joints[6:], "tab:orange")):
        axis.plot(*arm[:, :2].T, "o-", color=colour, label=f"arm {name}: joints and end")
    axis.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", title="AAPF over the ground")
    axis.legend(loc="upper right", fontsize=8, labelcolor="black", facecolor="white", framealpha=0.8)
    return figure


def aapf_against_contact(weights: RewardWeights, radius: float = 0.1) -> Figure:
    """Draw the dense AAPF term beside the contact reward as a joint nears a rock of this radius [m]."""
    gap = np.linspace(-0.02, 0.8, 300)
    dense = [rewards.obstacle_avoidance(np.array([max(g + radius, 1e-3)]), rho=weights.rho, xi=weights.xi) for g in gap]
    sparse = [weights.contact * rewards.contact(bool(g <= 0)) for g in gap]
    figure, axis = plt.subplots(figsize=(8, 4), layout="constrained")
    axis.plot(gap, dense, label="AAPF: grows on the way")
    axis.plot(gap, sparse, label="contact reward: says nothing until contact")
    axis.axvline(0, color="grey", linestyle=":")
    axis.set(xlabel="gap between joint and rock [m]", ylabel="reward a step")
    axis.legend()
    return figure


def dwelling_against_finishing(table: pd.DataFrame) -> Figure:
    """Draw the discounted return of dwelling and of finishing over the step of completion, both forms."""
    grid = sns.relplot(data=table, x="finish after", y="return", hue="behaviour", col="form", kind="line", height=4)
    grid.set_axis_labels("steps until the task is completed", "discounted return")
    return grid.figure


#: What notebook 3 shows of a training: columns of ``progress.csv`` and what they are called.
CURVES = {
    "return_high": "EXR a rescue (SGN)",
    "return_low": "INR a rescue (LLN)",
    "both_arms_under": "both arms under",
    "success": "success",
}


def trials(table: pd.DataFrame) -> Figure:
    """Draw how often both arms came under the body in short trainings, a curve for each value of ``trial``."""
    figure, axis = plt.subplots(figsize=(9, 4), layout="constrained")
    for name, trial in table.groupby("trial"):
        axis.plot(trial["env_steps"], smooth(trial["both_arms_under"]), label=str(name).replace("_", " "))
    axis.set(xlabel="env steps, all agents", ylabel="both arms under, while training")
    axis.legend(title="trial", fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def learning_curves(table: pd.DataFrame, columns: dict[str, str], title: str = "") -> Figure:
    """Draw curves of one run over env steps, one panel a column (name to label)."""
    figure, axes = plt.subplots(1, len(columns), figsize=(4.4 * len(columns), 3.6), layout="constrained", squeeze=False)
    for axis, (column, label) in zip(axes.flat, columns.items(), strict=True):
        axis.plot(table["env_steps"], table[column], alpha=0.3)
        axis.plot(table["env_steps"], smooth(table[column]), color="C0")
        axis.set(xlabel="env steps, all agents", title=label)
    figure.suptitle(title)
    return figure


def convergence(curves: dict[str, pd.DataFrame], column: str, label: str, by: str = "env_steps") -> Figure:
    """Draw F6, one column of several methods against env steps or minutes."""
    figure, axis = plt.subplots(figsize=(8, 4.5), layout="constrained")
    for name, table in curves.items():
        x = table["env_steps"] if by == "env_steps" else table["seconds"] / 60
        axis.plot(x, smooth(table[column]), label=name)
    axis.set(xlabel="env steps, all agents" if by == "env_steps" else "minutes", ylabel=label)
    axis.legend()
    return figure


def success_by_posture(tested: dict[str, pd.DataFrame], title: str = "") -> Figure:
    """Draw a heat map of success [%] over postures and tasks; ``tested`` has each column's rows by its title."""
    rates = pd.DataFrame({run: rows.groupby(["posture", "task"])["success"].mean() for run, rows in tested.items()})
    pairs = [(name, task) for name, posture in all_postures().items() for task in posture.tasks]
    rates = 100 * rates.reindex([pair for pair in pairs if pair in rates.index])
    rates.index = pd.Index([f"{posture} {task}".replace("_", " ") for posture, task in rates.index])
    figure, axis = plt.subplots(figsize=(3.5 + 1.5 * rates.shape[1], 1.5 + 0.28 * len(rates)), layout="constrained")
    sns.heatmap(
        rates.rename(columns=lambda run: textwrap.fill(run, 14)),  # as many letters as a column is wide
        annot=True, fmt=".0f", vmin=0, vmax=100, cmap="viridis", cbar_kws={"label": "success [%]"}, ax=axis,
    )  # fmt: skip
    axis.set(title=title)
    return figure


def success_by_severity(table: pd.DataFrame) -> Figure:
    """Draw success against severity, a panel a kind, a line a method with Wilson's intervals; none is at the left.

    ``table`` is what ``reality_gap.by_severity`` returns.
    """
    columns = 5
    rows = -(-len(KINDS) // columns)
    figure, axes = plt.subplots(
        rows, columns, figsize=(15, 3.1 * rows), sharey=True, layout="constrained", squeeze=False
    )
    for axis, (name, kind) in zip(axes.flat, KINDS.items(), strict=False):
        for colour, (method, lines) in enumerate(table.groupby("method", sort=False)):
            lines = lines[lines["kind"].isin((NONE, name))]
            rate = 100 * lines["success_rate"]
            bars = np.array([rate - 100 * lines["wilson_low"], 100 * lines["wilson_high"] - rate])
            levels = lines["level"].fillna(0.0).to_numpy(float)
            axis.errorbar(
                levels, rate, bars, marker="o", capsize=3, color=f"C{colour}", label=METHODS[str(method)].title
            )
        axis.set(title=kind.title, xlabel=kind.unit, ylim=(0, 102))
    axes[0, 0].set_ylabel("success [%]")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4)
    return figure
