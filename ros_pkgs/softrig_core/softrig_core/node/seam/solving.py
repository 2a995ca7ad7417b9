"""Lockstep of a solver node: its executor goes on turning while the work is under way, and the peers are told."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from ...block.port import Port
from ...solver.solver import Solver
from .endpoint import Input
from .middleware import Middleware
from .tick import TICK, TickWriter

BUSY = "/softrig/busy"  # std_msgs/Header, frame_id = the node: who waits for progress is to be patient
TOLD_EVERY = 0.5  # s
LOOK = 2_000_000  # ns


class Solving:
    """One solver block between the begin of a tick and its answer.

    Parameters
    ----------
    middleware : Middleware
    block : Solver
    resume : callable
        Called when the answer that was waited for is there.
    """

    def __init__(self, middleware: Middleware, block: Solver, resume: Callable[[], object]) -> None:
        self.block = block
        self._middleware = middleware
        self._header = TickWriter()(0, [middleware.full_name])
        self._publish = middleware.publisher(BUSY, TICK, lambda count: None)
        self._resume = resume
        self._tick: int | None = None  # whose begin the block has seen and whose end not yet
        self._told = 0.0
        self._timer = middleware.timer(LOOK, self._look)
        self._timer.cancel()
        self._waits = False

    def finished(self, t: int, inputs: Mapping[str, Any] | None) -> bool:
        """Begin a tick if that is not done; tell whether its answer can be given.

        Parameters
        ----------
        t : int
            ns.
        inputs : mapping or None
            None when one of them was refused.
        """
        if self._tick != t:
            self._tick = t
            if inputs is None:
                self.block.carry_on(t)
            else:
                self.block.begin(t, **inputs)
        if self.block.ready(t):
            self._rest()
            return True
        if not self._waits:
            self._waits = True
            self._told = self._middleware.steady()
            self._timer.again(LOOK)
        return False

    def _rest(self) -> None:
        self._timer.cancel()
        self._waits = False

    def _look(self) -> None:
        assert self._tick is not None
        if self.block.ready(self._tick):
            self._rest()
            self._resume()
        elif self._middleware.steady() - self._told > TOLD_EVERY:
            self._told = self._middleware.steady()
            self._publish(self._header)


def hear_busy(middleware: Middleware, solvers: int, heard: Callable[[], None]) -> Input:
    """Call a function whenever a solver of the rig says that it is at work.

    Parameters
    ----------
    middleware : Middleware
    solvers : int
        How many there are, this node included: the input has a publisher when all of them are matched.
    heard : callable
    """
    item = Input(Port("busy", BUSY, TICK))

    def matched(count: int) -> None:
        item.outside = count // solvers

    middleware.subscribe(BUSY, TICK, lambda data: heard(), matched)
    return item
