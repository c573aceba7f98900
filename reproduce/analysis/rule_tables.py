"""Read and word the table of how often the rules of the claims are wrong, which ``rule_errors`` makes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from reproduce.analysis.trainings import percent
from reproduce.storage.paths import COMMITTED

FILE = COMMITTED / "rules.csv"
COLUMNS = ["rule", "truth", "trainings", "counted", "share", "low", "high", "at_least", "at_most", "holds", "repeats"]


def read_rules(path: Path | None = None) -> pd.DataFrame | None:
    """Return the table that ``reproduce rules`` wrote, or None where there is none."""
    file = path or FILE
    return pd.read_csv(file) if file.is_file() else None


def readable_rules(table: pd.DataFrame) -> pd.DataFrame:
    """Return the table for people: shares and bars in %, and a word for each."""
    bars = [
        "-" if np.isnan(least) else f"{100 * least:.0f} to {100 * most:.0f} %"
        for least, most in zip(table["at_least"], table["at_most"], strict=True)
    ]
    columns = (table[name].astype(float) for name in ("share", "low", "high"))
    shares = [percent(share, (low, high)) for share, low, high in zip(*columns, strict=True)]
    words = [{"True": "yes", "False": "no"}.get(str(holds), "") for holds in table["holds"]]
    return table[["rule", "truth", "trainings", "counted"]].assign(share=shares, bar=bars, holds=words)


def summarise_rules(table: pd.DataFrame) -> pd.DataFrame:
    """Return a row a rule and what is counted, of cases with a bar: least and greatest share, bars that hold."""
    barred, rows = table[table["holds"].notna()], []
    for (rule, counted, _), group in barred.groupby(["rule", "counted", "at_least"], sort=False):
        least, most = 100 * group["at_least"].iloc[0], 100 * group["at_most"].iloc[0]
        shares = f"{100 * group['share'].min():.1f} to {100 * group['share'].max():.1f} %"
        holding = int((group["holds"].astype(str) == "True").sum())
        rows.append((rule, counted, f"{least:.0f} to {most:.0f} %", shares, f"{holding} of {len(group)}"))
    columns = ["rule", "counted", "bar", "share of experiments", "bars that hold"]
    return pd.DataFrame(rows, columns=columns).set_index("rule")
