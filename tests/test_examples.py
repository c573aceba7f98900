"""The documented example on an environment that is not ours learns, by two layers and by FeUdal Networks."""

from __future__ import annotations

import runpy

import numpy as np
import pytest

from reproduce.storage.paths import ROOT


@pytest.mark.slow  # a learning test
@pytest.mark.parametrize("method", ["two_layers", "feudal"])
def test_it_learns_on_pendulum(method: str) -> None:
    """Untrained networks and random actions have about -1250, and 80 episodes show a mean with a deviation of about 35.

    Six trials, three seeds of each method, had -990 to -900 in the last ten updates.
    """
    returns = runpy.run_path(str(ROOT / "examples" / "pendulum.py"))[method](40_000)
    assert np.nanmean(returns[-10:]) > max(-1080.0, np.nanmean(returns[:3]) + 100.0)
