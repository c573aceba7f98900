"""Draw the two layers: Fig. 1, sub-goals over pictures of a rescue, both rewards, and what LLN makes of a sub-goal."""

import textwrap
from contextlib import closing

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

from lunar_rescue import LunarRescueEnv
from lunar_rescue.pictures.camera import scene_camera
from lunar_rescue.pictures.overlay import draw_overlay
from lunar_rescue.pictures.rendering import Studio
from reproduce.analysis.figures import picture_grid
from reproduce.analysis.two_layers import Trace

#: The boxes of Fig. 1: middle, width and height, colour, title, and what it does.
BOXES = {
    "sgn": ((1.6, 4.4), (2.6, 1.3), "#4c72b0", "SGN", "sets sub-goals, every N steps"),
    "lln": ((1.6, 2.0), (2.6, 1.3), "#dd8452", "LLN", "moves the joints, every step"),
    "env": ((7.4, 3.2), (2.6, 2.2), "#55a868", "environment", "robot, astronaut, rocks; contact and friction"),
}
#: The arrows of Fig. 1: their points from the tail to the head, where the words stand, and the words.
ARROWS = (
    (((1.6, 3.75), (1.6, 2.65)), (1.75, 3.2), "sub-goal $g_t$: places of both arm ends"),
    (((2.9, 1.7), (8.0, 1.7), (8.0, 2.1)), (3.0, 1.5), "action $a_t$: 11 joints"),
    (((6.1, 2.6), (4.6, 2.6), (4.6, 2.2), (2.9, 2.2)), (3.0, 2.36), "INR: Eq. 2 towards $g_t$"),
    (((6.1, 3.5), (5.2, 3.5), (5.2, 4.2), (2.9, 4.2)), (3.0, 4.37), "EXR, summed over N steps"),
    (((7.4, 4.3), (7.4, 4.8), (2.9, 4.8)), (3.0, 4.98), "state $s_t$, task code $I$ (to both layers)"),
)


def loop() -> Figure:
    """Draw Fig. 1 anew: SGN, LLN and the environment, and what runs between them, EXR and INR among it."""
    figure, axis = plt.subplots(figsize=(9, 4.6), layout="constrained")
    axis.set(xlim=(0, 9), ylim=(0.9, 5.4))
    axis.axis("off")
    for (x, y), (width, height), colour, title, about in BOXES.values():
        corner = (x - width / 2, y - height / 2)
        axis.add_patch(FancyBboxPatch(corner, width, height, boxstyle="round,pad=0,rounding_size=0.15", fc=colour))
        axis.text(x, y + 0.2, title, ha="center", va="center", color="white", weight="bold", size=13)
        axis.text(x, y - 0.25, textwrap.fill(about, 20), ha="center", va="center", color="white", size=9)
    for points, place, words in ARROWS:
        (*_, corner, head) = points
        axis.plot(*zip(*points[:-1], strict=True), color="#444444", lw=1.5, solid_capstyle="butt")
        axis.annotate("", head, corner, arrowprops={"arrowstyle": "-|>", "color": "#444444", "lw": 1.5, "shrinkA": 0})
        axis.text(*place, words, va="center", size=9.5, color="#222222")
    return figure


def chosen_decisions(trace: Trace, count: int = 5) -> list[int]:
    """Return the steps of ``count`` decisions, spread evenly from the first to the last."""
    places = np.linspace(0, len(trace.decided) - 1, min(count, len(trace.decided))).round().astype(int)
    return [trace.decided[place] for place in places]


def decisions(trace: Trace, count: int = 5, size: tuple[int, int] = (480, 352)) -> Figure:
    """Draw ``count`` decisions of a rescue, each as SGN sets the sub-goals, and how the rescue ended.

    The rescue is acted out again from its scene and actions. Pictures have ``size`` (width, height) [px].
    """
    chosen, camera, pictures = chosen_decisions(trace, count), scene_camera(trace.scene, size), []
    with closing(LunarRescueEnv()) as env, closing(Studio()) as studio:
        env.reset_flat(options={"scene": trace.scene})
        for step, action in enumerate(trace.actions):
            if step in chosen:
                picture = studio.picture(env.episode, camera)
                seen = draw_overlay(picture, env.episode, camera, trace.subgoals[step])
                pictures.append((f"step {step}: SGN sets sub-goals", seen))
            env.step_flat(action)
        last = draw_overlay(studio.picture(env.episode, camera), env.episode, camera, note=trace.ending)
    return picture_grid([*pictures, (f"step {len(trace.actions)}: {trace.ending}", last)], columns=3)


def reward_steps(trace: Trace) -> Figure:
    """Draw INR with its terms above EXR, step by step; dotted lines are where SGN sets sub-goals."""
    figure, axes = plt.subplots(3, 1, figsize=(9, 5.4), sharex=True, layout="constrained")
    steps = trace.steps
    for arm, colour in (("A", "tab:blue"), ("B", "tab:orange")):
        axes[0].plot(100 * steps[f"before {arm}"], color=colour, label=f"arm {arm}")
    terms = [
        name
        for name in steps.columns.astype(str)
        if name not in ("EXR", "INR") and name[:6] not in ("before", "after ")
    ]
    for name in terms:
        axes[1].plot(steps[name], lw=1, label=name)
    axes[1].plot(steps["INR"], color="black", lw=1.6, label="INR, their sum")
    total = steps["EXR"].groupby(steps.index // trace.interval).sum()
    axes[2].plot(steps["EXR"], color="black", lw=1.2, label="EXR of a step")
    axes[2].bar(
        total.index * trace.interval + trace.interval / 2, total, trace.interval, alpha=0.3, label="over N steps"
    )
    for axis, label in zip(axes, ("to the sub-goal [cm]", "INR: LLN is paid", "EXR: SGN is paid"), strict=True):
        axis.set(ylabel=label)
        axis.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
        for step in trace.decided:
            axis.axvline(step, color="grey", lw=0.5, ls=":")
    axes[2].set(xlabel="step")
    return figure


def effect_of_the_subgoal(trace: Trace) -> Figure:
    """Draw how large LLN's outputs are by joint, and how far the sub-goal alone moves them."""
    table = trace.effect_of_the_subgoal()
    figure, axis = plt.subplots(figsize=(9, 3.4), layout="constrained")
    table.plot.barh(ax=axis, width=0.8)
    axis.invert_yaxis()
    axis.set(xlabel="mean over the rescue, of outputs in [-1, 1]")
    axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=9)
    return figure
