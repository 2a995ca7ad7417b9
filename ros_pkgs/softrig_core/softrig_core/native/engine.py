"""Run a rig's members natively as far as possible, and in Python at ticks that native code discards."""

from __future__ import annotations

import math
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from ..block.answer import Rows
from ..block.link import Link
from ..block.loop import Loop
from ..block.step import Step
from ..block.tables import Tables
from ..errors import RunError
from .audience import Audience, numbers_of, stamps_of
from .compile import compiled, plain
from .fitted import DEFECT, SHORTEST, Core, Fitted, kinds_of, refuse, text_for
from .rig_text import RigText
from .value import NotNative

LONGEST = 1 << 20  # ticks that are answered in one go, at most
ANSWERS = 1 << 24  # bytes of their answers, at most: a long run has to stay small in memory
STEEPEST = 16  # times as many ticks as in the call before, at most, since later ticks may take longer
GO = 0.05  # s: how long one call may last, since a run can be stopped only between two calls
SHORT_GO = 0.005  # s: the same where messages are to be served in between
WATCHES = "it watches what is recorded"  # why an observer is not native
# A discarded tick is expensive, since native code computes the earlier ticks of its call again. So many ticks must be
# native for each one, or the rest of the run stays in Python.
SELDOM = 16
# A member in Python takes its ticks from native code for all others, too, since a tick is run as a whole; that is worth
# it only for one that is due at every eighth tick of the others, or less often.
RARE = 8
PATIENCE = 64  # discarded ticks before that is judged
LOOK = 64  # ticks in Python between two looks at whether native code may go on
LATEST = 256  # ticks up to which a state may still change its type, as from None when a first message arrives
TRIES = 3  # failed translations after which a run without a text stays in Python


@dataclass
class Native:
    """The native part of a rig, for the record of a run.

    Attributes
    ----------
    members : tuple of str
        Members that run natively.
    reason : str
        Why the others, or all, do not.
    ticks, given_up, decided : int
        Numbers of ticks of the clock: run natively; discarded by native code and run in Python; left to Python because
        a member requires it (`Deciding.decides`).
    """

    members: tuple[str, ...] = ()
    reason: str = ""
    ticks: int = 0
    given_up: int = 0
    decided: int = 0


class Engine:
    """Runs the steps of a rig.

    Parameters
    ----------
    steps : sequence of Step
        As for `Loop`; they are wired, and none of them waits for anything.
    make : callable
        Creates the function of a text: `compiled` or `plain`.
    alone : callable, optional
        Returns whether no other process takes part in the next ticks: no step waits for anything, and no reader needs
        each message immediately. Without it this is assumed. With it, ticks continue in Python while a text is
        compiled, and native code runs only few ticks in one call.

    Attributes
    ----------
    native : Native
    """

    def __init__(
        self,
        steps: Sequence[Step],
        make: Callable[[RigText], Callable[..., Any]] = compiled,
        alone: Callable[[], bool] | None = None,
    ) -> None:
        self.steps, self._make, self._typed = tuple(steps), make, make is not plain
        self._alone, self._longest = alone, GO if alone is None else SHORT_GO
        self._compiling: threading.Thread | None = None
        self.loop = Loop(self.steps)
        self.native = Native()
        self._plan = self.loop.plan
        self._audience = Audience(self.steps, self._plan)
        self._watchers = self._audience.watchers
        self._watching = Tables(self._watchers)
        self._aside: dict[str, str] = {}  # members that are rarely due, so that Python may run their ticks, and why
        self._core = self._native_members()
        self._later = [_Later(s) for s in self.steps if self._core.deciding and s.link is not None]
        self._smooth = False  # whether all that watch take what is recorded in one batch
        self._time = self._plan.clock.time
        self._fit: Fitted | None = None
        self._forms: list[Any] = []  # forms of the members at the newest check of the text

    def run(self, first: int = 0) -> Iterator[int | None]:
        """Run all ticks of a run that has an end; then store in the steps which part of them was native.

        Parameters
        ----------
        first : int
            As for `Loop.run`.

        Yields
        ------
        int or None
            The time that has been reached, ns, now and then; None while the next tick lacks something.

        Raises
        ------
        RunError
            As `Loop.run`.
        """
        try:
            yield from self._run(first)
        finally:
            self.report_to_steps()
            if self._fit is not None:
                self._fit.drop()

    def report_to_steps(self) -> None:
        """Report to the steps which of them ran natively, and how far."""
        result = self.native
        ticks = {"were given up": result.given_up, "decided something": result.decided}
        left = [f"{count:,} of its ticks {text}" for text, count in ticks.items() if count]
        reason = result.reason or ", ".join(left)
        # A text that Python runs is not native.
        for s in self.steps if self._typed else ():
            why = WATCHES if s in self._watchers else self._aside.get(s.name, reason)
            s.native = s.native[0], why

    def _run(self, k: int) -> Iterator[int | None]:
        assert self._plan.ticks is not None
        last = self._plan.ticks
        # From here on a plant that is due would be moved beyond the end, so Python answers these ticks.
        end = min((self._plan.newest(s.schedule, last) for s in self.steps if s.plant), default=last)
        failures = 0
        # The first tick runs in Python, because it gives the states the types that they keep.
        yield from self._in_python(k)
        k += 1
        # Whether there is a text, and whether it is to be looked for again, because these types may have changed.
        fits, fresh = False, True
        while k <= last:
            if not self._free():
                for t in self._not_free(k):
                    k += t is not None
                    yield t
                fresh = True
                continue
            if fresh:
                fits = self._fit_text()
                failures += not fits
                if fresh := fits and self._compile_in_thread(k):
                    continue
            # A state may change its type in the first ticks, as None until a message has arrived; later it is assumed
            # to keep its type.
            if not fits and (k > LATEST or failures > TRIES):
                break
            fit = self._fit
            go = fit.kept.go if fit else SHORTEST
            decided = fits and k < last and self._decided(k)
            self.native.decided += decided
            until = min(end, k + go, self._next_stop(k)) if fits and not decided else 0
            if until > k:
                started = time.perf_counter()
                try:
                    reached = self._go(k, until)
                except NotNative as reason:
                    self.native = Native(reason=str(reason))
                    fits, failures = False, failures + 1
                    continue
                # Only a call of full length measures how many ticks fit into the time that a call may take.
                if fit and reached == until and until == k + go:
                    elapsed = time.perf_counter() - started
                    # So many times as many ticks still end in time. Few long calls write into fewer new memory pages
                    # than many that double.
                    growth = int(self._longest / max(elapsed, self._longest / STEEPEST))
                    if growth > 1:
                        fit.kept.go = min(max(SHORTEST, int(ANSWERS / (fit.size + 1.0))), LONGEST, go * growth)
                    elif elapsed > self._longest:
                        fit.kept.go = max(SHORTEST, go // 2)
                k = reached
                yield self._time(k - 1)
                if k == until and k < last:
                    continue
                if k < until and not (fit and fit.discarded):
                    self.native.decided += self._decided(k)
                elif k < until:
                    self.native.given_up += 1
                    if self._often():
                        self.native.reason = "many ticks are discarded"
                        break
            # Python applies the change in this tick, and with it constants and guards of the text may be others.
            fresh = self._next_change(k) <= k
            yield from self._in_python(k)
            k += 1
            if until and fit and fit.odd:
                # Python has answered the tick that failed in the text: the text is wrong, not the block
                self.native.reason = f"{fit.odd}: {DEFECT}"
                warnings.warn(self.native.reason, RuntimeWarning, stacklevel=2)
                break
            fresh = fresh or self._others()
        if k <= last:
            yield from self.loop.run(k)

    def _in_python(self, k: int) -> Iterator[int | None]:
        """Run one tick in Python."""
        for t in self.loop.run(k):
            yield t
            if t is not None:
                return

    def _is_compiling(self) -> bool:
        return self._compiling is not None and self._compiling.is_alive()

    def _free(self) -> bool:
        """Return whether native code may answer the next ticks."""
        return not self._is_compiling() and (self._alone is None or self._alone())

    def _not_free(self, k: int) -> Iterator[int | None]:
        """Run ticks in Python until native code may continue."""
        outside = "another process, or a person, takes part in its ticks"
        self.native.reason = "its text is being compiled" if self._is_compiling() else outside
        for number, t in enumerate(self.loop.run(k), 1):
            yield t
            if number % LOOK == 0 and t is not None and self._free():
                return

    def _compile_in_thread(self, k: int) -> bool:
        """Compile the text in a thread if messages must be served in the meantime; return whether that is in
        progress.
        """
        fit = self._fit
        if fit is None or self._alone is None or fit.kept.compiled or not self._typed:
            return False
        # Messages must be served while the text is compiled, which takes seconds.
        # A run that ends earlier must not wait for the compiler, so the thread does not keep the process alive.
        self._compiling = threading.Thread(target=fit.compilation(k), daemon=True)
        self._compiling.start()
        return True

    def _often(self) -> bool:
        return self.native.given_up > PATIENCE and self.native.ticks < SELDOM * self.native.given_up

    def _decided(self, k: int) -> bool:
        """Return whether a member requires a tick to run in Python."""
        t = self._time(k)
        return any(self._plan.due(s.schedule, k) and s.block.decides(s.x, t) for s in self._core.deciding)  # type: ignore[attr-defined]

    def _next_change(self, k: int) -> int:
        """Return the first tick, from k on, at whose time parameters must have changed."""
        t = min(s.change_at for s in self.steps)
        if t == math.inf:
            # Larger than the number of any tick, so that it never bounds a stretch.
            return 1 << 62
        first = self._plan.clock.tick(int(t))
        # `tick` rounds, so its result may lie before the time of the change.
        return max(k, first if self._time(first) >= t else first + 1)

    def _next_stop(self, k: int) -> int:
        """Return the first tick, from k on, that is one of Python's."""
        # A step is bad if a message was rejected between its ticks: only Python answers by `Block.refused`.
        left = [s for s in self.steps if s.bad or s.name in self._aside]
        due = [self._plan.following(s.schedule, k) for s in left]
        return min(self._next_change(k), *due) if due else self._next_change(k)

    def _native_members(self) -> Core:
        """Return the members that native code is to answer."""
        return Core([s for s in self.steps if s not in self._watchers and s.name not in self._aside])

    # the text -----------------------------------------------------------------------------------------------------

    def _fit_text(self) -> bool:
        """Find or make the text for the blocks as they are now; return whether there is one."""
        core, self._forms = self._core, self._core.forms()
        recorded = [s for s in core.steps if s.outputs and (s.link is not None or self._watched(s))]
        kinds = kinds_of(core, recorded, self._make)
        try:
            kept = text_for(kinds, core, recorded, self._make, self._typed)
            if kept is None:
                self.native.reason = "each change needs other native code"
                return False
            self._fit = Fitted(kept, core, recorded, self._plan, self._typed)
        except NotNative as reason:
            # Python can run the ticks of members that are rarely due, so the others are tried without them.
            often = RARE * min(self._plan.every(s.schedule) for s in core.steps)
            aside = {s.name: str(reason) for s in core.steps if self._plan.every(s.schedule) >= often}
            if aside:
                # Later rigs of this kind are spared the attempt, which costs a translation.
                refuse(kinds, str(reason))
                self._aside |= aside
                self._core = self._native_members()
                return self._fit_text()
            self.native.reason = str(reason)
            return False
        self.native.members, self.native.reason = tuple(s.name for s in core.steps), ""
        return True

    def _others(self) -> bool:
        """Return whether types of states or constants have changed, so that other code may be needed."""
        return self._core.forms() != self._forms or (self._fit is not None and self._fit.remade)

    def _watched(self, step: Step) -> bool:
        return any(fill.source is step for w in self._watchers for fill in w.fed.values())

    # going --------------------------------------------------------------------------------------------------------

    def _go(self, first: int, last: int) -> int:
        """Run ticks of the clock natively from `first` up to `last`, or as far as possible; return the tick reached."""
        fit = self._fit
        assert fit is not None
        fit.begin(first, last)
        reached, after = fit.call(first, last)
        if after is None:
            return first
        # Only a stretch that ended at such a tick continues without recording: the first one has shown that all that
        # watch accept a batch.
        if self._smooth and self._decided(reached):
            return self._on(first, reached, last, after)
        # An observer may fail at a tick that the nodes have long passed. No results are stored in their steps before
        # all observers have seen them, so it is enough to take the observers back.
        answers = fit.answers(reached)
        begun = self._watching.keep()
        # `watch` sets when the messages that it shows were published.
        published = [s.published_at for s in self._core.steps]
        try:
            self._audience.watch(fit.recorded, first, reached, answers)
        # An observer has failed: the ticks before that one are computed again, and Python answers the tick itself.
        except RunError:
            reached = self._plan.clock.tick(max(w.t for w in self._watchers if w.name in self._audience.tick_by_tick))
            self._watching.go_back(begun)
            for s, before in zip(self._core.steps, published, strict=True):
                s.published_at = before
            if reached > first:
                fit.begin(first, reached)
                _, after = fit.call(first, reached)
                answers = fit.answers(reached)
                self._audience.watch(fit.recorded, first, reached, answers)
        if reached > first:
            self._apply(fit, first, reached, after)
            self._audience.hand_out(self._core.steps, first, reached, answers)
            # `_on` answers ticks in Python by the loop of the native members alone, so their ticks must have the
            # numbers of the whole rig's. It publishes at the end of a stretch, so nobody may need a message before.
            one_clock = self._core.loop.plan.clock.clock == self._plan.clock.clock
            self._smooth = one_clock and not self._audience.tick_by_tick and self._alone is None
        return reached

    def _on(self, first: int, reached: int, last: int, after: Any) -> int:
        """Run the ticks that a node requires in Python, then continue natively; outputs are published in one batch at
        the end.
        """
        start, fit, core = first, self._fit, self._core
        assert fit is not None

        def hand_out() -> None:
            answered = fit.answers(reached)
            try:
                self._audience.watch(fit.recorded, first, reached, answered)
            finally:
                self._audience.hand_out(core.steps, first, reached, answered)

        # A search stops native code every few ticks. Recording after each of these stretches would cost more than the
        # stretch itself, so answers of the ticks in Python go into the same tables and all are published in one batch.
        while True:
            self._apply(fit, start, reached, after)
            if reached == last or not self._decided(reached):
                break
            # The answers of this tick go into the tables, so its messages are published by themselves only if the run
            # ends here.
            for link in self._later:
                link.kept = []
            try:
                next(core.loop.run(reached))
            except RunError:
                hand_out()
                for link in self._later:
                    link.hand_on()
                raise
            finally:
                for link in self._later:
                    link.kept = None
            self.native.decided += 1
            for s in fit.recorded:
                if self._plan.due(s.schedule, reached):
                    row = len(self._plan.own(s.schedule, first, reached))
                    fit.rows[id(s)].put(row, numbers_of(s), stamps_of(s))
            reached = start = reached + 1
            if reached == last or self._others() or any(s.bad for s in core.steps):
                break
            reached, after = fit.call(start, last)
            if after is None:
                break
        hand_out()
        return reached

    def _apply(self, fit: Fitted, first: int, last: int, after: Any) -> None:
        self.native.ticks += last - first
        fit.apply(first, last, after)


class _Later(Link):
    """Stores messages of a tick in Python that are published later, with those of native code."""

    kept: list[tuple[Any, ...]] | None = None

    def send(self, t: int, rows: Rows, numbers: tuple[float, ...]) -> None:
        """Send an answer, or keep it."""
        self._store(Link.send, t, rows, numbers)

    def over(self, t: int) -> None:
        """Apply the end of a tick, or store it."""
        self._store(Link.over, t)

    def send_all(self, times: Any, numbers: Any, stamps: Any) -> None:
        """Send them."""
        assert self.inner is not None
        self.inner.send_all(times, numbers, stamps)

    def hand_on(self) -> None:
        """Send all stored messages."""
        for call, *arguments in self.kept or ():
            call(self, *arguments)

    def _store(self, call: Any, *arguments: Any) -> None:
        if self.kept is None:
            call(self, *arguments)
        else:
            self.kept.append((call, *arguments))
