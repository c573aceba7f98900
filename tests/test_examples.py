"""The documented example on an environment that is not ours learns, by two layers and by FeUdal Networks."""

from __future__ import annotations

import runpy

import numpy as np
import pytest

from reproduce.storage.paths import ROOT


@pytest.mark.parametrize("method", ["two_layers", "feudal"])
def test_it_learns_on_pendulum(method: str) -> None:
    """Untrained networks and random actions have about -1250; trials had -780 and -640 in the last updates."""
    returns = runpy.run_path(str(ROOT / "examples" / "pendulum.py"))[method](80_000)
    assert np.nanmean(returns[-20:]) > np.nanmean(returns[:3]) + 200.0
