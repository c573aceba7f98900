"""Writes the results block of README.md from results/; no number there is typed."""

from __future__ import annotations

import re
import sys

from reproduce.claims import compute_claims
from reproduce.files import write_text
from reproduce.results import ROOT, runs_of
from reproduce.tables import readable_table1

BLOCK = re.compile(r"(<!-- results:begin[^>]*-->\n).*?(<!-- results:end -->)", re.DOTALL)


def results_block() -> str:
    """The block as Markdown: Table 1, where it comes from, and the verdicts in a line."""
    table = readable_table1()
    head = "| " + " | ".join(table.columns) + " |\n|" + "---|" * len(table.columns)
    rows = "\n".join("| " + " | ".join(str(v) for v in row) + " |" for row in table.to_numpy())
    lines = [head + "\n" + rows, ""]
    for run in runs_of("hrl_dcs"):
        if run.origin and run.evaluation:
            under = 100 * run.evaluation["both_arms_under"]
            lines.append(
                f"HRL-DCS, seed {run.seed}: trained by `{run.origin['command']}` in {run.minutes:.0f} minutes on "
                f"{run.origin['machine']['cores']} cores, environment {run.origin['environment_version']}; "
                f"both arms under in {under:.1f} % of tests."
            )
    verdicts = ", ".join(f"{c.id} {c.verdict}" for c in compute_claims())
    lines += ["", f"Claims: {verdicts} (`results/claims.json` says why)."]
    return "\n".join(lines) + "\n"


def main() -> int:
    """Rewrite the block in place."""
    path = ROOT / "README.md"
    text = path.read_text(encoding="utf-8")
    if not BLOCK.search(text):
        print(f"{path}: no results block found", file=sys.stderr)
        return 2
    made = BLOCK.sub(lambda m: m.group(1) + results_block() + m.group(2), text)
    write_text(path, made)
    return 0


if __name__ == "__main__":
    sys.exit(main())
