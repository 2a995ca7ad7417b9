"""A rig's members answered by native code as far as it goes, and by Python where it gives a tick up."""

from __future__ import annotations

import importlib.util
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from typing import Any

import numpy as np

from ..block.block import Observer
from ..block.runner import Runner
from ..block.step import Step
from ..errors import RunError
from .compile import compiled, plain
from .rig_text import RigText, rig_text
from .translate import follow
from .twins import packed, unpacked
from .value import NotNative

SHORTEST, LONGEST = 1 << 10, 1 << 20  # ticks that are answered in one go
GO = 0.05  # s: so long a go may last; who wants to stop a run waits for it
SELDOM = 16  # at least so many ticks are native for each that is given up, or the rest stays in Python
PATIENCE = 64  # given up before that is judged
WORTH = 4_000_000  # answers of members, which take Python some 2 us each: longer than native code is made
QUICK = 2_000  # the same where it is there already
WRITTEN = 20_000  # the same for a text that Python runs as it is: longer than it is written
RUNS_A_TEXT = 20  # that ask in vain for each text beyond the first
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
    ticks, given_up : int
        Of the clock: answered by native code, and left to Python in between.
    """

    members: tuple[str, ...] = ()
    reason: str = ""
    ticks: int = 0
    given_up: int = 0


@dataclass
class _Kept:
    kinds: tuple[Any, ...]
    text: RigText
    function: Callable[..., Any] = field(repr=False)


_texts: list[_Kept] = []
_counts: dict[Any, tuple[int, int]] = {}  # of each kind: rigs that asked for another text, texts


class Engine:
    """Runs the steps of a rig.

    Parameters
    ----------
    steps : sequence of Step
        As for `Runner`; wired, none of them waits for anything.
    make : callable
        Makes the function of a text: `compiled` or `plain`.

    Attributes
    ----------
    native : Native
    """

    def __init__(self, steps: Sequence[Step], make: Callable[[RigText], Callable[..., Any]] = compiled) -> None:
        self.steps, self._make, self._typed = tuple(steps), make, make is not plain
        self.runner = Runner(self.steps)
        self.native = Native()
        watchers = [s for s in self.steps if isinstance(s.block, Observer) and not s.readers and not s.doubters]
        self._watchers = watchers
        self._core = [s for s in self.steps if s not in watchers]
        stride = math.gcd(*(s.schedule.every for s in self.steps))
        self._every = {id(s): s.schedule.every // stride for s in self.steps}
        self._time = self.runner.schedule.time
        self._text: RigText | None = None

    def run(self) -> Iterator[int]:
        """Answer all ticks of a run that has an end; then the steps know what of them was native.

        Yields
        ------
        int
            The time that has been reached, ns, now and then.

        Raises
        ------
        RunError
            As `Runner.run`.
        """
        try:
            yield from self._run()
        finally:
            given_up = self.native.given_up
            reason = self.native.reason or (f"{given_up} of its ticks were given up" if given_up else "")
            for s in self.steps:
                s.native = s.native[0], "it watches what is recorded" if s in self._watchers else reason

    def _run(self) -> Iterator[int]:
        assert self.runner.ticks is not None
        last = self.runner.ticks
        k, go = 0, SHORTEST
        fresh = True  # whether the text is to be looked at again
        while k <= last:
            if k and fresh:
                fresh = False
                if not self._fitted():
                    break
            until = min(last, k + go, self._next_change(k)) if k else 0
            if until > k:
                started = time.perf_counter()
                try:
                    reached = self._go(k, until)
                except NotNative as reason:
                    self.native = Native(reason=str(reason))
                    break
                if reached == until and until == k + go:
                    took = time.perf_counter() - started
                    go = min(LONGEST, go * 2) if took < GO / 2 else max(SHORTEST, go // 2) if took > GO else go
                self.native.ticks += reached - k
                k = reached
                yield self._time(k - 1) if k else 0
                if k == until and k < last and k < self._next_change(k):
                    continue
                if k < until:
                    self.native.given_up += 1
                    if self._often():
                        self.native.reason = "many ticks are given up"
                        break
            fresh = fresh or (bool(k) and self._next_change(k) <= k)
            yield self._python(k)
            k += 1
        if k <= last:
            for t in self.runner.run(k):
                yield t or 0

    def _often(self) -> bool:
        return self.native.given_up > PATIENCE and self.native.ticks < SELDOM * self.native.given_up

    def _python(self, k: int) -> int:
        return next(self.runner.run(k)) or 0

    def _next_change(self, k: int) -> int:
        """Give the first tick, from k on, by whose time parameters are to change."""
        at = min(s.change_at for s in self.steps)
        if at == math.inf:
            return 1 << 62
        first = self.runner.schedule.tick(int(at))
        return max(k, first if self._time(first) >= at else first + 1)

    # the text -----------------------------------------------------------------------------------------------------

    def _fitted(self) -> bool:
        """Find or make the text for the blocks as they are now; whether there is one."""
        core = self._core
        roots = [s.block for s in core]
        recorded = [s for s in core if s.outputs and (s.send_all is not None or self._watched(s))]
        odd = next((s for s in core if not s.plain or s.doubters or s.lacks is not None), None)
        if odd is not None:
            self.native.reason = f"{odd.name}: its messages do not come at each tick, or are spoilt"
            return False
        kinds = (*((type(s.block), s.name, s.schedule.every, s.schedule.clock, s.schedule.ticks,
                    tuple(map(_form, s.values.values())), _form(s.x)) for s in core),
                 tuple(s.name for s in recorded), self._make)  # fmt: skip
        try:
            kept = next((n for n in _texts if n.kinds == kinds and not n.text.program.differs(roots)), None)
            if kept is None:
                if not _worth_another(kinds):
                    self.native.reason = "what is varied chooses another text each time"
                    return False
                text = rig_text(core, recorded, self._typed)
                kept = _Kept(kinds, text, self._make(text))
                _texts.insert(0, kept)
                del _texts[KEPT:]
            self._text, self._function = kept.text, kept.function
            program = kept.text.program
            self._constants = program.constants(roots)
            tables: dict[str, Any] = dict(zip(program.arrays.values(), program.tables(roots), strict=True))
            tables |= {name: follow(path, roots).scratch() for path, name in program.scratches.items()}
            self._sources = {name: follow(path, roots) for path, name in program.draws.items()}
            tables |= {name: self._drawn(draws, self._guess()) for name, draws in self._sources.items()}
        except NotNative as reason:
            self.native.reason = str(reason)
            return False
        self._tables = tables
        self._recorded = recorded
        self.native.members = tuple(s.name for s in core)
        return True

    def _drawn(self, draws: Any, count: int) -> Any:
        found = draws.first(count)
        return found if self._typed else found.tolist()

    def _guess(self) -> int:
        return min(1 << 20, 2 * (self.runner.ticks or 0) + (1 << 13))

    def _watched(self, step: Step) -> bool:
        return any(step in w.sources for w in self._watchers)

    # going --------------------------------------------------------------------------------------------------------

    def _go(self, first: int, last: int) -> int:
        """Answer ticks of the clock from `first` up to `last`, or as far as native code goes; give how far that is."""
        before = (*(packed(s.x) for s in self._core), *(tuple(map(float, s.numbers)) for s in self._core))
        reached, after, rows = self._called(first, last, before)
        if after is None:
            return first
        begun = [w.save() for w in self._watchers]
        try:
            self._watch(first, reached, rows)
        except RunError:  # of one who watches: all again up to that tick, which Python answers
            reached = self.runner.schedule.tick(max(w.t for w in self._watchers))
            for watcher, saved in zip(self._watchers, begun, strict=True):
                watcher.load(saved)
            if reached > first:
                _, after, rows = self._called(first, reached, before)
                self._watch(first, reached, rows)
        if reached > first:
            self._take(first, reached, after, rows)
        return reached

    def _called(self, first: int, last: int, before: Any) -> tuple[int, Any, dict[int, Any]]:
        assert self._text is not None
        while True:
            n: Any = np.zeros(2, np.int64) if self._typed else [0, 0]
            rows: dict[int, Any] = {id(s): [] for s in self._recorded}
            if self._typed:
                rows = {id(s): np.empty((len(self._own(s, first, last)), len(s.numbers))) for s in self._recorded}
            named = self._tables | {f"o{self._core.index(s)}": rows[id(s)] for s in self._recorded}
            handed = [named[name] for name in self._text.arrays]
            try:
                after = self._function(first, last, n, self._constants, before, *handed)
            except NATIVE:
                if n[1]:
                    for name, draws in self._sources.items():
                        self._tables[name] = self._drawn(draws, max(int(n[1]), 2 * len(self._tables[name])))
                    continue
                if n[0] <= first:
                    return first, None, {}
                last = int(n[0])
                continue
            except Exception as error:
                if type(error).__module__.partition(".")[0] != "numba":
                    raise
                _texts[:] = [kept for kept in _texts if kept.text is not self._text]
                raise NotNative(f"numba: {' '.join(str(error).split())[:300]}") from None
            return last, after, rows

    def _own(self, step: Step, first: int, last: int) -> range:
        """Give the ticks of a step among those of the clock from `first` up to `last`, by its own numbers."""
        every = self._every[id(step)]
        return range((first + every - 1) // every, (last + every - 1) // every)

    def _take(self, first: int, last: int, after: Any, rows: dict[int, Any]) -> None:
        """Make what native code has found that of the steps."""
        count = len(self._core)
        for k, s in enumerate(self._core):
            own = self._own(s, first, last)
            if not own:
                continue
            s.x, numbers = unpacked(after[k]), after[count + k]
            s.t = s.schedule.time(own[-1])
            s.native = s.native[0] + len(own), ""
            at = 0
            said = {}
            for p in s.outputs:
                said[p.name] = numbers[at : at + p.size]
                at += p.size
            if s.outputs:
                s.said, s.numbers = said, numbers
            for j, values, name, take in s.readers:
                row = said[s.outputs[j].name]
                values[name] = row if take is None else take(row)
            if s.send_all is not None:
                times = s.schedule.times(own.start, own.stop)
                s.send_all(times, np.asarray(rows[id(s)]) if s.outputs else np.empty((len(times), 0)))

    def _watch(self, first: int, last: int, rows: dict[int, Any]) -> None:
        """Let those who only watch see what was said, tick after tick."""
        if not self._watchers:
            return
        said = {id(s): rows[id(s)].tolist() if self._typed else rows[id(s)] for s in self._recorded}
        watchers = [(w, self._every[id(w)]) for w in self._watchers if not self._at_once(w, first, last, said)]
        told = []
        for s in self._recorded:
            readers = [read for w, _ in watchers for read in _readings(s, w)]
            if readers:
                told.append((s, self._every[id(s)], self._own(s, first, last).start, said[id(s)], readers))
        for k in range(first, last) if watchers else ():
            t = self._time(k)
            for s, every, begin, listed, readers in told:
                if k % every == 0:
                    row = listed[k // every - begin]
                    s.t = t
                    for values, name, take, low, high in readers:
                        part = tuple(row[low:high])
                        values[name] = part if take is None else take(part)
            for w, every in watchers:
                if k % every == 0:
                    w.say(t)

    def _at_once(self, watcher: Step, first: int, last: int, said: Mapping[int, Any]) -> bool:
        """Let one who watches have all that its ticks see, if it takes that so."""
        ticks, every = self._own(watcher, first, last), self._every[id(watcher)]
        if not ticks:
            return True
        messages: dict[str, list[tuple[int, Any]]] = {}
        for s in self._recorded:
            readings, own = _readings(s, watcher), self._own(s, first, last)
            if readings and max(every, self._every[id(s)]) % min(every, self._every[id(s)]):
                return False
            step = max(1, every // self._every[id(s)])  # of its messages, one is seen
            begin = -own.start % step
            stamps = s.schedule.times(own.start, own.stop)[begin::step].tolist() if readings else []
            for _, name, take, low, high in readings:
                parts = [tuple(row[low:high]) for row in said[id(s)][begin::step]]
                messages[name] = list(zip(stamps, parts if take is None else map(take, parts), strict=True))
        t = watcher.schedule.time(ticks[-1])
        x = watcher.block.at_once(watcher.x, t, messages)  # type: ignore[attr-defined]
        if x is None:
            return False
        watcher.x, watcher.t = x, t
        return True


def _readings(source: Step, reader: Step) -> list[tuple[dict[str, Any], str, Any, int, int]]:
    """Give what of a step's numbers another one reads: where to, by which name, how, from which one to which."""
    at = [0, *accumulate(p.size for p in source.outputs)]
    return [(values, name, take, at[j], at[j + 1]) for j, values, name, take in source.readers
            if values is reader.values]  # fmt: skip


NATIVE = (RuntimeError, ArithmeticError, ValueError, LookupError, TypeError)  # what gives a tick up


def _worth_another(kinds: Any) -> bool:
    """Whether one more text of a kind of rig is worth its making: the first, then one in some runs."""
    asked, made = _counts.get(kinds, (0, 0))
    worth = asked >= made * RUNS_A_TEXT
    _counts[kinds] = (asked + 1, made + worth)
    return worth


def writes(steps: Sequence[Step]) -> bool:
    """Whether a run is long enough for one text of all its members that Python runs; ``SOFTRIG_JIT=0`` forbids it."""
    return os.environ.get("SOFTRIG_JIT", "1") != "0" and _answers(steps) > WRITTEN


def _answers(steps: Sequence[Step]) -> int:
    answers = 0
    for step in steps:
        answers += (step.schedule.ticks or 0) // step.schedule.every
    return answers


def unwanted(steps: Sequence[Step], runs: int = 1) -> str:
    """Say why native code is not worth its making, which takes seconds, once; empty where it is.

    Parameters
    ----------
    steps : sequence of Step
    runs : int
        So many such runs are to come.
    """
    if os.environ.get("SOFTRIG_JIT", "1") == "0":
        return "SOFTRIG_JIT=0"
    if importlib.util.find_spec("numba") is None:
        return "numba is not installed"
    ticks = _answers(steps)
    kinds = tuple(type(s.block) for s in steps if not isinstance(s.block, Observer))
    known = any(kinds == tuple(k[0] for k in kept.kinds[:-2]) for kept in _texts if kept.kinds[-1] is compiled)
    least = QUICK if known else WORTH // max(1, runs)
    return "" if ticks > least else f"{ticks:,} answers a run, native code is worth its making from {least:,} on"


def _form(value: Any) -> Any:
    """Give the types of a state, to its leaves."""
    if isinstance(value, tuple):
        return type(value), tuple(map(_form, value))
    return type(value)
