"""Stop a training at the first loss that is not a finite number, before it spoils the weights or a checkpoint."""

from __future__ import annotations

import math
from collections.abc import Mapping

from reproduce.storage.errors import RunFailedError


def check_losses(where: str, log: Mapping[str, float]) -> None:
    """Refuse losses that are infinite or not a number.

    Args:
        where: Name of the learner and number of its update.
        log: What is logged of an update; names of losses end in ``loss``.

    Raises:
        RunFailedError: Naming learner, update, loss and value.
    """
    for name, value in log.items():
        if name.endswith("loss") and not math.isfinite(value):
            raise RunFailedError(f"{where}: {name}: expected a finite number, got {value}; the training stops here")
