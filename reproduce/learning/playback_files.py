"""Keep what demonstrations look like to a learner, so that trainings that imitate the same ones play them once.

Playing back takes as long as the physics of every step. A file is of these demonstrations, this view of them and these
sources, or is not found; the seconds that it took stand in it and count for each training that uses it.
"""

import hashlib
import json
import time
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from safetensors import safe_open
from safetensors.torch import save_file

import lunar_rescue
from reproduce.learning.demonstrations import Demonstration, PlayedBack, play_back
from reproduce.storage.errors import UserError
from reproduce.storage.files import locked, write_atomically
from reproduce.storage.policies import read_tensors

LARGEST = 8_000_000_000  # bytes of a file
# Of physics and observations, and of a learner's view of them.
_SOURCES = (Path(lunar_rescue.__file__).parent, Path(__file__).parent)
_SUFFIXES = (".py", ".json", ".urdf", ".obj")
_ROWS = tuple(field.name for field in fields(PlayedBack) if field.name != "begin")


def play_back_once(
    folder: Path, demonstrations: Sequence[Demonstration], **view: Any
) -> tuple[list[PlayedBack], float]:
    """Return demonstrations played back as from ``play_back``, and the seconds that it took, now or before.

    ``folder`` holds one file for each set of demonstrations and ``view``, which are the arguments of ``play_back``.
    Another process that plays back into the same folder is waited for. A file that cannot be read is made anew.
    """
    path = folder / f"played_{_key(demonstrations, view)}.safetensors"
    with locked(folder, "playback", name=".playback", wait=True):
        try:
            return _read(path)
        except UserError:
            begun = time.monotonic()
        played = play_back(demonstrations, **view)
        seconds = time.monotonic() - begun
        if played:
            _write(path, played, seconds)
    return played, seconds


def _key(demonstrations: Sequence[Demonstration], view: dict[str, Any]) -> str:
    digest = hashlib.sha256(repr(sorted(view.items())).encode())
    for one in demonstrations:
        digest.update(f"{one.seed} {one.begin} {len(one.actions)}".encode())
        digest.update(one.actions.tobytes() + one.wanted.tobytes())
    for source in sorted(path for root in _SOURCES for path in root.rglob("*") if path.suffix in _SUFFIXES):
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


def _write(path: Path, played: Sequence[PlayedBack], seconds: float) -> None:
    rows = {name: np.concatenate([getattr(one, name) for one in played]) for name in _ROWS}
    numbers = {"lengths": [len(one.rewards) for one in played], "begins": [one.begin for one in played]}
    tensors = {name: th.from_numpy(np.asarray(values)) for name, values in (rows | numbers).items()}
    header = {"seconds": json.dumps(seconds)}
    write_atomically(path, lambda temporary: save_file(tensors, temporary, metadata=header))


def _read(path: Path) -> tuple[list[PlayedBack], float]:
    tensors = read_tensors(path, LARGEST)
    with safe_open(path, framework="pt") as file:
        seconds = float(json.loads(file.metadata()["seconds"]))
    ends = np.cumsum(tensors["lengths"].numpy())[:-1]
    columns = {name: np.split(tensors[name].numpy(), ends) for name in _ROWS}
    begins = tensors["begins"].tolist()
    played = [
        PlayedBack(**{name: rows[index] for name, rows in columns.items()}, begin=begin)
        for index, begin in enumerate(begins)
    ]
    return played, seconds
