"""A clock for rigs without a plant, or with a shorter period than every plant."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..block.block import Plant
from ..block.params import BlockParams, param


class ClockParams(BlockParams):
    """Parameters of the clock; its default period is that of the slowest node."""

    period: float = param(0.01, "period; also a fraction as text: 1/2880", "s", gt=0.0, le=86400.0)


class Clock(Plant[ClockParams]):
    """A block with only a period; its node publishes /clock."""

    def outputs(self, x: Any, t: int) -> Mapping[str, Any]:
        """Return nothing."""
        return {}

    def advance(self, x: Any, t: int, **inputs: Any) -> Any:
        """Change nothing."""
        return x
