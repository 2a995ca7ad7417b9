"""The slots of a three-phase stator with one pair of poles, for drawings."""

from __future__ import annotations

import math

SLOTS = 12  # two a side of each phase
PHASES = (("a", "accent"), ("b", "second"), ("c", "third"))
THIRD = 2.0 * math.pi / 3.0


def belt(slot: int) -> tuple[int, int]:
    """Return phase and sense of a slot: a current out of the page a quarter turn after its axis makes flux along it."""
    angle = 2.0 * math.pi * (slot + 0.5) / SLOTS
    turns = [math.sin(angle - k * THIRD) for k in range(3)]  # 1 a quarter turn after the axis of phase k
    phase = max(range(3), key=lambda k: abs(turns[k]))
    return phase, 1 if turns[phase] > 0 else -1
