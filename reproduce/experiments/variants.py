"""Variants of the printed method, one training each: a ladder of priors, and what the paper leaves open.

What they are is in ``variants.toml``. All meet the same validation scenes, so that test scenes choose nothing.
"""

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from lunar_rescue.scenes.splits import VALIDATION
from reproduce.experiments.evaluate import evaluate
from reproduce.experiments.evaluations import VALIDATED
from reproduce.experiments.methods import METHODS
from reproduce.experiments.presets import VARIANTS, check_variants, configuration
from reproduce.experiments.train import train_as_needed
from reproduce.storage.files import read_json
from reproduce.storage.paths import REFERENCE, RESULTS

PRESET = "laptop"
METHOD = "hrl_dcs"
SEED = 0


def variant_method(group: str, name: str) -> str:
    """Return the method of a variant: ``hrl_dcs``, or the one whose reference run it is."""
    return str(VARIANTS[group][name].get("method", METHOD))


def variant_folder(group: str, name: str, results: Path = RESULTS) -> Path:
    """Return the run folder of a variant, ``variants/GROUP/NAME`` or that of a reference run."""
    if "method" in VARIANTS[group][name]:
        return results / REFERENCE / variant_method(group, name) / f"seed{SEED}"
    return results / "variants" / group / re.sub("[^a-z0-9]+", "_", name.lower()).strip("_")


def variant_config(group: str, name: str, steps: int) -> Any:
    """Return the configuration of a variant that is trained."""
    method = METHODS[METHOD]
    return configuration(method.kind, PRESET, {**method.changes, "steps": steps, **VARIANTS[group][name]})


def vary(
    group: str,
    only: Sequence[str] = (),
    steps: int = 1_000_000,
    tests: int = 1000,
    tell: Callable[[str], object] = print,
    quiet: bool = False,
    results: Path = RESULTS,
) -> None:
    """Train and test the variants of a group that were not yet, all of them or those named ``only``.

    Each has ``steps`` environment steps and ``tests`` validation scenes; after an interruption the same call goes on.
    ``tell`` gets a line a variant.

    Raises:
        UserError: On a group or a variant that is not there.
    """
    check_variants(group, only)
    for name in only or VARIANTS[group]:
        folder = variant_folder(group, name, results)
        if "method" not in VARIANTS[group][name]:
            train_as_needed(METHODS[METHOD], variant_config(group, name, steps), SEED, folder, PRESET, quiet)
        path = folder / f"{VALIDATED}.json"
        summary = read_json(path, "evaluation") if path.is_file() else {}
        if summary.get("tests") != tests:
            summary = evaluate(folder, tests, VALIDATION.start, quiet, json=path)
        tell(f"{group}, {name}: {summary['successes']} of {tests} validation scenes rescued")
