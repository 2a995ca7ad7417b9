"""Choose how a run is executed: natively, as one generated text in Python, or tick by tick; the run time decides."""

from __future__ import annotations

import importlib.util
import math
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from typing import Any

from ..block.gathering import MANY, gather
from ..block.loop import Loop
from ..block.step import Step
from ..kit.jit import switched_off
from ..native.compile import compiled, plain
from ..native.engine import Engine
from ..native.fitted import known

# Remaining s of Python: compiling takes seconds, so it pays off only beyond this.
MAKING = 6.0
# In s: the same where the native code is cached and only has to be loaded.
READY = 0.01
# In s: the same for generated Python source, which costs less to make but also saves less.
WRITING = 0.15
# Ticks timed together, and how often. The least counts, because other processes can only make a round slower.
ROUND, ROUNDS = 16, 4
SHORT = "Python is through before native code is made"

# The cost of a tick in Python, s, by the classes of the blocks: as measured on the first such rig.
_costs: dict[Any, float] = {}
# The time spent on runs of such rigs that were too short for a text, s: more such runs are likely to follow.
_spent: dict[Any, float] = {}


def ticks_of(
    steps: Sequence[Step], runs: int = 1, alone: Callable[[], bool] | None = None
) -> tuple[Iterator[int | None], Callable[[], object]]:
    """Yield an iterator that runs all ticks of a rig: natively or by one text if that pays, otherwise one by one.

    The choice depends on the time that Python would take (`cost`). Messages, reports and errors are the same.

    Parameters
    ----------
    steps : sequence of Step
        As for `Engine`.
    runs : int
        Number of such runs that will follow.
    alone : callable, optional
        See `Engine`.

    Returns
    -------
    ticks : iterator
        As `Loop.run`; a run without end is run tick by tick.
    report : callable
        Updates the steps with what was native so far.
    """
    loop = Loop(steps)
    if loop.plan.ticks is None:
        _report_reason(steps, "a run without an end")
        return loop.run(), bool
    ticks = loop.plan.ticks
    engines: list[Engine] = []

    def run() -> Iterator[int | None]:
        first, tick = 0, cost(steps)
        if tick is None:
            first, tick = yield from _timed(loop)
            # A run that is over by then has not shown what a tick costs.
            if first <= ticks:
                _costs[_classes(steps)] = tick
        left = (ticks + 1 - first) * tick
        reason = unwanted(steps, left, runs)
        if reason and not writes(steps, left):
            _spent[_classes(steps)] = _spent.get(_classes(steps), 0.0) + left
            for step in steps if alone is None else ():
                gather(step, MANY)
            yield from loop.run(first)
            return
        engines.append(Engine(steps, plain if reason else compiled, alone))
        _report_reason(steps, reason)
        yield from engines[0].run(first)
        # No member could be translated, so the time spent must never lead to another attempt.
        if not engines[0].native.members:
            _spent[_classes(steps)] = -math.inf

    def report() -> None:
        for engine in engines:
            engine.report_to_steps()

    _report_reason(steps, forbidden() or SHORT)
    return run(), report


def _report_reason(steps: Sequence[Step], reason: str) -> None:
    for step in steps:
        step.native = 0, reason


def _classes(steps: Sequence[Step]) -> Any:
    return tuple(type(s.block) for s in steps)


def cost(steps: Sequence[Step]) -> float | None:
    """Return the cost of a tick of a rig in Python, s; None if no such blocks have run here yet."""
    return _costs.get(_classes(steps))


def _timed(loop: Loop) -> Generator[int | None, None, tuple[int, float]]:
    """Run the first ticks one by one; return their number and the cost of one, s of this thread."""
    count, elapsed, spent = 0, [], 0.0
    began = time.thread_time()
    for t in loop.run():
        # The time of this thread, not of the clock, because the machine may do other work meanwhile.
        spent += time.thread_time() - began
        if t is not None:
            # The first round is a single tick, which creates much that later ones reuse; `took[1:]` leaves it out.
            if count % ROUND == 0:
                elapsed.append(spent)
                spent = 0.0
            count += 1
        yield t
        if count > ROUND * ROUNDS:
            break
        began = time.thread_time()
    return count, min(elapsed[1:], default=0.0) / ROUND


def writes(steps: Sequence[Step], left: float) -> bool:
    """Return whether generating one text of all members that run in Python pays for this run or for such runs so far.

    No if native code is `switched_off`.
    """
    enough = READY if known(steps, plain) else WRITING - _spent.get(_classes(steps), 0.0)
    return not switched_off() and left > enough


def forbidden() -> str:
    """Describe why there can be no native code; empty where there can."""
    return switched_off() or ("" if importlib.util.find_spec("numba") else "numba is not installed")


def unwanted(steps: Sequence[Step], left: float, runs: int = 1) -> str:
    """Describe why compiling, which takes seconds once, does not pay; empty if it does.

    Parameters
    ----------
    left : float
        Time that Python would need for the remaining ticks, s.
    runs : int
        Number of such runs that will follow.
    """
    if reason := forbidden():
        return reason
    enough = READY if known(steps, compiled) else MAKING
    return "" if left * runs > enough else SHORT
