"""Which scene a training episode gets: always one of the ``train`` split."""

from __future__ import annotations

import numpy as np

from lunar_rescue.scenes.splits import TRAIN


def train_seed(run_seed: int, env: int, epoch: int, episode: int) -> int:
    """Scene seed of one training episode, from the run's seed, the environment, the restart and the episode alone."""
    draw = np.random.default_rng([run_seed, env, epoch, episode]).integers(TRAIN.start, TRAIN.stop)
    return int(draw)
