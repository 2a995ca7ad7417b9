"""A lockstep run held by a person: the node of the clock stays at a tick, and all others wait for it as they always do.

What is held is only when a tick is taken, never what is in it: the numbers are those of a run that nobody held.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ...timebase import SECOND
from .middleware import Middleware
from .solving import BUSY, TOLD_EVERY
from .tick import TICK, TickWriter

SERVICES = ("pause", "resume", "step")  # std_srvs/Trigger, below the name of the node


class Hold:
    """Whether the node of the clock may go on.

    Parameters
    ----------
    held : bool
        From the start.

    Attributes
    ----------
    held : bool
    steps : int
        That it may take all the same.
    """

    def __init__(self, held: bool = False) -> None:
        self.held = held
        self.steps = 0
        self._turn: Callable[[], object] | None = None
        self._tells = False

    def begin(self, middleware: Middleware, turn: Callable[[], object]) -> None:
        """Serve a node that owns the clock; `turn` has its ticks go on."""
        self._turn, self._middleware = turn, middleware
        if self.held:
            self._tell()

    def _tell(self) -> None:
        """Have the peers be patient while it is held."""
        if self._tells:
            return
        self._tells = True
        header = TickWriter()(0, [self._middleware.full_name])
        publish = self._middleware.publisher(BUSY, TICK, lambda count: None)
        self._middleware.timer(round(TOLD_EVERY * SECOND), lambda: publish(header) if self.held else None)

    def holds(self, t: int) -> bool:
        """Whether the step from tick `t` to the next one has to wait; a single step is used up by it."""
        if self.held and self.steps:
            self.steps -= 1
            return False
        return self.held

    def ask(self, what: str, steps: int = 1) -> tuple[bool, str]:
        """Pause, resume or take steps; gives whether that could be done, and what to say."""
        if self._turn is None:
            return False, "this node has not begun"
        if what == "pause":
            self.held = True
            self._tell()
            return True, "paused"
        if what == "step":
            if not self.held:
                return False, "it runs: pause it first"
            self.steps += steps
        else:
            self.held, self.steps = False, 0
        self._middleware.post(self._turn)
        return True, "one step" if what == "step" else "goes on"


def offer(node: Any, hold: Hold, trigger: Any) -> None:
    """Offer the services of a node; `trigger` is the class of std_srvs/Trigger."""
    for name in SERVICES:

        def answer(request: Any, response: Any, name: str = name) -> Any:
            response.success, response.message = hold.ask(name)
            return response

        node.create_service(trigger, f"~/{name}", answer)
