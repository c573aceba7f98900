from __future__ import annotations

from collections.abc import Iterator

import pytest

from lunar_rescue import LunarRescueEnv


@pytest.fixture(scope="module")
def env() -> Iterator[LunarRescueEnv]:
    made = LunarRescueEnv()
    yield made
    made.close()
