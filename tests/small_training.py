"""``reproduce train`` with a training of some seconds and checkpoints, to be killed: ``small_training.py FOLDER``."""

from __future__ import annotations

import sys
from pathlib import Path

from reproduce.__main__ import main
from reproduce.experiments.presets import PRESETS

SEED = 7
#: What makes ten short updates of the smoke preset.
SMALL = {"steps": 10 * 2 * 64, "n_envs": 2, "checkpoint_every": 2, "low.batch_size": 64, "low.n_epochs": 2}


def train(folder: str, *options: str) -> None:
    """Call the command as a user would, with a smaller preset."""
    PRESETS["smoke"] |= SMALL
    sys.argv = ["reproduce", "train", "hrl_dcs", "--preset", "smoke", "--seed", str(SEED), "--out", folder, *options]
    main()


if __name__ == "__main__":
    resume = (Path(sys.argv[1]) / "config.json").is_file()
    train(sys.argv[1], *(["--resume"] if resume else []))
