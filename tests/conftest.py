from __future__ import annotations

import signal
from collections.abc import Iterator

import pytest

from lunar_rescue import LunarRescueEnv

# A shell starts what runs in the background deaf to Ctrl-C, and processes that tests start would inherit that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="module")
def env() -> Iterator[LunarRescueEnv]:
    made = LunarRescueEnv()
    yield made
    made.close()
