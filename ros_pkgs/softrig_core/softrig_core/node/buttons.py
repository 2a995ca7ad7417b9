"""Push buttons that a service presses: one tick down, at least one up, however fast the calls come."""

from __future__ import annotations

from collections.abc import Callable, MutableMapping
from typing import Any

from .endpoint import Input


class Buttons:
    """The buttons of a node.

    Parameters
    ----------
    values : mutable mapping
        Values of the node's inputs, which a press changes.
    record : callable
        Gets the input and whether it went down.
    """

    def __init__(self, values: MutableMapping[str, Any], record: Callable[[Input, bool], None]) -> None:
        self._values = values
        self._record = record
        self._presses: dict[Input, int] = {}  # that the block has not seen go down and up again

    def press(self, item: Input) -> tuple[bool, str]:
        """Press; gives whether that could be done, and what to say."""
        if item not in self._presses:
            if self._values[item.name] == (1.0,):
                return False, f"{item.name} is held down by its topic"
            self._presses[item] = 0
            self._push(item, True)
        self._presses[item] += 1
        return True, f"{item.name} pressed"

    def release(self) -> None:
        """Move the buttons; called after each tick."""
        if not self._presses:
            return
        for item in list(self._presses):
            if self._values[item.name] == (1.0,):
                self._push(item, False)
                continue
            self._presses[item] -= 1
            if self._presses[item]:
                self._push(item, True)
            else:
                del self._presses[item]

    def _push(self, item: Input, down: bool) -> None:
        self._values[item.name] = (float(down),)
        self._record(item, down)
