"""TOML that a user wrote, with a bound on what its parser takes for ever for."""

from __future__ import annotations

import tomllib
from typing import Any

_MOST_DOTS = 1000
"""On one line: the time of a key grows with the square of its parts."""


def parse_toml(text: str) -> dict[str, Any]:
    """Return the values of a TOML document; `ValueError` where it is none, is nested too deep, or a line has too many dots."""
    for number, line in enumerate(text.splitlines(), 1):
        if (dots := line.count(".")) > _MOST_DOTS:
            raise ValueError(f"line {number} has {dots} dots, at most {_MOST_DOTS}")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError("its values are nested too deep") from None
