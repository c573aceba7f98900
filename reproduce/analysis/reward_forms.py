"""Compute what the approach term rewards: dwelling, finishing, wandering and giving up (READING of Eq. 2)."""

import pandas as pd

from lunar_rescue.rewards import ApproachForm, approach, time_bonus


def discounted(per_step: float, steps: int, gamma: float) -> float:
    """Return the sum of ``steps`` equal rewards, discounted."""
    return per_step * sum(gamma**step for step in range(steps))


def dwelling(form: ApproachForm, beta: float, gamma: float, max_steps: int) -> float:
    """Compute the return of standing still at the best distance until the step limit."""
    return discounted(approach(1.0, 1.0, beta=beta, form=form), max_steps, gamma)


def finishing(form: ApproachForm, beta: float, gamma: float, max_steps: int, after: int, factor: float = 1.0) -> float:
    """Compute the return of standing still and completing the task in step ``after``, its time bonus times a factor."""
    waiting = discounted(approach(1.0, 1.0, beta=beta, form=form), after, gamma)
    return waiting + gamma ** (after - 1) * factor * time_bonus(after, max_steps)


def wandering(form: ApproachForm, beta: float, gamma: float, steps: int, away: float) -> float:
    """Compute the return of staying ``away`` metres from the best distance of the whole episode for so many steps."""
    return discounted(approach(1.0, 1.0 + away, beta=beta, form=form), steps, gamma)


def dwelling_table(beta: float, gamma: float, max_steps: int, factor: float = 1.0, every: int = 5) -> pd.DataFrame:
    """Return rows with form, behaviour, step of completion and return, for the figure."""
    rows = []
    forms: tuple[ApproachForm, ...] = ("literal", "signed")
    for form in forms:
        for after in range(1, max_steps + 1, every):
            same = {"form": form, "finish after": after}
            rows.append({**same, "behaviour": "dwelling", "return": dwelling(form, beta, gamma, max_steps)})
            value = finishing(form, beta, gamma, max_steps, after, factor)
            rows.append({**same, "behaviour": "finishing", "return": value})
    return pd.DataFrame(rows)


def largest_honest_beta(gamma: float, max_steps: int, after: int, factor: float = 1.0) -> float:
    """Return the largest beta at which finishing in step ``after`` beats dwelling to the limit in the literal form."""
    loss = discounted(1.0, max_steps, gamma) - discounted(1.0, after, gamma)
    return gamma ** (after - 1) * factor * time_bonus(after, max_steps) / loss


def forms_table(beta: float, gamma: float, max_steps: int, after: int = 40, away: float = 0.3) -> pd.DataFrame:
    """Return what both forms pay for dwelling, for finishing ``after`` steps and for staying ``away`` [m] so long."""
    forms: tuple[ApproachForm, ...] = ("literal", "signed")
    rows = {
        form: {
            "dwelling to the limit": dwelling(form, beta, gamma, max_steps),
            f"finishing after {after} steps": finishing(form, beta, gamma, max_steps, after),
            f"{after} steps {away} m from the best": wandering(form, beta, gamma, after, away),
        }
        for form in forms
    }
    return pd.DataFrame(rows).T.round(3).rename_axis("form")
