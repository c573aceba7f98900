"""The terms of Eq. 2 and of the project's own milestones, as pure functions of floats and arrays.

``TERMS`` is the one table of them: name, formula, weights, and how the environment computes each. The reward of a step
is the sum over the table.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from lunar_rescue.scenes.records import checked

ApproachForm = Literal["literal", "signed"]
Weight = Annotated[float, Field(ge=0.0)]


def _distances(values: ArrayLike, name: str) -> NDArray[np.float64]:
    """Return distances as an array; a distance that is not finite and positive is an error."""
    array = np.asarray(values, dtype=np.float64)
    # Neither bound holds for nan, so two reductions say it all.
    if array.size and not (array.min() > 0.0 and array.max() < np.inf):
        raise ValueError(f"{name}: expected finite distances above 0 m, got {values!r}")
    return array


def _finite(value: float, name: str) -> float:
    if not math.isfinite(value):
        raise ValueError(f"{name}: expected a finite number, got {value!r}")
    return float(value)


def approach(best_distance: ArrayLike, distance: ArrayLike, *, beta: float, form: ApproachForm) -> float:
    """Return the first term of Eq. 2: reward for coming closer than ever before.

    ``literal`` is beta exp[D_m - D]; ``signed`` is beta (exp[D_m - D] - 1), positive when closer than the best so
    far and negative otherwise, as the paper's text has it.

    Args:
        best_distance: D_m, smallest distance before this step, a float or (2,) for two arms [m].
        distance: D, the distance now, same shape [m].
        beta: Weight.
        form: ``"literal"`` or ``"signed"``.

    Returns:
        The term; for arrays the mean over the arms.

    Raises:
        ValueError: On a distance that is not finite and positive, shapes that differ or an unknown form.
    """
    best, now = _distances(best_distance, "best_distance"), _distances(distance, "distance")
    if best.shape != now.shape:
        raise ValueError(f"approach: best_distance has shape {best.shape}, distance {now.shape}; expected the same")
    if form not in ("literal", "signed"):
        raise ValueError(f"form: expected 'literal' or 'signed', got {form!r}")
    gain = np.exp(best - now) if form == "literal" else np.expm1(best - now)
    return _finite(beta, "beta") * (float(gain.sum()) / gain.size)


def obstacle_avoidance(distances: ArrayLike, *, rho: float, xi: float) -> float:
    """Return the second term of Eq. 2, the artificial potential field (AAPF): -rho log(sum xi / D + 1).

    Args:
        distances: D of every joint to every mark point, any shape; an empty array is a scene without rocks [m].
        rho: Weight.
        xi: Length scale of the field [m].

    Raises:
        ValueError: On a distance that is not finite and positive.
    """
    array = _distances(distances, "distances")
    return -_finite(rho, "rho") * math.log(float((_finite(xi, "xi") / array).sum()) + 1.0)


def joint_motion(delta: ArrayLike, *, varphi: float) -> float:
    """Return the third term of Eq. 2: -varphi sum |delta omega|; absolute, as signed changes would cancel.

    Args:
        delta: Change of each joint angle of arms and waist in this step, (11,) [rad].
        varphi: Weight [1/rad].
    """
    array = np.asarray(delta, dtype=np.float64)
    moved = float(np.abs(array).sum())
    if not math.isfinite(moved):
        raise ValueError(f"delta: expected finite angles, got {delta!r}")
    return -_finite(varphi, "varphi") * moved


def time_bonus(steps: float, max_steps: float) -> float:
    """Return the fourth term of Eq. 2: 1 - 0.9 phi / phi_max, given when the task is completed.

    Args:
        steps: phi, episode length at completion, in [0, max_steps].
        max_steps: phi_max, the step limit.
    """
    if not (np.isfinite(max_steps) and max_steps > 0 and np.isfinite(steps) and 0 <= steps <= max_steps):
        raise ValueError(f"time_bonus: expected 0 <= steps <= max_steps, got steps={steps!r}, max_steps={max_steps!r}")
    return 1.0 - 0.9 * steps / max_steps


def contact(in_contact: bool) -> float:
    """Return the reward that the ablation has in place of the AAPF: -0.5 on contact, else +0.5 (section 4.3)."""
    return -0.5 if in_contact else 0.5


@checked
@dataclass(frozen=True)
class RewardWeights:
    """Weight of each term, under the term's name; the paper gives none of them."""

    beta: Weight = 2.0
    """Approach term, both processes."""
    memory: Annotated[int, Field(ge=1)] = 1
    """D_m is the best distance of the last so many steps. Over a whole episode (a large number) every step away from
    the best costs again and again, and policies learnt to end episodes early (tried, see the training log)."""
    rho: Weight = 0.04
    """AAPF term: a joint that comes from 0.4 m to 0.05 m costs a fifth of what a typical step brings nearer."""
    xi: Weight = 0.02
    """AAPF length scale [m]."""
    influence: Annotated[float, Field(gt=0.0)] = 0.15
    """Distance from a joint beyond which a mark point counts for nothing [m], as in Khatib's potential field (1986).
    Without it the sum over all joints and marks tells how many rocks there are, and hides the one that is near."""
    varphi: Weight = 0.003
    """Joint-motion term [1/rad]."""
    time_bonus: Weight = 1.5
    """Factor on the time bonus, so that finishing is worth more than any dwelling."""
    rescued: Weight = 4.0
    """Once, at completion, however late; not in the paper. The time bonus alone makes a late rescue worth a tenth of an
    early one, and policies that earn it prefer haste to success (see the training log)."""
    both_arms_under: Weight = 2.0
    """Once, when process 1 is completed; not in the paper."""
    failure: Weight = 1.0
    """Subtracted once when an episode ends in a failure other than the time limit; not in the paper."""
    contact: Weight = 0.05
    """Factor on the contact reward where it replaces the AAPF term: about what the AAPF costs at a rock's surface."""
    contact_form: Literal["centred", "literal"] = "centred"
    """``"centred"`` is nothing far from rocks, as the AAPF is; ``"literal"`` is the paper's -0.5 or +0.5 a step, times
    ``contact``, which pays for every step that an episode lasts."""
    form: ApproachForm = "signed"
    """Form of the approach term that the project trains with."""


@dataclass(frozen=True)
class Transition:
    """What the reward of one step is computed from."""

    # D_m, least distance before this step, of each arm in process 1 and of the pose in process 2 (2,) [m]
    best: NDArray[np.float64]
    distance: NDArray[np.float64]  # D, the distance now (2,) [m]
    clearance: NDArray[np.float64]  # distances of every joint to every mark point of the rocks (12, m) [m]
    moved: NDArray[np.float64]  # change of each joint angle (11,) [rad]
    touches_rock: bool  # whether an arm touches a rock
    contact_reward: bool  # whether the contact reward of section 4.3 takes the AAPF term's place
    steps: int  # steps since the reset, this one included
    max_steps: int  # step limit of the episode
    both_arms_under: bool  # whether this step completes process 1
    success: bool  # whether it completes the rescue
    failed: bool  # whether it ends the episode in a failure other than the time limit


def aapf(step: Transition, weights: RewardWeights) -> float:
    """Return the AAPF term of a step, also where the contact reward replaces it: each joint and its nearest mark."""
    if not step.clearance.size:
        return 0.0
    nearest = step.clearance.min(axis=1)
    return obstacle_avoidance(nearest[nearest < weights.influence], rho=weights.rho, xi=weights.xi)


def _obstacle_term(step: Transition, weights: RewardWeights) -> float:
    if not step.contact_reward:
        return aapf(step, weights)
    far = contact(False) if weights.contact_form == "centred" else 0.0
    return weights.contact * (contact(step.touches_rock) - far)


@dataclass(frozen=True)
class RewardTerm:
    """One term of the reward."""

    name: str  # its key in ``info["reward_terms"]``
    formula: str  # what it is, in LaTeX
    weight: tuple[str, ...]  # the fields of ``RewardWeights`` that it reads
    once: bool  # whether it comes at most once an episode, as a milestone does
    meaning: str  # a few words on when it comes and what it is for
    value: Callable[[Transition, RewardWeights], float]  # computes it for one step


#: Eq. 2, term by term, and the milestones that the paper does not have.
TERMS = (
    RewardTerm(
        "approach",
        r"\beta (e^{D_m - D} - 1)",
        ("beta", "memory"),
        False,
        "each step, mean over the arms; D_m is the least distance of the last `memory` steps",
        lambda s, w: approach(s.best, s.distance, beta=w.beta, form=w.form),
    ),
    RewardTerm(
        "obstacle_avoidance",
        r"-\rho \log(\textstyle\sum \xi / D + 1)",
        ("rho", "xi", "influence"),
        False,
        "each step, over joints and the mark point nearest to each, within `influence`; the AAPF",
        _obstacle_term,
    ),
    RewardTerm(
        "joint_motion",
        r"-\varphi \textstyle\sum \lvert\Delta\omega\rvert",
        ("varphi",),
        False,
        "each step, over arms and waist",
        lambda s, w: joint_motion(s.moved, varphi=w.varphi),
    ),
    RewardTerm(
        "time_bonus",
        r"1 - 0.9 \phi / \phi_{max}",
        ("time_bonus",),
        True,
        "once, on success",
        lambda s, w: w.time_bonus * time_bonus(s.steps, s.max_steps) if s.success else 0.0,
    ),
    RewardTerm(
        "rescued",
        "1",
        ("rescued",),
        True,
        "once, on success (not in the paper)",
        lambda s, w: w.rescued if s.success else 0.0,
    ),
    RewardTerm(
        "both_arms_under",
        "1",
        ("both_arms_under",),
        True,
        "once, when process 1 is completed (not in the paper)",
        lambda s, w: w.both_arms_under if s.both_arms_under else 0.0,
    ),
    RewardTerm(
        "failure",
        "-1",
        ("failure",),
        True,
        "once, when an episode fails before its time is up (not in the paper)",
        lambda s, w: -w.failure if s.failed else 0.0,
    ),
)


def reward_terms(step: Transition, weights: RewardWeights) -> dict[str, float]:
    """Return every term of a step by its name; the reward is their sum."""
    return {term.name: term.value(step, weights) for term in TERMS}
