"""Which seeds belong to which split, so that what is tested on was never trained on.

Whatever is tried is tried on ``train`` and judged on ``validation`` and ``validation-heldout``; ``test`` and
``heldout`` are for final figures alone. ``validation`` and ``test`` scenes are drawn as training scenes are, from other
seeds; both held-out splits have postures of their own, and rock fields, reliefs and masses that no other scene has.
"""

_SIZE = 10_000_000
TRAIN = range(0, 2_000_000_000)
VALIDATION, VALIDATION_HELDOUT, TEST, HELDOUT = (
    range(TRAIN.stop + i * _SIZE, TRAIN.stop + (i + 1) * _SIZE) for i in range(4)
)
SPLITS: dict[str, range] = {
    "train": TRAIN,
    "validation": VALIDATION,
    "validation-heldout": VALIDATION_HELDOUT,
    "test": TEST,
    "heldout": HELDOUT,
}
HELD_OUT = ("validation-heldout", "heldout")  # splits that have what no training scene has
FINAL = ("test", "heldout")  # splits for final figures


def split_of(seed: int) -> str:
    """Return the name of the split that a scene's seed belongs to.

    Raises:
        ValueError: On a seed of no split.
    """
    for name, seeds in SPLITS.items():
        if seed in seeds:
            return name
    raise ValueError(f"seed: expected 0 to {HELDOUT.stop - 1}, got {seed!r}")
