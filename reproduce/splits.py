"""Which seeds belong to which split, so that no test scene is ever trained on."""

from __future__ import annotations

import numpy as np

TEST = range(0, 1_000_000)  # the paper's 1000 tests are the first thousand
VALIDATION = range(1_000_000, 2_000_000)  # for tuning
TRAIN = range(2_000_000, 2**31 - 1)


def train_seed(run_seed: int, env: int, epoch: int, episode: int) -> int:
    """Scene seed of one training episode, from the run's seed, the environment, the restart and the episode alone."""
    draw = np.random.default_rng([run_seed, env, epoch, episode]).integers(TRAIN.start, TRAIN.stop)
    return int(draw)
