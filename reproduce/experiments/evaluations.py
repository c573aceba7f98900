"""The evaluations of a run: which scenes each one tests and what is taken out of the policy, by the file's name."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from lunar_rescue.scenes.splits import SPLITS
from reproduce.experiments.evaluate import evaluate
from reproduce.hrl_dcs.config import ABLATIONS

#: Scenes of a full and of a smaller evaluation, by preset.
TESTS = {"smoke": (8, 4), "laptop": (1000, 200), "paper": (1000, 200)}
#: The smaller evaluation that a two-layer policy's ablations are compared with.
TWO_LAYERS = "both_layers"
#: The evaluation by which variants are told apart; runs of the matrix need none.
VALIDATED = "validation"


@dataclass(frozen=True)
class Evaluation:
    """One evaluation of a policy.

    Attributes:
        first_seed: Seed of its first scene.
        few: Whether it takes the smaller number of scenes.
        ablation: What is taken out, or None.
    """

    first_seed: int
    few: bool = False
    ablation: str | None = None


#: By the name of the file in the run folder, without its ending.
EVALUATIONS = {
    "evaluation": Evaluation(SPLITS["test"].start),
    "heldout": Evaluation(SPLITS["heldout"].start),
    TWO_LAYERS: Evaluation(SPLITS["test"].start, few=True),
    **{name: Evaluation(SPLITS["test"].start, few=True, ablation=name) for name in ABLATIONS},
    VALIDATED: Evaluation(SPLITS["validation"].start),
}


def evaluations_of(method: str) -> list[str]:
    """Return the names of the evaluations that a run of this method has; ablations are HRL-DCS's alone."""
    names = [name for name in EVALUATIONS if name != VALIDATED]
    return names if method == "hrl_dcs" else ["evaluation", "heldout"]


def evaluate_run(
    folder: Path, tests: int, few: int, tell: Callable[[str], object] = print, quiet: bool = False
) -> None:
    """Make every evaluation that a run should have, and write summaries and rows into its folder.

    ``folder`` is ``METHOD/seedK``; without a policy in it, METHOD is one that does not learn. A full evaluation has
    ``tests`` scenes, a smaller one ``few``; ``tell`` is called with a line an evaluation.
    """
    method = folder.parent.name
    where = folder if (folder / "policy.json").is_file() else method
    for name in evaluations_of(method):
        plan, path = EVALUATIONS[name], folder / f"{name}.json"
        number = few if plan.few else tests
        summary = evaluate(where, number, plan.first_seed, quiet, plan.ablation, json=path)
        tell(f"{path}: {summary['successes']} of {summary['tests']} rescued")
