"""Solver nodes: blocks whose work may take longer than a tick, in a separate process.

A tick of a `Solver`::

    x, ask = request(x, t, inputs)        # None: nothing new
    if ask: it waits; a waiting one is replaced (or, with CANCELS, the one under way is killed)
    if nothing is under way and one waits: work on it begins, its result takes effect at t + latency
    if the result of the one under way is due at t:
        lockstep, in process: wait for it (report to peers that we are busy)
        realtime: use it if it is available, else continue without
    x, values = answer(x, t, newest result in effect, whether it is new at this tick)

Simulated time alone decides when a result takes effect, so runs are repeatable on a host of any speed. The one
exception is the limit: a wall-clock time after which the work is killed. Its result, the best answer that the work
stored so far, is marked as not repeatable.

Which requests wait, are under way or answered is part of the state, `x.jobs`. The process is not: its work follows
from x. If a run returns to an earlier x, the work that was under way then is repeated.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

from typing_extensions import TypeVar

from ..block.block import Block, Level, Values
from ..block.params import BlockParams, param
from ..errors import RunError
from ..timebase import to_ns, to_s
from .worker import Work, Worker

UNFINISHED = "unfinished"  # key of the report that counts the ticks answered without a result that was due


class SolverParams(BlockParams):
    """The parameters of every solver node."""

    period: float = param(
        0.1, "sampling period, at which it checks for a request and publishes", "s", gt=0.0, le=3600.0
    )
    latency: float = param(
        0.0,
        "simulated time from a request to the tick at which its result takes effect; 0: the loop waits",
        "s",
        ge=0.0,
        le=86400.0,
    )
    limit: float = param(
        300.0,
        "wall-clock time after which work is killed and its best answer so far used, not repeatable",
        "s",
        gt=0.0,
        le=86400.0,
    )


S = TypeVar("S", bound=SolverParams, default=Any)


class Result(NamedTuple):
    """A request and its answer."""

    stamp: int
    """Time of the request, ns."""

    request: Any
    """What was asked; newer requests may have come since."""

    answer: Any
    """None when the limit struck before there was any answer."""

    repeatable: bool
    """Whether every run gives it; False when the limit struck."""


@dataclass(frozen=True, slots=True, eq=False)
class Job:
    """A request, itself and no other that is equal."""

    stamp: int
    """When it was made, ns."""

    request: Any


@dataclass(frozen=True, slots=True)
class Jobs:
    """The progress of a solver with its requests; opaque to a linear view."""

    waiting: Job | None = None
    active: Job | None = None
    effect: int = 0
    """When the result of the active one takes effect, ns."""

    result: Result | None = None
    """The newest in effect."""


class SolverState(NamedTuple):
    """State of a solver that stores only its requests."""

    jobs: Jobs = Jobs()


class Solver(Block[S]):
    """A block that answers requests by slow work; a subclass defines `request`, `solve` and `answer`.

    `solve` is a static method: it reads only its request, and anything that it stores for the next one could be lost
    with its process. Put the data for a warm start into the request. Parameters keep their values of the start, because
    a request under way was created with them.

    A subclass with more state returns its own type from `first`, with a field ``jobs: Jobs = Jobs()``.

    Examples
    --------
    >>> class State(NamedTuple):
    ...     asked: tuple[float, ...] | None = None
    ...     jobs: Jobs = Jobs()
    >>> class Dispatch(Solver[DispatchParams]):
    ...     def first(self):
    ...         return State()
    ...
    ...     def request(self, x, t, *, demand):
    ...         return x._replace(asked=demand), None if demand == x.asked else demand
    ...
    ...     @staticmethod
    ...     def solve(demand, work):
    ...         return cheapest(demand, tell=work.status)
    ...
    ...     def answer(self, x, t, result, new):
    ...         return x, {"dispatch": result.answer if result else self.idle}
    """

    # With this, a new request kills the work under way instead of waiting for its end. If requests arrive faster than
    # the latency, there is never a result.
    CANCELS: ClassVar[bool] = False
    SCRATCH = frozenset({"worker"})  # the process: what it works on is in `x.jobs`
    STATE: ClassVar[type[Any]] = SolverState

    def request(self, x: Any, t: int, **inputs: Any) -> tuple[Any, Any]:
        """Return x and the request, which must be picklable; None if this tick makes no new request."""
        raise NotImplementedError

    @staticmethod
    def solve(request: Any, work: Work) -> Any:
        """Work on a request, in another process; report progress and the best answer so far to `work`.

        Parameters
        ----------
        request : any
            The return value of `request`, pickled and unpickled.
        work : Work
            Receives progress and the best answer so far.
        """
        raise NotImplementedError

    def answer(self, x: Any, t: int, result: Result | None, new: bool) -> tuple[Any, Values]:
        """Return x and the outputs of a tick.

        Parameters
        ----------
        x : named tuple
        t : int
            ns.
        result : Result or None
            The newest in effect, ``x.jobs.result``; None before the first.
        new : bool
            Whether it takes effect at this tick.
        """
        raise NotImplementedError

    def reset(self, seed: int) -> None:
        """Restore the initial state; kill the current work."""
        self.worker = Worker(type(self).solve)
        super().reset(seed)

    def release(self) -> None:
        """Release the worker process if it is idle, since the run is over."""
        self.worker.release()

    def working(self, x: Any) -> bool:
        """Return whether a request is in progress or pending."""
        return x.jobs.active is not None or x.jobs.waiting is not None

    def update(self, x: Any, t: int, **inputs: Any) -> tuple[Any, Values]:
        """Run one tick; wait for a result that is due, unless the loop runs in real time."""
        return self._finish(self.begin(x, t, **inputs), t)

    def refused(self, x: Any, t: int) -> tuple[Any, Values | None]:
        """Continue with the current work; a tick with a rejected input makes no request."""
        return self._finish(self.carry_on(x, t), t)

    def begin(self, x: Any, t: int, **inputs: Any) -> Any:
        """Read the request of a tick and start to work; the first of the three parts of `update`."""
        x, asked = self.request(x, t, **inputs)
        if asked is not None:
            jobs: Jobs = replace(x.jobs, waiting=Job(t, asked))
            if self.CANCELS and jobs.active is not None and self._in_vain(t, jobs.effect):
                jobs = replace(jobs, active=None)
            x = x._replace(jobs=jobs)
        return self.carry_on(x, t)

    def _in_vain(self, t: int, effect: int) -> bool:
        # In lockstep simulated time decides, for the state of the process would make runs differ.
        return self.worker.state == "working" if self.realtime else t < effect

    def carry_on(self, x: Any, t: int) -> Any:
        """Start the pending request if none is in progress; replaces `begin` at ticks without a request."""
        jobs: Jobs = x.jobs
        if jobs.active is None and jobs.waiting is not None:
            jobs = Jobs(None, jobs.waiting, t + to_ns(self.p.latency), jobs.result)
            x = x._replace(jobs=jobs)
        if jobs.active is None:
            if self.worker.state == "working":
                self.worker.cancel()
            self.worker.warm()
        # This is a new request, or the state went back to one whose work must be done once more.
        elif self.worker.job is not jobs.active:
            if self.worker.state == "working":
                self.worker.cancel()
            self.worker.submit(jobs.active.request, jobs.active)
        return x

    def ready(self, x: Any, t: int) -> bool:
        """Return whether the answer of a tick can be given now, and kill work that exceeds its limit."""
        if x.jobs.active is None or (t < x.jobs.effect and not self.realtime):
            return True
        if self.worker.state == "working" and self.worker.elapsed() > self.p.limit:
            self.worker.strike()
        return self.realtime or self.worker.state != "working"

    def _finish(self, x: Any, t: int) -> tuple[Any, Values]:
        while not self.ready(x, t):
            # The wait is cut into pieces, because the limit counts from the begin of the work, which may be still to
            # come.
            self.worker.wait(min(max(0.0, self.p.limit - self.worker.elapsed()), 0.25) + 1e-3)
        return self.end(x, t)

    def end(self, x: Any, t: int) -> tuple[Any, Values]:
        """Return the outputs with the result that is due; the last part of `update`.

        Raises
        ------
        RunError
            The work raised or its process died; against the wall clock that is reported instead.
        """
        jobs: Jobs = x.jobs
        worker, job, new = self.worker, jobs.active, False
        due = job is not None and t >= jobs.effect
        # Work can be unfinished here against the wall clock only: in lockstep `ready` has waited for it.
        # Without latency a result is due at the tick of its request, at which the work has only begun; that is no delay
        # to report.
        if job is not None and due and worker.state == "working" and t > job.stamp:
            self.report(Level.OK, UNFINISHED, "the work was not done when its result was due: answered without it")
        elif job is not None and due and worker.state != "working":
            jobs = replace(jobs, active=None)
            if worker.state == "failed":
                text = f"work on the request of t = {to_s(job.stamp):.9g} s failed: {worker.error}"
                # In lockstep a run without this result would be another run, so it ends; on the wall clock the rig
                # continues.
                if not self.realtime:
                    raise RunError(text)
                self.report(Level.ERROR, "work", text)
            else:
                if worker.struck:
                    text = f"{'best answer so far' if worker.has_best else 'no answer'} after {self.p.limit:g} s"
                    self.report(Level.WARN, "limit", f"{text}: this result does not repeat")
                jobs = replace(jobs, result=Result(job.stamp, job.request, worker.answer, not worker.struck))
                new = True
            x = self.carry_on(x._replace(jobs=jobs), t)
        return self.answer(x, t, jobs.result, new)

    def health(self, x: Any) -> Mapping[str, str]:
        """Describe how far the work is."""
        if x.jobs.active is None:
            return {"work": "idle"}
        figures = {name: f"{v:.9g}" if isinstance(v, float) else str(v) for name, v in self.worker.status.items()}
        stamp = to_s(x.jobs.active.stamp)
        return {"work": f"request of t = {stamp:.9g} s, {self.worker.elapsed():.1f} s", **figures}
