"""Solver nodes: blocks whose work takes longer than a tick may, in a process of its own.

A tick of a `Solver`::

    ask = request(t, inputs)              # None: nothing new
    if ask: it waits; a waiting one is replaced (or, with CANCELS, the one under way is killed)
    if nothing is under way and one waits: work on it begins, its result takes effect at t + latency
    if the result of the one under way is due at t:
        lockstep, in process: wait for it (peers are told that we are busy)
        realtime: take it if it is there, else go on without
    answer(t, newest result in effect, whether it is new at this tick)

When a result takes effect is decided by simulated time alone, so runs repeat however fast the host is. The one
exception is the limit: a wall-clock time after which the work is killed. Its result, the best answer that the work left
so far, says that it is not repeatable.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

from typing_extensions import TypeVar

from ..block.block import Block, Level, Values
from ..block.params import BlockParams, param
from ..errors import RunError
from ..timebase import to_ns, to_s
from .worker import Work, Worker


class SolverParams(BlockParams):
    """What every solver node has."""

    period: float = param(0.1, "sampling period: how often it looks for a request and answers", "s", gt=0.0, le=3600.0)
    latency: float = param(
        0.0, "simulated time from a request to the tick at which its result takes effect; 0: the loop waits", "s",
        ge=0.0, le=86400.0,
    )  # fmt: skip
    limit: float = param(
        300.0, "wall-clock time after which work is killed and its best answer so far taken, not repeatable", "s",
        gt=0.0, le=86400.0,
    )  # fmt: skip


S = TypeVar("S", bound=SolverParams, default=Any)


class Result(NamedTuple):
    """What came of a request."""

    stamp: int
    """Time of the request, ns."""

    request: Any
    """What was asked; newer requests may have come since."""

    answer: Any
    """None when the limit struck before there was any answer."""

    repeatable: bool
    """Whether every run gives it; False when the limit struck."""


class Solver(Block[S]):
    """A block that answers requests by slow work; a subclass gives `request`, `solve` and `answer`.

    `solve` is a static method: it sees nothing but its request, and anything it keeps for the next one could be lost
    with its process. What a warm start needs belongs into the request. Parameters are those of the start: a request
    under way was made with them.

    Examples
    --------
    >>> class Dispatch(Solver[DispatchParams]):
    ...     def request(self, t, *, demand):
    ...         return None if demand == self.asked else demand
    ...
    ...     @staticmethod
    ...     def solve(demand, work):
    ...         return cheapest(demand, tell=work.status)
    ...
    ...     def answer(self, t, result, new):
    ...         return {"dispatch": result.answer if result else self.idle}
    """

    # a new request kills the work under way instead of waiting for its end; with requests that come faster than
    # the latency there is never a result then
    CANCELS: ClassVar[bool] = False

    def request(self, t: int, **inputs: Any) -> Any:
        """Give what is to be worked on, picklable; None when this tick asks nothing new."""
        raise NotImplementedError

    @staticmethod
    def solve(request: Any, work: Work) -> Any:
        """Work on a request, in another process; tell `work` how far it is and the best answer so far.

        Parameters
        ----------
        request : any
            What `request` gave, as it was pickled.
        work : Work
            Takes how far it is and the best answer so far.
        """
        raise NotImplementedError

    def answer(self, t: int, result: Result | None, new: bool) -> Values:
        """Give the outputs of a tick.

        Parameters
        ----------
        t : int
            ns.
        result : Result or None
            The newest in effect; None before the first.
        new : bool
            Whether it takes effect at this tick.
        """
        raise NotImplementedError

    def reset(self, seed: int) -> None:
        """Go back to the initial state; work under way is killed."""
        worker: Worker | None = self.__dict__.get("_worker")
        if worker is None:
            self._worker = Worker(type(self).solve)
        elif worker.state == "working":
            worker.cancel()
        self._latency = to_ns(self.p.latency)
        self._waiting: tuple[int, Any] | None = None
        self._active: tuple[int, int, Any] | None = None  # stamp, when it takes effect, request
        self._result: Result | None = None
        self._struck = False
        super().reset(seed)

    def rest(self) -> None:
        """Leave the process that works to others, if it does nothing: the run is over."""
        self._worker.rest()

    @property
    def working(self) -> bool:
        """Whether a request is under way or waits."""
        return self._active is not None or self._waiting is not None

    def update(self, t: int, **inputs: Any) -> Values:
        """Answer one tick; waits for a result that is due, unless the loop runs against the wall clock."""
        self.begin(t, **inputs)
        return self._finish(t)

    def refused(self, t: int) -> Values | None:
        """Go on with what is under way; a request that was refused asks nothing."""
        self.carry_on(t)
        return self._finish(t)

    def begin(self, t: int, **inputs: Any) -> None:
        """Take the request of a tick and begin to work; the first of the three parts of `update`."""
        asked = self.request(t, **inputs)
        if asked is not None:
            if self.CANCELS and self._active is not None and self._in_vain(t, self._active[1]):
                self._worker.cancel()
                self._active = None
            self._waiting = (t, asked)
        self.carry_on(t)

    def _in_vain(self, t: int, effect: int) -> bool:
        return self._worker.state == "working" if self.realtime else t < effect

    def carry_on(self, t: int) -> None:
        """Begin to work on what waits, if nothing is under way; in place of `begin` at a tick without request."""
        if self._active is not None:
            return
        if self._waiting is None:
            self._worker.warm()
            return
        stamp, asked = self._waiting
        self._waiting = None
        self._active = (stamp, t + self._latency, asked)
        self._worker.submit(asked)

    def ready(self, t: int) -> bool:
        """Tell whether the answer of a tick can be given now, and kill work that is beyond its limit."""
        if self._active is None or (t < self._active[1] and not self.realtime):
            return True
        if self._worker.state == "working" and self._worker.elapsed() > self.p.limit:
            self._strike()
        return self.realtime or self._worker.state != "working"

    def _strike(self) -> None:
        worker = self._worker
        best, found = worker.best, worker.has_best
        worker.cancel()
        worker.answer, worker.state = best if found else None, "done"
        self._struck = True
        text = f"{'best answer so far' if found else 'no answer'} after {self.p.limit:g} s: this result does not repeat"
        self.report(Level.WARN, "limit", text)

    def _finish(self, t: int) -> Values:
        while not self.ready(t):
            # a while at a time: the limit counts from a begin that may not have come yet
            self._worker.wait(min(max(0.0, self.p.limit - self._worker.elapsed()), 0.25) + 1e-3)
        return self.end(t)

    def end(self, t: int) -> Values:
        """Take the result that is due and give the outputs; the last part of `update`.

        Raises
        ------
        RunError
            The work raised or its process died; against the wall clock that is reported instead.
        """
        new = False
        if self._active is not None and t >= self._active[1] and self._worker.state != "working":
            stamp, _, asked = self._active
            self._active = None
            if self._worker.state == "failed":
                text = f"work on the request of t = {to_s(stamp):.9g} s failed: {self._worker.error}"
                if not self.realtime:
                    raise RunError(text)
                self.report(Level.ERROR, "work", text)
            else:
                self._result = Result(stamp, asked, self._worker.answer, not self._struck)
                self._struck = False
                new = True
            self.carry_on(t)
        return self.answer(t, self._result, new)

    def health(self) -> Mapping[str, str]:
        """Tell how far the work is."""
        if self._active is None:
            return {"work": "idle"}
        figures = {name: f"{v:.9g}" if isinstance(v, float) else str(v) for name, v in self._worker.status.items()}
        return {"work": f"request of t = {to_s(self._active[0]):.9g} s, {self._worker.elapsed():.1f} s", **figures}
