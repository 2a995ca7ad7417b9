"""Measured numbers as people read them."""

from __future__ import annotations

import math

# Written in place of the number of an event that does not happen.
NEVER = "never"


def readable(value: float) -> str:
    """Write a measured number for people: infinity becomes never."""
    return NEVER if value == math.inf else f"{value:.6g}"
