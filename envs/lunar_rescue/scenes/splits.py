"""Which seeds belong to which split, so that what is tested on was never trained on.

``test`` scenes are drawn as training scenes are, from other seeds. ``heldout`` scenes have postures, rock fields,
reliefs and masses that no training, validation or test scene has (see ``lunar_rescue.scenes.scene``).
"""

TEST = range(0, 1_000_000)  # the paper's 1000 tests are the first thousand
VALIDATION = range(1_000_000, 2_000_000)  # for tuning
HELDOUT = range(2_000_000, 3_000_000)
TRAIN = range(3_000_000, 2**31 - 1)

SPLITS: dict[str, range] = {"test": TEST, "validation": VALIDATION, "heldout": HELDOUT, "train": TRAIN}


def split_of(seed: int) -> str:
    """Return the name of the split that a scene's seed belongs to; seeds past the last range count as training."""
    return next((name for name, seeds in SPLITS.items() if seed in seeds), "train")
