"""Lockstep of a solver node: its executor stays active during the work, and other nodes are notified."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from softrig_core.block.link import Link
from softrig_core.block.port import Port
from softrig_core.block.step import Step
from softrig_core.solver.solver import Solver

from .endpoint import Input
from .middleware import Middleware
from .tick import TICK, TickWriter

BUSY = "/softrig/busy"  # std_msgs/Header, frame_id = the node: nodes that wait for progress are to be patient
REPORT_EVERY = 0.5  # s
LOOK = 2_000_000  # ns


class Solving(Link):
    """One solver block between the begin of a tick and its answer.

    Parameters
    ----------
    step : Step
        Step of the solver: its x holds the requests that a tick has begun.
    resume : callable
        Called when the awaited answer is available.
    """

    def __init__(self, middleware: Middleware, step: Step, resume: Callable[[], object]) -> None:
        assert isinstance(step.block, Solver)
        super().__init__(step)
        self._block = step.block
        self._middleware = middleware
        self._header = TickWriter()(0, [middleware.full_name])
        self._publish = middleware.publisher(BUSY, TICK, lambda count: None)
        self._resume = resume
        self._reported_at = 0.0
        self._timer = middleware.timer(LOOK, self._check)
        # The timer runs only while an answer is waited for.
        self._timer.cancel()
        self._waits = False

    # The inputs were read when the tick began, so the answer needs none.
    READS = False

    def respond(self, x: Any, t: int, **inputs: Any) -> Any:
        """Return the answer of a tick that has begun."""
        return self._block.end(x, t)

    @property
    def working(self) -> bool:
        """Return whether a request is in progress or pending."""
        return self._block.working(self.step.x)

    def finished(self, t: int) -> bool:
        """Begin a tick (ns) if it has not begun; return whether its answer is available."""
        step, block = self.step, self._block
        # This is called repeatedly until the answer is there, but a tick begins once. After a rejected input there is
        # no new request, only the work in progress.
        if step.begun != t:
            step.begun = t
            step.x = block.carry_on(step.x, t) if step.bad else block.begin(step.x, t, **step.values)
        if block.ready(step.x, t):
            self._release_idle()
            return True
        if not self._waits:
            self._waits = True
            self._reported_at = self._middleware.steady()
            self._timer.again(LOOK)
        return False

    def _release_idle(self) -> None:
        self._timer.cancel()
        self._waits = False

    def _check(self) -> None:
        assert self.step.begun is not None
        if self._block.ready(self.step.x, self.step.begun):
            self._release_idle()
            self._resume()
        elif self._middleware.steady() - self._reported_at > REPORT_EVERY:
            self._reported_at = self._middleware.steady()
            self._publish(self._header)


class Busy(Input):
    """The topic that the solvers of a rig publish while they work.

    Parameters
    ----------
    solvers : int
        Number of solvers, this node included. All of them publish on one topic, so the input counts as having a
        publisher only when all are matched.
    received : callable
        Called at each message.
    """

    def __init__(self, middleware: Middleware, solvers: int, received: Callable[[], None]) -> None:
        super().__init__(Port("busy", BUSY, TICK))
        self._solvers, self._on_message = solvers, received
        middleware.subscribe(BUSY, TICK, self)

    def receive(self, data: bytes) -> None:
        """Report that a solver is at work."""
        self._on_message()

    def matched(self, count: int) -> None:
        """Note how many solvers are matched."""
        self.outside = count // self._solvers
