"""Policies of every method as a training begins with them, for tests that ask what is read and not what was learnt."""

from __future__ import annotations

import shutil
import tempfile
from functools import cache
from pathlib import Path

from reproduce.experiments.methods import METHODS
from reproduce.storage.policies import save_policy


@cache
def _exported(method: str) -> Path:
    chosen, folder = METHODS[method], Path(tempfile.mkdtemp(prefix="untrained-"))
    assert chosen.train is not None
    training = chosen.train(chosen.config("smoke"), 0)
    save_policy(folder, method, training.networks(), training.config.policy)
    training.close()
    return folder


def untrained_policy(method: str, run: Path) -> Path:
    """Make a run folder with the untrained policy of a method and return it."""
    run.mkdir()
    for name in ("policy.json", "policy.safetensors"):
        shutil.copyfile(_exported(method) / name, run / name)
    return run
