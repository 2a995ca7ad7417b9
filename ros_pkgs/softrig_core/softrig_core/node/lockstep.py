"""Lockstep: a node answers tick k when everything stamped t_k has arrived, at any speed of the host.

Nothing here looks at a clock to decide a number; wall-clock time only ends a run that makes no progress.
"""

from __future__ import annotations

import time
from collections import deque
from typing import Any

from ..errors import RunError
from ..model.block import Block
from ..model.port import CLOCK
from ..model.solver import Solver
from ..rig.options import RunOptions
from ..wire.recording import Sink
from .adapter import CLOCK_LAYOUT, Adapter
from .arrivals import Arrivals
from .endpoint import Input, Output
from .first import repeat_first
from .health import percentiles
from .middleware import Direct, Middleware, Receive
from .pace import follow_clock, follow_ticks
from .solving import Solving, hear_busy
from .stalls import Stalls
from .start import CHECK, Handshake


class Lockstep(Adapter):
    """A block driven tick by tick; see `Adapter` for the parameters."""

    def __init__(self, middleware: Middleware, block: Block, options: RunOptions, sink: Sink | None = None) -> None:
        self.arrivals = Arrivals(self)
        self._stalls = Stalls(self, middleware)
        self.ready = False
        self.over = False  # the last tick is answered
        self._tick = 0
        self._durations: deque[int] = deque(maxlen=100_000)
        self._sent = self._first = 0
        self.clock_output = Output(CLOCK, CLOCK.topic, -1)
        super().__init__(middleware, block, options, sink)
        if self.links.owns_clock:
            self.clock_output.send, _ = middleware.sender(CLOCK.topic, CLOCK_LAYOUT, 0.0, self.clock_output.matched)
        if self.links.clock is not None:
            follow_clock(self.arrivals, self.links.clock)
        if self.links.hears_clock:
            middleware.subscribe(CLOCK.topic, CLOCK.msgtype, lambda data: None, lambda count: None)
        if self.links.guests:
            stamped = [o for o in self.outputs if o.port.stamped and not o.delayed]
            first = 0 if self.is_plant else 1
            repeat_first([*stamped, self.clock_output], lambda: self.state == "running" and self.ticks == first)
        follow_ticks(self.arrivals)
        self.arrivals.await_tick(0)
        readers = self.links.readers
        wanted = [(o, list(readers.get(o.name, []))) for o in self.outputs]
        if self.links.owns_clock:
            wanted.append((self.clock_output, self.links.clock_readers))
        if self.links.acknowledges:
            wanted.append((self.tick_output, self.links.tick_readers))
        awaited = [(p.item, p.sender) for p in [*self.arrivals.pairings, *self.arrivals.unpaced]]
        busy = hear_busy(middleware, max(1, len(self.links.solvers)), self._patient)  # an outside node may be one, too
        awaited += [(busy, name) for name in self.links.solvers]
        self.handshake = Handshake(self, awaited, wanted)
        self._starter = middleware.timer(CHECK, self._start)
        self._solving = Solving(middleware, block, self.step) if isinstance(block, Solver) else None

    # peers -----------------------------------------------------------------------------------------------------

    def receiver(self, item: Input) -> tuple[Receive, Direct | None]:
        """Give what takes the messages of an input."""
        return self.arrivals.input(item)

    def now(self) -> int:
        """Time of the tick under way."""
        return self.t

    def age(self, name: str) -> int | None:
        """Age of an input at the tick under way."""
        return self.arrivals.age(name)

    def on_matched(self, item: Input) -> None:
        """A second publisher on a paired topic makes the run ambiguous: it ends, naming both."""
        if item.publishers > 1 and self.state != "done" and any(p.item is item for p in self.arrivals.pairings):
            self._stalls.rivals = item
            self.state = "failed"  # from here on no message counts; `progress` ends the run when the names are known

    def _start(self) -> None:
        """Begin when every declared peer is matched, both ways."""
        if self.ready or self.state != "starting":
            return
        absent = self.handshake.absent()
        self.lacking = self.handshake.lacking
        if absent:
            return
        self._starter.cancel()
        self.ready = True
        self.state = "running"
        self._stalls.restart()
        if self.is_plant:
            try:
                self._send(0)
            except (ArithmeticError, RunError) as error:
                self.broke(error)
        if not self.arrivals.missing:
            self.step()

    # ticks -----------------------------------------------------------------------------------------------------

    def step(self) -> None:
        """Answer ticks as long as nothing is missing."""
        try:
            while not self.arrivals.missing and self.state == "running" and not self.over:
                if self.is_plant:
                    self._advance(self.t)
                elif self._solving is not None and not self._solving.finished(
                    self.t, None if self.bad else self.values
                ):
                    return
                else:
                    self._update(self.t)
        except (ArithmeticError, RunError) as error:
            self.broke(error)

    def _advance(self, t: int) -> None:
        """Move the plant over one period and publish where it is."""
        last = self.schedule.last
        if last is not None and t >= last:
            self.finish()
            return
        self.block.advance(t, **self.values)  # type: ignore[attr-defined]
        self.t = t = self._next()
        self.buttons.release()
        self.ticks += 1
        self.arrivals.await_tick(t)
        self._send(t)
        last = self.schedule.last
        if last is not None and t >= last:
            self.finish()

    def _send(self, t: int) -> None:
        """Publish the plant's outputs at `t` and the clock."""
        self.publish(t, t, self.block.outputs(t))  # type: ignore[attr-defined]
        if self.links.owns_clock:
            self.clock_output.send((t, ()))
            if self.sink is not None and self._add_row is None:
                self.sink.add(self.extra_numbers, t, CLOCK_LAYOUT.encode(t, ()))
        now = time.perf_counter_ns()
        if self._sent:
            self._durations.append(now - self._sent)
        else:
            self._first = now
        self._sent = now

    def _update(self, t: int) -> None:
        """Answer one tick of a block that is not a plant."""
        self.publish(t, t, self.answer(t))
        self.ticks += 1
        self.t = self._next()
        self.buttons.release()
        self.arrivals.await_tick(self.t)
        if self.schedule.last is not None and self.t > self.schedule.last:
            self.leave()

    def leave(self) -> None:
        """Finish when all who tell us of their ticks have begun: they may still wait for us to be there."""
        self.over = True
        if all(p.item.heard for p in self.arrivals.pairings if p.earlier):
            self.finish()

    def _next(self) -> int:
        self._tick += 1
        return self.schedule.time(self._tick)

    def answer(self, t: int) -> Any:
        """Give what a block that is not a plant sends; a solver has begun with this tick before."""
        return super().answer(t) if self._solving is None or self.bad else self._solving.block.end(t)

    def busy(self) -> bool:
        """Whether a solver is at work."""
        return self._solving is not None and self._solving.block.working

    def statistics(self) -> dict[str, Any]:
        """Wall-clock time of a plant's ticks: all in s, each in ms; once they are over, for sorting them takes time."""
        if self.state == "running":
            return {}
        return {"running_s": (self._sent - self._first) / 1e9} | percentiles("tick", self._durations)

    def progress(self) -> None:
        """End the run when a peer is gone, stalls or never came."""
        self._stalls.look()

    def _patient(self) -> None:
        """A solver is at work somewhere in the rig: the time without progress begins anew."""
        self.arrivals.heard += 1
