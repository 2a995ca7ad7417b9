"""Push buttons that a service presses: each press lasts one tick and is followed by at least one tick without."""

from __future__ import annotations

from collections.abc import Callable, MutableMapping
from typing import Any

from softrig_core.block.port import Port


class Buttons:
    """The buttons of a node.

    Parameters
    ----------
    values : mutable mapping
        Values of the node's inputs, which a press changes.
    record : callable
        Gets the port and whether it went down.

    Attributes
    ----------
    pressed : dict of Port to int
        Presses that the block has not yet processed completely, down and up; if it is empty, there is nothing to
        `release`.
    """

    def __init__(self, values: MutableMapping[str, Any], record: Callable[[Port, bool], None]) -> None:
        self._values = values
        self._record = record
        self.pressed: dict[Port, int] = {}

    def press(self, port: Port) -> tuple[bool, str]:
        """Press the button; return whether that was possible, and the text of the answer."""
        if port not in self.pressed:
            if self._values[port.name] == (1.0,):
                return False, f"{port.name} is held down by its topic"
            self.pressed[port] = 0
            self._push(port, True)
        self.pressed[port] += 1
        return True, f"{port.name} pressed"

    def release(self) -> None:
        """Move the buttons; called after each tick."""
        for port in list(self.pressed):
            if self._values[port.name] == (1.0,):
                # The block must see the button up for one tick, or two presses would be one.
                self._push(port, False)
                continue
            self.pressed[port] -= 1
            if self.pressed[port]:
                self._push(port, True)
            else:
                del self.pressed[port]

    def _push(self, port: Port, down: bool) -> None:
        self._values[port.name] = (float(down),)
        self._record(port, down)
