"""The evaluations of a run: which scenes each one tests and what is taken out of the policy, by the file's name."""

from __future__ import annotations

from dataclasses import dataclass

from lunar_rescue.scenes.splits import SPLITS
from reproduce.hrl_dcs.ablation import ABLATIONS

#: Scenes of a full and of a smaller evaluation, by preset.
TESTS = {"smoke": (8, 4), "laptop": (1000, 200), "paper": (1000, 200)}
#: The smaller evaluation that a two-layer policy's ablations are compared with.
TWO_LAYERS = "both_layers"


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
}
