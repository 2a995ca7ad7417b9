"""Native ticks in real time: a thread of native code waits for each tick, runs it and publishes, without Python's lock.

While nothing needs Python, it runs one tick after the other. Python's thread stores the answers in the recordings every
few ms. For a request, a new subscriber, a change of parameters or a pause it ends the native ticks at the next one.
"""

from __future__ import annotations

import importlib
import math
import threading
import time
from collections.abc import Callable, Sequence
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray
from softrig_core.block.answer import slots_of
from softrig_core.block.loop import Loop
from softrig_core.block.schedule import Plan
from softrig_core.block.step import Step
from softrig_core.errors import FAILURES, RunError
from softrig_core.native.audience import Answers, Audience
from softrig_core.native.compile import compiled
from softrig_core.native.fitted import CachedText, Core, Fitted, cached_text, kinds_of, text_for
from softrig_core.native.value import NotNative
from softrig_core.solver.solver import Solver
from softrig_core.timebase import SECOND

from ..below.punctual import make_punctual
from ..below.uses import works
from ..seam.endpoint import Output
from .realtime import CATCH_UP, Realtime

SHARE = 0.1  # share of a period: cost of a tick in Python from which on native ticks are worth their text
WARM, ROUND, ROUNDS = 17, 16, 4  # ticks of a copy of the rig before its cost is measured, ticks in a round, rounds
LAP = SECOND // 4  # ns: for so many ticks the tables have rows
ANSWERS = 1 << 24  # bytes of answers in them, at most
LONGEST = 2 * SECOND  # ns: then native ticks end once, if a block has reported something, so that it is logged
EVERY = SECOND // 200  # ns from one look whether something is in the way to the next
STORE = 4  # looks from one storing of answers to the next
SHORT, REST = SECOND // 100, SECOND // 20  # ns: after a shorter run of native ticks Python keeps the ticks for so long


class Native:
    """The native ticks of nodes that one timer triggers.

    Parameters
    ----------
    drives : sequence of Realtime
        See `Beat`.

    Attributes
    ----------
    active : bool
        Whether native code runs the ticks now.
    reached : int
        The first tick that it has not run.
    """

    def __init__(self, drives: Sequence[Realtime]) -> None:
        self._drives = drives
        self._steps = tuple(d.node.step for d in drives)
        self._plan = plan = Plan(s.schedule for s in self._steps)
        self._carrier = drives[0].node.middleware.carrier
        self._audience = Audience(self._steps, plan)
        # A plant moves at its next tick, which must not be a later one than that of native code.
        self._moving = math.lcm(*(plan.every(s.schedule) for s in self._steps if s.plant))
        self._again = math.lcm(*(plan.every(s.schedule) for s in self._steps))
        self._kept: CachedText | None = None
        self._function: Callable[..., Any] | None = None
        self.active, self.reached = False, 0
        self._rests = 0  # ns, monotonic: until then Python runs the ticks
        self._python = 0  # Python runs the ticks before this one
        self._fits: tuple[Any, Fitted] | None = None  # a text with its arguments, and what they depend on
        self._checks = 0

    def _reason(self, text: str) -> None:
        self._function = None
        for step in self._steps:
            step.native = step.native[0], text

    # before the start ---------------------------------------------------------------------------------------------

    def prepare(self) -> None:
        """Run ticks of a copy of the rig, and compile its text if native ticks are worth that."""
        nodes = [d.node for d in self._drives]
        if self._carrier is None or not works("ticking"):
            return
        if self._plan.ticks is None or self._plan.ticks < WARM + ROUND * ROUNDS:
            return
        if any(isinstance(n.block, Solver) or n.options.link or n.links.guests for n in nodes):
            return
        try:
            self._compile(self._copies())
        except NotNative as reason:
            self._reason(str(reason))
        except FAILURES:
            # An error of the copy occurs again in the run, which reports it.
            self._function = None

    def _copies(self) -> list[Step]:
        """Return steps like those of the nodes, connected to each other only."""
        result: dict[Step, Step] = {}
        for drive in self._drives:
            node, block = drive.node, drive.node.block
            copy = type(block)(block.p, node.middleware.name)
            copy.realtime = True
            copy.reset(node.options.seed)
            result[node.step] = Step(node.middleware.name, copy, node.schedule, node.step.inputs, node.step.outputs)
        for step in self._steps:
            for fill in step.readers:
                name = step.outputs[fill.output].name
                result[step].hands_to(name, result[fill.reader], fill.port.name, fill.pick)
        return [*result.values()]

    def _compile(self, steps: list[Step]) -> None:
        """Measure the copy's ticks in Python; if they are dear, make its native code, or find it in the cache."""
        ticks, spent = Loop(steps).run(), []
        for count in (WARM, *[ROUND] * ROUNDS):
            begun = time.thread_time_ns()
            for _ in islice(ticks, count):
                pass
            spent.append((time.thread_time_ns() - begun) / count)
        if min(spent) < SHARE * self._plan.clock.time(1):
            return
        core, recorded = _core(steps, self._plan)
        # A member that leaves some ticks to Python would end native ticks again and again.
        kept = None if core.deciding else text_for(kinds_of(core, recorded, compiled), core, recorded, compiled, True)
        if kept is None:
            return
        fit = Fitted(kept, core, recorded, self._plan, True)
        self._ticking = importlib.import_module("softrig_nodes.below._ticking")  # late import: it needs numba
        function = self._ticking.made(kept.function)
        fit.begin(0, 1)
        live = np.zeros(6, np.int64)
        try:
            slots = np.zeros((1, 3), np.int64), (0,) * 4
            function(0, 0, live, *self._arguments(fit, slots, [], np.zeros((1, 2), np.int64)))
        except Exception as error:
            # numba compiles at the first call, so unsupported constructs raise here.
            if type(error).__module__.partition(".")[0] != "numba":
                raise
            raise NotNative(f"numba: {' '.join(str(error).split())[:300]}") from None
        finally:
            fit.drop()
        kept.compiled, self._kept, self._function = True, kept, function
        self._core, self._recorded = _core(self._steps, self._plan)
        # Drawing random numbers in advance takes longer than many ticks. The width of an answer is known from the copy.
        for step, copy in zip(self._steps, steps, strict=True):
            step.numbers = copy.numbers
        self._fitted(kept)
        for step in self._steps:
            step.numbers = ()

    # native ticks -------------------------------------------------------------------------------------------------

    def _fitted(self, kept: CachedText) -> Fitted:
        """Return the arguments of the text for the nodes as they are now."""
        blocks = [s.block for s in self._core.steps]
        key = [self._core.forms(), [b.p for b in blocks]]
        if self._fits is None or self._fits[0] != key or self._fits[1].remade:
            self._fits = key, Fitted(kept, self._core, self._recorded, self._plan, True)
        return self._fits[1]

    def begins(self, k: int) -> bool:
        """Run the ticks from k on natively, if nothing is in the way; return whether it does."""
        if self._function is None or k % self._moving or k < self._python or time.monotonic_ns() < self._rests:
            return False
        # Python applies a change of parameters at its tick.
        if any(s.change_at <= self._plan.clock.time(k) for s in self._steps):
            return False
        if not self._free(k) or not self._begin(k):
            self._rests = time.monotonic_ns() + REST
            return False
        return True

    def _free(self, k: int) -> bool:
        """Return whether no node needs Python at tick k: inputs are those of the rig, outputs are plain numbers."""
        first, t = self._drives[0].node, self._plan.clock.time(k)
        for drive in self._drives:
            node = drive.node
            if node.state != "running" or node.hold.held or node.step.bad or node.buttons.pressed:
                return False
            if node.epoch != first.epoch or node.step.change_at <= t:
                return False
            if drive.disturbed() or not node.outgoing.by_memory():
                return False
        return True

    def _begin(self, k: int) -> bool:
        """Start the thread at tick k."""
        for drive in self._drives:
            drive.move_on()
        core, recorded = self._core, self._recorded
        kept = cached_text(kinds_of(core, recorded, compiled), core)
        if kept is None or kept is not self._kept:
            self._reason("after a change its text would have to be compiled")
            return False
        last = self._last(k)
        if last <= k:
            return False
        for step in self._steps:
            # What an observer has collected so far comes before what native code publishes.
            if step.link is not None:
                step.link.settle()
        self._fit = self._fitted(kept)
        size = sum(8 * (sum(p.size for p in s.outputs) + 3) / self._plan.every(s.schedule) for s in core.steps)
        lap = max(1, min(LAP, int(ANSWERS / size) * self._plan.clock.time(1)) // self._plan.clock.time(self._again))
        self._lap = lap * self._again
        self._fit.begin(k, k + self._lap)
        self._spans = np.empty((self._lap, 2), np.int64)
        # A first write to a page waits for other threads that change the memory of the process.
        for table in (self._spans, *(table for tables in self._fit.rows.values() for table in tables)):
            table.fill(0)
        self._published = self._read()
        self._first = self._stored = self.reached = k
        self._live = np.array([0, k, k, 0, 0, 0], np.int64)
        longest = max([o.layout.length for o in self._published], default=0)
        *ring, self._live[4], self._live[5] = self._carrier.lend(-(-longest // 8) * 8)
        handed = self._arguments(self._fit, ring, self._published, self._spans)
        self._after, self._error = None, list[Exception]()
        self.active = True
        self._thread = threading.Thread(target=self._run, args=(k, last, handed), daemon=True)
        self._thread.start()
        return True

    def _last(self, k: int) -> int:
        """Return the tick up to which native code may run: Python answers changes of parameters and the last ticks."""
        plan = self._plan
        assert plan.ticks is not None
        result = min([plan.newest(s.schedule, plan.ticks) for s in self._steps if s.plant], default=plan.ticks)
        at = min(s.change_at for s in self._steps)
        return min(result, plan.clock.tick(int(at)) - 1) if at < plan.clock.time(result) else result

    def _arguments(
        self, fit: Fitted, ring: Sequence[Any], outputs: Sequence[Output], spans: NDArray[np.int64]
    ) -> tuple[Any, ...]:
        """Return the arguments of `ticking` after its first three."""
        first, ns = self._drives[0], self._plan.clock.period * SECOND
        epoch = first.node.epoch
        # The clock of the rig may be paused or set, but not while native code runs.
        start = epoch - first.clock() + time.monotonic_ns()
        grid = start, ns.numerator, ns.denominator, CATCH_UP, len(spans), epoch
        n, constants, before, *arrays = fit.handed()
        kept = fit.when, fit.reported, fit.when.copy(), fit.reported.copy()
        times, tables = np.zeros(2, np.int64), self._tables(fit, outputs)
        return grid, times, self._carrier.calls, *ring, *tables, spans, kept, (n, constants, before), tuple(arrays)

    def _tables(self, fit: Fitted, outputs: Sequence[Output]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return where the messages of the outputs are, where their numbers come from, and where they belong."""
        publishers: list[tuple[int, ...]] = []
        numbers: list[tuple[int, ...]] = []
        self._templates: list[Any] = []  # native code has their addresses
        for drive in self._drives:
            node = drive.node
            columns = slots_of(node.step.outputs)
            for output in node.outgoing.outputs:
                if output not in outputs:
                    continue
                layout, table, low = output.layout, fit.rows[id(node.step)].numbers, columns[output.number][0]
                template = np.frombuffer(layout.encode(0, (0.0,) * layout.size), np.uint8).copy()
                self._templates.append(template)
                begin, column = len(numbers), low
                for offset, code in layout.slots:
                    for i in range(int(code[:-1])):
                        address = table.ctypes.data + column * table.strides[1]
                        numbers.append((address, table.strides[0], offset + 8 * i))
                        column += 1
                stamp = -1 if layout.stamp_offset is None else layout.stamp_offset
                handle, every = self._carrier.handles[output.topic], self._plan.every(node.schedule)
                message = template.ctypes.data, len(template)
                publishers.append((handle, *message, stamp, every, begin, len(numbers)))
        return np.array(publishers, np.int64).reshape(-1, 7), np.array(numbers, np.int64).reshape(-1, 3)

    def _run(self, k: int, last: int, handed: tuple[Any, ...]) -> None:
        """Run the native ticks, in their own thread."""
        make_punctual()
        assert self._function is not None
        try:
            self._after = self._function(k, last, self._live, *handed)
        except Exception as error:
            self._error.append(error)

    def check(self) -> bool:
        """Store new answers now and then; return whether the native ticks go on: nothing is in the way of them."""
        self._checks += 1
        over = self._plan.clock.time(self.reached - self._first) > LONGEST and self._fit.reported[:1].any()
        if over or not self._thread.is_alive() or not self._free(self.reached) or self._published != self._read():
            self.end()
            return False
        if self._checks % STORE == 0:
            self._carrier.check()
            self._store()
        return True

    def _read(self) -> list[Output]:
        """Return the outputs that have subscribers in other processes."""
        return [o for d in self._drives for o in d.node.outgoing.outputs if o.readers]

    def end(self) -> None:
        """End the native ticks, and store the states of the nodes after them."""
        ticking = self._ticking
        self._live[ticking.STOP] = 1
        self._thread.join()
        self.active = False
        self._carrier.resume(int(self._live[ticking.NEXT]), int(self._live[ticking.ROOM]))
        if self._error:
            raise self._error[0]
        self._store()
        why, k = self._live[ticking.WHY], self.reached
        if k > self._first:
            self._fit.apply(self._first, k, self._after)
        # A tick that native code cannot run is Python's, and so are skipped ones; if there are many, all ticks are.
        if why == ticking.BEHIND or (why == ticking.DISCARDED and not self._fit.follow_draws()):
            self._python = k + 1
            if self._plan.clock.time(k - self._first) < SHORT:
                self._rests = time.monotonic_ns() + REST

    def _store(self) -> None:
        """Record the answers since the last call, show them to observers, and count the ticks."""
        ticking = self._ticking
        reached, lap = int(self._live[ticking.REACHED]), self._lap
        while self._stored < reached:
            first = self._stored
            begin = self._first + (first - self._first) // lap * lap
            last = min(reached, begin + lap)
            answers = {}
            for s in self._fit.recorded:
                ticks = self._plan.own(s.schedule, first, last)
                row = ticks.start - self._plan.own(s.schedule, begin, begin).start
                tables = self._fit.rows[id(s)]
                answers[id(s)] = Answers(*(np.array(table[row : row + len(ticks)]) for table in tables))
            spans = self._spans[first - begin : last - begin].copy()
            try:
                self._audience.watch(self._fit.recorded, first, last, answers)
            except RunError as error:
                next(d.node for d in self._drives if d.node.step.name == error.node).broke(error)
            self._audience.hand_out(self._core.steps, first, last, answers)
            for drive in self._drives:
                every = self._plan.every(drive.node.schedule)
                drive.count_native(self._plan.own(drive.node.schedule, first, last), spans[-first % every :: every])
            self._stored = self._live[ticking.TAKEN] = last
        self.reached = reached


def _core(steps: Sequence[Step], plan: Plan) -> tuple[Core, list[Step]]:
    """Return the members that native code answers, and those of them that publish."""
    watchers = Audience(steps, plan).watchers
    core = Core([s for s in steps if s not in watchers])
    return core, [s for s in core.steps if s.outputs]
