"""The method, the experiments and the command line; ``load_policy`` is for programs of others."""

from __future__ import annotations

import importlib.metadata
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from reproduce.experiments.library import LoadedPolicy

__version__ = importlib.metadata.version("lunar-rescue")
__all__ = ["__version__", "load_policy"]


def load_policy(where: str | Path) -> LoadedPolicy:
    """Load a trained policy from a run folder, as ``reproduce train`` writes it; no code in it is run.

    Args:
        where: The folder, or the name of a method that does not learn: ``"scripted"`` or ``"random"``.

    Raises:
        UserError: Where there is no such folder, or a file in it is missing or wrong; one line says which and why.
    """
    from reproduce.experiments.library import LoadedPolicy  # PyTorch takes seconds, which `reproduce --help` does not

    return LoadedPolicy(where)
