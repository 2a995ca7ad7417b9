"""The patient's force as an input of blocks."""

from __future__ import annotations

from softrig_core import Block, Level


def clip_force(block: Block, wrench: tuple[float, ...] | None, limit: float) -> tuple[float, float, float]:
    """Return the force of a wrench (N), cut down to the limit with a warning; zero without a patient."""
    if wrench is None:
        return (0.0, 0.0, 0.0)
    x, y, z = wrench[:3]
    size = (x * x + y * y + z * z) ** 0.5
    if size <= limit:
        return (x, y, z)
    block.report(Level.WARN, "force", f"the force at the foot is cut down to {limit:g} N, got {size:.6g} N")
    return (x * limit / size, y * limit / size, z * limit / size)
