"""A block whose state is not in this process: on a board, or in a third-party node."""

from __future__ import annotations

from typing import Any, NamedTuple

from ..block.block import Block


class LinkState(NamedTuple):
    """The number of answered ticks; for a plant on a board also the time and inputs of its next step."""

    k: int = 0
    moved: tuple[Any, ...] = ()


class Elsewhere(Block):
    """Replaces a block; it knows only the number of ticks of its state."""

    def first(self) -> LinkState:
        """Return the state before the first tick."""
        return LinkState()

    def go_on(self, x: LinkState, before: Any) -> LinkState:
        """Return the state unchanged: changed parameters are sent to its place, or do not belong to this process."""
        return x

    def params(self, x: LinkState) -> Any:
        """Return the parameters as they were set; no state moves one."""
        return self.p

    def markers(self, x: LinkState) -> tuple[()]:
        """Return no markers, because the block's state is on the board."""
        return ()
