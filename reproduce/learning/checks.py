"""Checks that several configurations share."""

from __future__ import annotations

from typing import Any


def whole_numbers(config: Any, *names: str) -> None:
    """Refuse fields of a configuration that are not integers from 1 up.

    Raises:
        ValueError: Naming the field.
    """
    for name in names:
        value = getattr(config, name)
        if isinstance(value, bool) or not isinstance(value, int) or value < 1:
            raise ValueError(f"{name}: expected an integer >= 1, got {value!r}")
