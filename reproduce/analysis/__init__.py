"""From rows to verdicts: runs, intervals, tables, claims and figures."""
