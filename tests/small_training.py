"""A training of some seconds with checkpoints, to be killed: ``python tests/small_training.py FOLDER``."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

from reproduce.experiments.methods import METHODS
from reproduce.experiments.train import train
from reproduce.learning.config import PRESETS
from reproduce.storage.checkpoint import has_checkpoint


def main(folder: Path) -> None:
    """Begin, or go on from the last checkpoint."""
    smoke = PRESETS["smoke"]
    config = replace(
        smoke, steps=10 * 4 * 64, n_envs=4, checkpoint_every=2, low=replace(smoke.low, batch_size=128, n_epochs=2)
    )
    train(METHODS["hrl_dcs"], config, 7, folder, "smoke", resume=has_checkpoint(folder), quiet=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
