"""``reproduce train`` with a training of some seconds and checkpoints, to be killed: ``small_training.py FOLDER``."""

from __future__ import annotations

import sys
from pathlib import Path

from reproduce.__main__ import main
from reproduce.experiments.presets import PRESETS


def train(folder: str, *options: str) -> None:
    """Call the command as a user would, with a smaller preset."""
    smoke = PRESETS["smoke"]
    smoke |= {"steps": 10 * 4 * 64, "n_envs": 4, "checkpoint_every": 2, "low.batch_size": 128, "low.n_epochs": 2}
    sys.argv = ["reproduce", "train", "hrl_dcs", "--preset", "smoke", "--seed", "7", "--out", folder, *options]
    main()


if __name__ == "__main__":
    resume = (Path(sys.argv[1]) / "config.json").is_file()
    train(sys.argv[1], *(["--resume"] if resume else []))
