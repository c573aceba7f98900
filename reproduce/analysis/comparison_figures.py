"""Draw the methods side by side: success beside the paper's, differences, learning, failures, conditions, trials."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import seaborn as sns
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from reproduce.analysis.runs import Run, reference_runs
from reproduce.analysis.tables import SPLIT_TITLES, by_condition, paired_differences
from reproduce.analysis.trainings import read_pools, smooth
from reproduce.experiments.methods import METHODS
from reproduce.storage.paths import RESULTS

_OURS, _PAPER = "#4c72b0", "#c44e52"
_BESIDE = {"loc": "center left", "bbox_to_anchor": (1.0, 0.5), "fontsize": 9}
_NOTE: dict[str, Any] = {"size": 9, "color": "#777777", "style": "italic", "backgroundcolor": "white"}  # hides the grid


def against_paper(results: Path = RESULTS) -> Figure:
    """Draw each method's success on test and on held-out scenes, trainings together, beside the paper's figure."""
    pools = {key: read_pools(results, key) for key in SPLIT_TITLES.values()}
    known = {run.method for run in reference_runs(results)}
    names = [n for n, m in METHODS.items() if m.paper_success or n in known]
    figure, axis = plt.subplots(figsize=(6, 1.3 + 0.45 * len(names)), layout="constrained")
    for row, name in enumerate(names):
        if paper := METHODS[name].paper_success:
            axis.plot(100 * paper, row, "D", color=_PAPER, ms=7, label="the paper", zorder=3)
        for (split, key), place, fill in zip(SPLIT_TITLES.items(), (-0.12, 0.16), ("full", "none"), strict=True):
            if pool := pools[key].get(name):
                rate, *ends = (100 * part for part in pool.success)
                axis.plot(ends, [row + place] * 2, color=_OURS, lw=2)
                axis.plot(rate, row + place, "o", color=_OURS, fillstyle=fill, ms=8, label=f"here, {split} scenes")
            elif split == "test":
                axis.text(2, row, "no run here yet", va="center", **_NOTE)
    axis.set(xlim=(-2, 102), xlabel="rescued [%], with 95 % intervals", ylim=(len(names) - 0.5, -0.5))
    axis.set_yticks(range(len(names)), [METHODS[name].title for name in names])
    legend_below(axis)
    return figure


def legend_below(axis: Axes) -> None:
    """Put each label once under the whole figure, where none is cut off."""
    handles, labels = axis.get_legend_handles_labels()
    once = dict(zip(labels, handles, strict=True))
    if once:
        axis.figure.legend(once.values(), once.keys(), loc="outside lower center", ncols=3, fontsize=9)


def differences(results: Path = RESULTS) -> Figure | None:
    """Draw how much more often HRL-DCS rescues than each other method; None without two runs on the same scenes.

    Of each method it is the first training that was tested on the scenes of the first of HRL-DCS.
    """
    tables = {title: paired_differences(results, name=name) for title, name in SPLIT_TITLES.items()}
    first = {(title, str(name).split()[2]): row for title, t in tables.items() for name, row in t[::-1].iterrows()}
    rows = [(method, title, row) for (title, method), row in reversed(first.items())]
    if not rows:
        return None
    figure, axis = plt.subplots(figsize=(8, 1.4 + 0.35 * len(rows)), layout="constrained")
    for place, (_, title, row) in enumerate(rows):
        fill = "full" if title == "test" else "none"
        axis.plot([100 * row["low"], 100 * row["high"]], [place] * 2, color=_OURS, lw=2)
        axis.plot(100 * row["difference"], place, "o", color=_OURS, fillstyle=fill, ms=8)
    axis.axvline(0, color="black", lw=1)
    words = [f"{METHODS[method].title}, {title}" for method, title, _ in rows]
    axis.set_yticks(range(len(rows)), words)
    axis.set(xlabel="HRL-DCS rescues more often by [points]", ylim=(len(rows) - 0.5, -0.5))
    return figure


def learning(runs: Sequence[Run]) -> Figure | None:
    """Draw Fig. 6, return and success while training against environment steps and minutes; None without a curve.

    Trainings of a method have its colour.
    """
    curves = [(METHODS[run.method].title, curve) for run in runs if (curve := run.curve()) is not None]
    colours = dict(zip(dict(curves), sns.color_palette("tab20", 20), strict=False))
    if not curves:
        return None
    figure, axes = plt.subplots(2, 2, figsize=(10, 6), layout="constrained", sharex="col", sharey="row")
    for name, curve in curves:
        for column, x in enumerate((curve["env_steps"] / 1e6, curve["seconds"] / 60)):
            axes[0, column].plot(x, smooth(curve["return_high"]), color=colours[name], label=name)
            axes[1, column].plot(x, 100 * smooth(curve["success"]), color=colours[name])
    axes[0, 0].set(ylabel="return of the environment's reward")
    axes[1, 0].set(ylabel="rescued while training [%]", xlabel="million env steps, all agents")
    axes[1, 1].set(xlabel="minutes")
    once = dict(zip(*axes[0, 0].get_legend_handles_labels()[::-1], strict=True))
    figure.legend(once.values(), once.keys(), loc="outside right center", fontsize=8)
    return figure


def failures(runs: Sequence[Run]) -> Figure | None:
    """Draw how each method's tests ended, rescues and failures by cause; None without an evaluation."""
    counts: dict[str, Counter[str]] = {}
    for run in runs:
        if summary := run.evaluation:
            ends = {"rescued": summary["successes"], **summary["failures"]}
            counts.setdefault(METHODS[run.method].title, Counter()).update(ends)
    if not counts:
        return None
    table = pd.DataFrame(counts).T.fillna(0.0).rename(columns=lambda word: str(word).replace("_", " "))
    table = 100 * table.div(table.sum(axis=1), axis=0)
    figure, axis = plt.subplots(figsize=(9, 1.4 + 0.4 * len(table)), layout="constrained")
    table.plot.barh(stacked=True, ax=axis, width=0.7, colormap="tab10")
    axis.invert_yaxis()
    axis.set(xlabel="tests [%]", xlim=(0, 100))
    axis.legend(**_BESIDE)
    return figure


def conditions(
    tested: Mapping[str, pd.DataFrame], of: Sequence[str] = ("task", "ground", "mass", "rocks")
) -> Figure | None:
    """Draw success by condition with intervals; ``tested`` has rows of an evaluation by title. None without rows."""
    if not tested:
        return None
    figure, axes = plt.subplots(1, len(of), figsize=(11, 3.4), layout="constrained", sharey=True)
    for number, (title, rows) in enumerate(tested.items()):
        table = 100 * by_condition(rows)[["success", "low", "high"]]
        for axis, key in zip(axes, of, strict=True):
            part = table.loc[key]
            x = np.arange(len(part)) + 0.15 * number
            off = [part["success"] - part["low"], part["high"] - part["success"]]
            axis.errorbar(x, part["success"], np.clip(off, 0, None), fmt="o", capsize=3, label=title, ms=5)
            axis.set_xticks(range(len(part)), [str(w).replace("_", " ") for w in part.index], rotation=30, ha="right")
            axis.set(title=key, ylim=(-3, 103))
    axes[0].set(ylabel="rescued [%]")
    axes[-1].legend(**_BESIDE)
    return figure


def tuning(table: pd.DataFrame) -> Figure:
    """Draw the scores of the tuning trials by method; crosses mark those that made the reference runs."""
    figure, axis = plt.subplots(figsize=(8, 3.2), layout="constrained")
    methods = list(table.index.get_level_values("method").unique())
    for row, method in enumerate(methods):
        part = table.loc[method]
        chosen = part["chosen"] == "x"
        axis.plot(part["score"][~chosen], [row] * (~chosen).sum(), "o", color=_OURS, alpha=0.6, label="a trial")
        axis.plot(part["score"][chosen], [row] * chosen.sum(), "X", color=_PAPER, ms=10, label="made the reference run")
    axis.set_yticks(range(len(methods)), methods)
    axis.set(
        xlabel="score: share of a rescue's two processes, easy scenes",
        xlim=(-0.03, 1.03),
        ylim=(len(methods) - 0.5, -0.5),
    )
    legend_below(axis)
    return figure
