"""A rig's members answered by native code as far as it goes, and by Python where it gives a tick up."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..block.answer import Rows
from ..block.link import Link
from ..block.loop import Loop
from ..block.step import Step
from ..block.tables import Tables
from ..errors import RunError
from .audience import NEVER, Answers, Audience, answered, numbers_of, stamps_of
from .compile import compiled, plain
from .rig_text import RigText, rig_text
from .translate import follow
from .turns import WHEN, decides, holdings, speakers
from .twins import Way, applied, form, packed, packer, unpacked, unpacker
from .value import NotNative

SHORTEST, LONGEST = 1 << 10, 1 << 20  # ticks that are answered in one go
GO = 0.05  # s: so long a go may last; who wants to stop a run waits for it
SHORT_GO = 0.005  # s: the same where others are to be served in between
SELDOM = 16  # at least so many ticks are native for each that is given up, or the rest stays in Python
RARE = 8  # ticks of the others for each of a member that Python answers
PATIENCE = 64  # given up before that is judged
RUNS_A_TEXT = 20  # that ask in vain for each text beyond the first
LOOK = 64  # ticks in Python between two looks at whether native code may go on
LATEST = 256  # ticks up to which a state may become what it stays: None until something has come
TRIES = 3
KEPT = 8  # texts that are kept for rigs to come


@dataclass
class Native:
    """What native code does of a rig, for the record of a run.

    Attributes
    ----------
    members : tuple of str
        Those that it answers.
    reason : str
        Why it does not answer the others, or any.
    ticks, given_up, decided : int
        Of the clock: answered by native code, and left to Python in between: where it went no further, and where a
        member wants it so (`Deciding.decides`).
    """

    members: tuple[str, ...] = ()
    reason: str = ""
    ticks: int = 0
    given_up: int = 0
    decided: int = 0


@dataclass
class _Kept:
    kinds: tuple[Any, ...]
    text: RigText
    function: Callable[..., Any] = field(repr=False)
    go: int  # ticks that are answered in one go
    made: bool = False  # whether it is compiled, or about to be


_texts: list[_Kept] = []
_refused: dict[Any, str] = {}  # kinds that only go without those of their members that are seldom due, and why
_counts: dict[Any, tuple[int, int]] = {}  # of each kind: rigs that asked for another text, texts


class Engine:
    """Runs the steps of a rig.

    Parameters
    ----------
    steps : sequence of Step
        As for `Loop`; wired, none of them waits for anything.
    make : callable
        Makes the function of a text: `compiled` or `plain`.
    alone : callable, optional
        Whether nobody else has a part in the ticks to come: none of the steps waits for anything, and nobody hears each
        answer as it is given. Without it that is always so. With it, ticks go on in Python while a text is compiled,
        and what native code answers at a time is short.

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
        self._aside: dict[str, str] = {}  # members that are seldom due, so that Python may run their ticks, and why
        self._share()
        self._later = [_Later(s) for s in self.steps if self._deciding and s.link is not None]
        self._cut = False  # whether native code gave up the last tick that it began
        self._smooth = False  # whether all who watch take what is recorded at once
        self._time = self._plan.clock.time
        self._kept: _Kept | None = None
        self._newest: list[Any] = []  # what is made anew at times, and for which keys the constants are
        self._keys: list[Any] = []
        self._fits: list[Any] = []
        self._pack: list[Way] = []  # of each member, how its state goes to native code
        self._unpack: list[Way] = []  # and comes back; empty until something has
        self._n: Any  # tick under way, random numbers that are missing, tick with which the places begin
        self._when: Any
        self._told: Any
        self._arrays: tuple[Any, ...]  # what native code is handed after its state, as `RigText.arrays`

    def run(self, first: int = 0) -> Iterator[int | None]:
        """Answer all ticks of a run that has an end; then the steps know what of them was native.

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
            self.tell()
            self._arrays = ()  # large: who recorded them has them

    def tell(self) -> None:
        """Report to the steps which of them ran natively, and how far."""
        found = self.native
        ticks = {"were given up": found.given_up, "decided something": found.decided}
        left = [f"{count:,} of its ticks {what}" for what, count in ticks.items() if count]
        reason = found.reason or ", ".join(left)
        for s in self.steps if self._typed else ():
            why = "it watches what is recorded" if s in self._watchers else self._aside.get(s.name, reason)
            s.native = s.native[0], why

    def _run(self, k: int) -> Iterator[int | None]:
        assert self._plan.ticks is not None
        last = self._plan.ticks
        # from here on a plant that is due would be moved beyond the end, which Python does not do
        end = min((self._plan.newest(s.schedule, last) for s in self.steps if s.plant), default=last)
        failures = 0
        fits, fresh = False, True  # whether there is a text, and it is to be looked at again
        while k <= last:
            if k and not self._free():
                for t in self._not_free(k):
                    k += t is not None
                    yield t
                fresh = True
                continue
            if k and fresh:
                fits, fresh = self._fitted(), False
                failures += not fits
                if fits and self._compile_beside(k):
                    fresh = True
                    continue
            if k and not fits and (k > LATEST or failures > TRIES):
                break
            go = self._kept.go if self._kept else SHORTEST
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
                if self._kept and reached == until and until == k + go:
                    took = time.perf_counter() - started
                    if took < self._longest / 2:
                        self._kept.go = min(LONGEST, go * 2)
                    elif took > self._longest:
                        self._kept.go = max(SHORTEST, go // 2)
                k = reached
                yield self._time(k - 1) if k else 0
                if k == until and k < last:
                    continue
                if k < until and not self._cut:
                    self.native.decided += self._decided(k)
                elif k < until:
                    self.native.given_up += 1
                    if self._often():
                        self.native.reason = "many ticks are given up"
                        break
            fresh = fresh or (bool(k) and self._next_change(k) <= k)
            for t in self.loop.run(k):
                yield t
                if t is not None:
                    break
            k += 1
            fresh = fresh or self._others()
        if k <= last:
            yield from self.loop.run(k)

    def _free(self) -> bool:
        """Return whether native code may answer the next ticks."""
        if self._compiling is not None and self._compiling.is_alive():
            return False
        return self._alone is None or self._alone()

    def _not_free(self, k: int) -> Iterator[int | None]:
        """Answer ticks in Python until native code may go on."""
        compiling = self._compiling is not None and self._compiling.is_alive()
        outside = "somebody outside of this process, or a person, has a part in its ticks"
        self.native.reason = "its text is being compiled" if compiling else outside
        for number, t in enumerate(self.loop.run(k), 1):
            yield t
            if number % LOOK == 0 and t is not None and self._free():
                return

    def _compile_beside(self, k: int) -> bool:
        """Compile in a thread if messages must be served meanwhile; return whether compilation is under way."""
        kept = self._kept
        assert kept is not None
        if self._alone is None or kept.made or not self._typed:
            return False
        kept.made = True
        self._places(k, k)
        arguments = k, k, *self._handed(k)

        def compile_() -> None:
            with suppress(Exception):  # said when it is called
                kept.function(*arguments)

        self._compiling = threading.Thread(target=compile_, daemon=True)
        self._compiling.start()
        return True

    def _often(self) -> bool:
        return self.native.given_up > PATIENCE and self.native.ticks < SELDOM * self.native.given_up

    def _decided(self, k: int) -> bool:
        """Return whether a member wants a tick to be Python's."""
        t = self._time(k)
        return any(self._plan.due(s.schedule, k) and s.block.decides(s.x, t) for s in self._deciding)  # type: ignore[attr-defined]

    def _next_change(self, k: int) -> int:
        """Return the first tick, from k on, by whose time parameters are to change."""
        at = min(s.change_at for s in self.steps)
        if at == math.inf:
            return 1 << 62
        first = self._plan.clock.tick(int(at))
        return max(k, first if self._time(first) >= at else first + 1)

    def _next_stop(self, k: int) -> int:
        """Return the first tick, from k on, that is one of Python's."""
        left = [s for s in self.steps if s.bad or s.name in self._aside]  # bad: something refused between its ticks
        due = [self._plan.following(s.schedule, k) for s in left]
        return min(self._next_change(k), *due) if due else self._next_change(k)

    def _share(self) -> None:
        """Report which members are to be native."""
        self._core = [s for s in self.steps if s not in self._watchers and s.name not in self._aside]
        self._holdings, self._speakers = holdings(self._core), speakers(self._core)
        self._deciding = [s for s in self._core if decides(s)]
        self._core_alone = Loop(self._core)

    # the text -----------------------------------------------------------------------------------------------------

    def _fitted(self) -> bool:
        """Find or make the text for the blocks as they are now; whether there is one."""
        core = self._core
        self._fits = self._forms()
        roots = [s.block for s in core]
        recorded = [s for s in core if s.outputs and (s.link is not None or self._watched(s))]
        kinds = (
            *(
                (type(s.block), s.name, s.schedule.every, s.schedule.clock, s.schedule.ticks, *kind)
                for s, kind in zip(core, self._fits, strict=False)
            ),
            *self._fits[len(core) :],
            tuple(s.name for s in recorded),
            self._make,
        )
        try:
            if kinds in _refused:
                raise NotNative(_refused[kinds])
            kept = next((n for n in _texts if n.kinds == kinds and not n.text.program.differs(roots)), None)
            if kept is None:
                if not _worth_another(kinds):
                    self.native.reason = "what is varied chooses another text each time"
                    return False
                try:
                    text = rig_text(core, recorded, self._typed)
                except NotNative:
                    text = rig_text(core, recorded, self._typed, reports=False)
                kept = _Kept(kinds, text, self._make(text), SHORTEST)
                _texts.insert(0, kept)
                del _texts[KEPT:]
            self._kept = kept
            program = kept.text.program
            self._constants = program.constants(roots)
            tables: dict[str, Any] = dict(zip(program.arrays.values(), program.tables(roots), strict=True))
            tables |= {name: follow(path, roots).scratch() for path, name in program.scratches.items()}
            self._sources = {name: follow(path, roots) for path, name in program.draws.items()}
            tables |= {name: self._drawn(draws, self._guess()) for name, draws in self._sources.items()}
        except NotNative as reason:
            often = RARE * min(self._plan.every(s.schedule) for s in core)
            self._aside |= {s.name: str(reason) for s in core if self._plan.every(s.schedule) >= often}
            if any(s.name in self._aside for s in core):
                _refused[kinds] = str(reason)
                self._share()
                return self._fitted()
            self.native.reason = str(reason)
            return False
        self._pack, self._unpack = [packer(s.x, self._typed) for s in core], []  # as long as states have these forms
        self._tables = tables
        self._newest = [follow(path, roots) for path in program.newest]
        self._keys = [one.key for one in self._newest]
        self._recorded = recorded
        self._written = [(core.index(s), s, len(numbers_of(s)), len(stamps_of(s))) for s in recorded]
        self.native.members, self.native.reason = tuple(s.name for s in core), ""
        return True

    def _forms(self) -> list[Any]:
        """Return the types of what each member remembers and holds: a text is for these."""
        forms = [(tuple(map(form, s.values.values())), form(s.x)) for s in self._core]
        return [*forms, tuple(one.form for one in self._holdings)]

    def _others(self) -> bool:
        """Return whether states or constants have other types or are new objects: the code may then differ."""
        return self._forms() != self._fits or [one.key for one in self._newest] != self._keys

    def _drawn(self, draws: Any, count: int) -> Any:
        found = draws.first(count)
        return found if self._typed else found.tolist()

    def _guess(self) -> int:
        return min(1 << 20, 2 * (self._plan.ticks or 0) + (1 << 13))

    def _watched(self, step: Step) -> bool:
        return any(fill.source is step for w in self._watchers for fill in w.fed.values())

    # going --------------------------------------------------------------------------------------------------------

    def _go(self, first: int, last: int) -> int:
        """Answer ticks of the clock from `first` up to `last`, or as far as native code goes; return how far."""
        rows = self._places(first, last)
        reached, after = self._called(first, first, last, rows)
        if after is None:
            return first
        if self._smooth and self._decided(reached):
            return self._on(first, reached, last, after, rows)
        said = self._said_by(rows, first, reached)
        begun = self._watching.keep()
        spoken = [s.spoken for s in self._core]
        try:
            self._audience.watch(self._recorded, first, reached, said)
        except RunError:  # of one who watches: all again up to that tick, which Python answers
            reached = self._plan.clock.tick(max(w.t for w in self._watchers if w.name in self._audience.tick_by_tick))
            self._watching.go_back(begun)
            for s, before in zip(self._core, spoken, strict=True):
                s.spoken = before
            if reached > first:
                said = self._places(first, reached)
                _, after = self._called(first, first, reached, said)
                self._audience.watch(self._recorded, first, reached, said)
        if reached > first:
            self._take(first, reached, after)
            self._audience.hand_out(self._core, first, reached, said)
            one_clock = self._core_alone.plan.clock.clock == self._plan.clock.clock
            self._smooth = one_clock and not self._audience.tick_by_tick and self._alone is None
        return reached

    def _on(self, first: int, reached: int, last: int, after: Any, rows: dict[int, Answers]) -> int:
        """Continue where a node wants a tick in Python; everything is published at the end in one batch."""
        at = first

        def hand_out() -> None:
            whole = self._said_by(rows, first, reached)
            try:
                self._audience.watch(self._recorded, first, reached, whole)
            finally:
                self._audience.hand_out(self._core, first, reached, whole)

        while True:
            self._take(at, reached, after)
            if reached == last or not self._decided(reached):
                break
            for link in self._later:
                link.kept = []
            try:
                next(self._core_alone.run(reached))
            except RunError:
                hand_out()
                for link in self._later:
                    link.hand_on()
                raise
            finally:
                for link in self._later:
                    link.kept = None
            self.native.decided += 1
            for s in self._recorded:
                if self._plan.due(s.schedule, reached):
                    row = len(self._plan.own(s.schedule, first, reached))
                    rows[id(s)].put(row, numbers_of(s), stamps_of(s))
            reached = at = reached + 1
            if reached == last or self._others() or any(s.bad for s in self._core):
                break
            reached, after = self._called(first, at, last, rows)
            if after is None:
                break
        hand_out()
        return reached

    def _places(self, first: int, last: int) -> dict[int, Answers]:
        """Return buffers for native answers of the ticks `first` to `last`, and pass them to native code."""
        counts = {id(s): len(self._plan.own(s.schedule, first, last)) for s in self._recorded}
        rows = {
            id(s): Answers(np.empty((size, counts[id(s)])).T, np.empty((counts[id(s)], stamps), np.int64))
            if self._typed  # column after column in memory: so they are read
            else Answers([], [])
            for _, s, size, stamps in self._written
        }
        assert self._kept is not None
        reports = self._kept.text.program.reports
        sizes = 1 + len(self._holdings) + len(self._speakers), reports.size if reports else 0
        if self._typed:
            self._n, self._when, self._told = np.zeros(3, np.int64), np.zeros(sizes[0], np.int64), np.zeros(sizes[1])
        else:
            self._n, self._when, self._told = [0] * 3, [0] * sizes[0], [0.0] * sizes[1]
        self._name(rows)
        return rows

    def _name(self, rows: dict[int, Answers]) -> None:
        """Order the arguments of native code."""
        assert self._kept is not None
        named = self._tables | {WHEN: self._when, "told": self._told}
        for k, s, _, _ in self._written:
            named[f"o{k}"], named[f"p{k}"] = rows[id(s)]
        self._arrays = tuple(named[name] for name in self._kept.text.arrays)

    def _said_by(self, rows: dict[int, Answers], first: int, last: int) -> dict[int, Answers]:
        """Return the answers of ticks from `first`, where their places begin, up to `last`."""
        counts = {id(s): len(self._plan.own(s.schedule, first, last)) for s in self._recorded}
        return {key: Answers(*(table[: counts[key]] for table in answers)) for key, answers in rows.items()}

    def _handed(self, begin: int) -> tuple[Any, ...]:
        """Return what the function is handed after its ticks; the places of answers begin at a tick."""
        kept = self._kept
        assert kept is not None
        before = (
            *(applied(way, s.x) for way, s in zip(self._pack, self._core, strict=True)),
            *(numbers_of(s) for s in self._core),
            *(stamps_of(self._core[k]) for k in kept.text.stamped),
            *(packed(one.value) for one in self._holdings),
        )
        spoken = [self._core[k].spoken[j] for k, j in self._speakers]
        self._n[:] = 0, 0, begin
        self._when[:] = [0, *(one.stamp for one in self._holdings), *(NEVER if t is None else t for t in spoken)]
        self._told[:] = [0.0] * len(self._told)
        return self._n, self._constants, before, *self._arrays

    def _called(self, begin: int, first: int, last: int, rows: dict[int, Answers]) -> tuple[int, Any]:
        """Answer ticks from `first` up to `last`, or as far as native code goes, into places that begin at a tick.

        Returns
        -------
        reached : int
        after : tuple or None
            What is remembered then, and was said last; None: it went nowhere.
        """
        kept = self._kept
        assert kept is not None
        self._cut = False
        kept.made = True
        while True:
            handed = self._handed(begin)
            n = self._n
            try:
                after = kept.function(first, last, *handed)
            except NATIVE:
                if not self._typed:  # lists have grown
                    rows |= self._said_by(rows, begin, first)
                    self._name(rows)
                if n[1]:
                    for name, draws in self._sources.items():
                        self._tables[name] = self._drawn(draws, max(int(n[1]), 2 * len(self._tables[name])))
                    self._name(rows)
                    continue
                self._cut = True
                if n[0] <= first:
                    return first, None
                last = int(n[0])
                continue
            except Exception as error:
                if type(error).__module__.partition(".")[0] != "numba":
                    raise
                _texts[:] = [other for other in _texts if other is not kept]
                raise NotNative(f"numba: {' '.join(str(error).split())[:300]}") from None
            return int(n[0]), after

    def _take(self, first: int, last: int, after: Any) -> None:
        """Create what native code has found that of the steps."""
        self.native.ticks += last - first
        assert self._kept is not None
        if (reports := self._kept.text.program.reports) is not None and self._told[0]:
            reports.take_down(self._told, self._core)
        count = len(self._core)
        self._unpack = self._unpack or [unpacker(value) for value in after[:count]]
        stamps = dict(zip(self._kept.text.stamped, after[2 * count :], strict=False))
        spoken = dict(zip(self._speakers, map(int, self._when[1 + len(self._holdings) :]), strict=True))
        for k, s in enumerate(self._core):
            own = self._plan.own(s.schedule, first, last)
            if not own:
                continue
            s.x = applied(self._unpack[k], after[k])
            newest = {j: t for (speaker, j), t in spoken.items() if speaker == k} if spoken else {}
            answered(s, own[-1], after[count + k], stamps.get(k, ()), newest)
            if self._typed:
                s.native = s.native[0] + len(own), ""
            for one, value in zip(self._holdings, after[len(after) - len(self._holdings) :], strict=True):
                fill = one.fill
                if one.source == k and newest.get(fill.output, s.t) >= self._time(first):
                    fill.reader.values[fill.port.name] = unpacked(value)


class _Later(Link):
    """Keeps what is published in a tick of Python whose answers are handed out later, with those of native code."""

    kept: list[tuple[Any, ...]] | None = None

    def send(self, t: int, rows: Rows, numbers: tuple[float, ...]) -> None:
        """Send an answer, or keep it."""
        self._take(Link.send, t, rows, numbers)

    def over(self, t: int) -> None:
        """Apply it, or store it."""
        self._take(Link.over, t)

    def send_all(self, times: Any, numbers: Any, stamps: Any) -> None:
        """Send them."""
        assert self.inner is not None
        self.inner.send_all(times, numbers, stamps)

    def hand_on(self) -> None:
        """Apply what was stored."""
        for call, *arguments in self.kept or ():
            call(self, *arguments)

    def _take(self, call: Any, *arguments: Any) -> None:
        if self.kept is None:
            call(self, *arguments)
        else:
            self.kept.append((call, *arguments))


# what gives a tick up: Python answers it, and tells what is wrong with it, if anything is. A name that does not exist
# cannot come from a block's values (one that is unbound can): that is a defect of the text, which ends the run.
NATIVE = (RuntimeError, ArithmeticError, ValueError, LookupError, UnboundLocalError, TypeError)


def _worth_another(kinds: Any) -> bool:
    """Return whether one more text of a kind of rig is worth its making: the first, then one in some runs."""
    asked, made = _counts.get(kinds, (0, 0))
    worth = asked >= made * RUNS_A_TEXT
    _counts[kinds] = (asked + 1, made + worth)
    return worth


def known(kinds: Sequence[type], make: Callable[[RigText], Callable[..., Any]]) -> bool:
    """Return whether there is a text, made so, for members of such classes, those that only watch left out."""
    return any(tuple(kinds) == tuple(k[0] for k in kept.kinds[:-3]) for kept in _texts if kept.kinds[-1] is make)
