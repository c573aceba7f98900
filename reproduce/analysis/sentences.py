"""Say in a sentence what a figure or table of a notebook shows, with its numbers; and what is missing where it is."""

from collections.abc import Sequence

import pandas as pd

from reproduce.analysis.runs import Run
from reproduce.analysis.trainings import smooth, steps_to_converge

NO_RUN = "No reference run of this version of the environment has it yet."


def tell_curves(runs: Sequence[Run]) -> str:
    """Say how each training ended, and where it had come nine tenths of its way up."""
    lines = []
    for run in runs:
        if (curve := run.curve()) is None:
            continue
        last, steps = curve.iloc[-1], steps_to_converge(curve)
        flat = f"nine tenths of the way up after {steps:,.0f} steps" if steps else "its return did not rise"
        success = (
            f"{100 * smooth(curve['success']).iloc[-1]:.0f} % rescued while exploring, " if "success" in curve else ""
        )
        lines.append(f"{run.label}: {last['env_steps']:,.0f} steps; {success}{flat}.")
    return "\n".join(lines) or NO_RUN


def tell_trials(table: pd.DataFrame) -> str:
    """Say which of several short trainings got both arms under most often in the end."""
    ends = table.groupby("trial")["both_arms_under"].apply(lambda values: float(smooth(values).iloc[-1]))
    name, best = str(ends.idxmax()).replace("_", " "), 100 * ends.max()
    return f"Of {len(ends)} trials, {name} ended highest: both arms under in {best:.0f} % of rescues while exploring."
