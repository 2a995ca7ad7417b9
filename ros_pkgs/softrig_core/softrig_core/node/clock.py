"""A clock that is no plant: time for rigs without one, or faster than every plant of a rig."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ..model.block import Plant
from . import executable


class Clock(Plant):
    """Has a period and nothing else; a node of it publishes /clock."""

    @property
    def state(self) -> tuple[float, ...]:
        """Give nothing."""
        return ()

    def put(self, state: Sequence[float]) -> None:
        """There is nothing to change."""

    def outputs(self, t: int) -> Mapping[str, Any]:
        """Give nothing."""
        return {}

    def advance(self, t: int, **inputs: Any) -> None:
        """Change nothing."""


main = executable(Clock)
