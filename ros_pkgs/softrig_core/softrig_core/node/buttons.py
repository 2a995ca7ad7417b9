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

    Attributes
    ----------
    pressed : dict of Input to int
        Presses that the block has not seen go down and up again; nothing to `release` when it is empty.
    """

    def __init__(self, values: MutableMapping[str, Any], record: Callable[[Input, bool], None]) -> None:
        self._values = values
        self._record = record
        self.pressed: dict[Input, int] = {}

    def press(self, item: Input) -> tuple[bool, str]:
        """Press; gives whether that could be done, and what to say."""
        if item not in self.pressed:
            if self._values[item.name] == (1.0,):
                return False, f"{item.name} is held down by its topic"
            self.pressed[item] = 0
            self._push(item, True)
        self.pressed[item] += 1
        return True, f"{item.name} pressed"

    def release(self) -> None:
        """Move the buttons; called after each tick."""
        for item in list(self.pressed):
            if self._values[item.name] == (1.0,):
                self._push(item, False)
                continue
            self.pressed[item] -= 1
            if self.pressed[item]:
                self._push(item, True)
            else:
                del self.pressed[item]

    def _push(self, item: Input, down: bool) -> None:
        self._values[item.name] = (float(down),)
        self._record(item, down)
