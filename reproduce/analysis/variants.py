"""Read the variants of the printed method: what each prior of a ladder adds, and which of our fills matter."""

from pathlib import Path

import matplotlib.pyplot as plt
import pandas as pd
from matplotlib.figure import Figure

from reproduce.analysis.comparison_figures import legend_below
from reproduce.analysis.intervals import Interval, in_points, paired_difference, same_scenes
from reproduce.analysis.runs import read_evaluation
from reproduce.analysis.trainings import percent
from reproduce.experiments.evaluations import VALIDATED
from reproduce.experiments.presets import VARIANTS
from reproduce.experiments.variants import variant_folder, variant_method
from reproduce.storage.files import read_json
from reproduce.storage.paths import RESULTS

#: The rung of the ladder that is the method as Table 1 has it; fills are held against it.
BASE = "ladder", "+ mirrored view"
_COLUMNS = ["steps", "tests", "both arms under", "success", "low", "high", "difference", "less", "more"]
_OURS, _ARMS = "#4c72b0", "#999999"


def variants_table(group: str, results: Path = RESULTS) -> pd.DataFrame:
    """Return a row a variant of a group that was tested on validation scenes, with 95 % intervals of the scenes.

    ``difference``, from ``less`` to ``more``, is to the rung below in a ladder and to the method as it stands in
    another group, on the same scenes; of what has nothing to be held against it is empty.
    """
    names = [(group, name) for name in VARIANTS[group]]
    names = names if group == BASE[0] else [BASE, *names]
    rows, before = {}, None
    for key in names:
        path = variant_folder(*key, results) / f"{VALIDATED}.json"
        if not path.is_file():
            continue
        summary, tests = read_evaluation(path, variant_method(*key))
        apart: Interval | tuple[None, None, None] = (None, None, None)
        if before is not None and same_scenes(tests, before):
            apart = paired_difference(tests["success"], before["success"])
        before = tests if group == BASE[0] or key == BASE else before
        steps = read_json(path.with_name("run.json"), "run description")["steps"]
        figures = (summary[name] for name in ("tests", "both_arms_under", "success_rate", "wilson_low", "wilson_high"))
        rows[key[1]] = [steps, *figures, *apart]
    return pd.DataFrame.from_dict(rows, orient="index", columns=_COLUMNS).rename_axis("variant")


def readable_variants(table: pd.DataFrame) -> pd.DataFrame:
    """Return a table of variants for people: rates in percent, differences in points, each with its interval."""
    rows = {
        name: {
            "million steps": f"{row['steps'] / 1e6:.1f}",
            "both arms under": f"{100 * row['both arms under']:.1f} %",
            "rescued": percent(row["success"], (row["low"], row["high"])),
            "difference, points": "-" if pd.isna(row["difference"]) else _points(row),
        }
        for name, row in table.iterrows()
    }
    return pd.DataFrame.from_dict(rows, orient="index").rename_axis("variant")


def draw_variants(table: pd.DataFrame) -> Figure | None:
    """Draw how often each variant rescues, with intervals, and how often both arms got under; None without a row."""
    if table.empty:
        return None
    figure, axis = plt.subplots(figsize=(7, 1.3 + 0.4 * len(table)), layout="constrained")
    for place, (_, row) in enumerate(table.iterrows()):
        axis.plot(100 * row["both arms under"], place, "|", color=_ARMS, ms=12, mew=2, label="both arms under")
        axis.plot([100 * row["low"], 100 * row["high"]], [place] * 2, color=_OURS, lw=2)
        axis.plot(100 * row["success"], place, "o", color=_OURS, ms=7, label="rescued")
    axis.set_yticks(range(len(table)), list(table.index))
    axis.set(xlabel="validation scenes [%], with 95 % intervals", xlim=(-2, 102), ylim=(len(table) - 0.5, -0.5))
    legend_below(axis)
    return figure


def tell_variants(group: str, table: pd.DataFrame) -> str:
    """Say in a sentence which variants rescue more or less often than what each is held against, and which do not."""
    known = table.dropna(subset=["difference"])
    if known.empty:
        return f"No two variants of {group} were tested on the same scenes yet: reproduce vary {group}."
    apart = known[(known["less"] > 0) | (known["more"] < 0)]
    words = [f"{name} {_points(row)}" for name, row in apart.iterrows()]
    against = "the rung below" if group == BASE[0] else "the method as it stands"
    told = f"Apart from {against} by more than their intervals, in points: {'; '.join(words) or 'none'}."
    rest = [str(name) for name in known.index.difference(apart.index, sort=False)]
    one = "One training each, so that another seed may say otherwise where differences are small."
    return " ".join([told, *([f"Not told apart: {', '.join(rest)}."] if rest else []), one])


def _points(row: "pd.Series[float]") -> str:
    return in_points([row[key] for key in ("difference", "less", "more")])
