"""A text that fits the present blocks of a rig: found or made, called, and its results stored."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..block.block import Observer
from ..block.loop import Loop
from ..block.params import FromFiles
from ..block.schedule import Plan
from ..block.step import Step
from ..errors import RunError
from ..kit.draws import MOST, SIZE, Window
from ..timebase import SECOND
from ..wire.columns import spacious
from .audience import NEVER, Answers, answered, numbers_of, stamps_of
from .rig_text import RigText, rig_text
from .translate import follow
from .turns import WHEN, decides, fits_64_bits, holdings, speakers, wiring
from .twins import Way, applied, form, packed, packer, unpacked, unpacker
from .value import NotNative

SHORTEST = 1 << 10  # ticks that are answered in one call, at least
# A varied value that is a guard needs a text for each of its values, which costs a translation and a compilation. After
# the first text of a kind, another one is made only once in so many requests.
RUNS_A_TEXT = 20
KEPT = 8  # texts that are kept for rigs to come
# Errors that discard a tick: Python answers it, and reports the error, if there is one. A block's values cannot cause a
# NameError (except for a local variable without a value): that is a defect of the text and ends the run.
NATIVE = (RuntimeError, ArithmeticError, ValueError, LookupError, UnboundLocalError, TypeError)
DEFECT = "a defect of softrig's native code, please report it with the scenario"

Make = Callable[[RigText], Callable[..., Any]]


@dataclass
class CachedText:
    """A text for rigs of a kind, and its function.

    Attributes
    ----------
    kinds : tuple
        See `kinds_of`.
    go : int
        Ticks that are answered in one call.
    compiled : bool
        Whether it is compiled, or about to be.
    """

    kinds: tuple[Any, ...]
    text: RigText
    function: Callable[..., Any] = field(repr=False)
    go: int
    compiled: bool = False


_texts: list[CachedText] = []
_refused: dict[Any, str] = {}  # kinds that are native only without their rarely due members, and why
_counts: dict[Any, tuple[int, int]] = {}  # for each kind: number of rigs that needed another text, number of texts


class Core:
    """The members that native code answers, in their order.

    Attributes
    ----------
    holdings : list of Holding
    speakers : list of (int, int)
        See `softrig_core.native.turns`.
    deciding : list of Step
        Those that leave some ticks to Python.
    loop : Loop
        Of these members alone.
    """

    def __init__(self, steps: Sequence[Step]) -> None:
        self.steps = tuple(steps)
        self.holdings, self.speakers = holdings(self.steps), speakers(self.steps)
        self.deciding = [s for s in self.steps if decides(s)]
        self.loop = Loop(self.steps)

    def forms(self) -> list[Any]:
        """Return the types of each node's state and held inputs: a text is valid for these."""
        forms = [(tuple(map(form, s.values.values())), form(s.x)) for s in self.steps]
        return [*forms, tuple(holding.form for holding in self.holdings)]


def kinds_of(core: Core, recorded: Sequence[Step], make: Make) -> tuple[Any, ...]:
    """Return the key of a text: classes, how it is made, names, schedules, forms, wiring, and which outputs are
    recorded.
    """
    return (
        tuple(type(s.block) for s in core.steps),
        make,
        tuple((s.name, s.schedule.every, s.schedule.clock) for s in core.steps),
        fits_64_bits(core.steps),
        tuple(core.forms()),
        wiring(core.steps),
        tuple(s.name for s in recorded),
    )


def text_for(
    kinds: tuple[Any, ...], core: Core, recorded: Sequence[Step], make: Make, typed: bool
) -> CachedText | None:
    """Find or make the text for the blocks as they are now; None: it is not worth making another one of this kind.

    Raises
    ------
    NotNative
        Part of the blocks is not supported by native code.
    """
    if kinds in _refused:
        raise NotNative(_refused[kinds])
    result = cached_text(kinds, core)
    if result is None and _worth_another(kinds):
        try:
            text = rig_text(core.steps, recorded, typed)
        except NotNative:
            # Without reports in the text a tick in which something is reported is discarded, which is better than no
            # text.
            text = rig_text(core.steps, recorded, typed, reports=False)
        result = CachedText(kinds, text, make(text), SHORTEST)
        # The newest text is found first, and the oldest one is dropped.
        _texts.insert(0, result)
        del _texts[KEPT:]
    return result


def cached_text(kinds: tuple[Any, ...], core: Core) -> CachedText | None:
    """Return a text that was made for such blocks with such constants; None if there is none."""
    roots = [s.block for s in core.steps]
    return next((n for n in _texts if n.kinds == kinds and not n.text.program.differs(roots)), None)


def refuse(kinds: tuple[Any, ...], reason: str) -> None:
    """Store the reason why a kind has no text, for later rigs."""
    _refused[kinds] = reason


def _worth_another(kinds: Any) -> bool:
    """Return whether one more text for a kind of rig pays: the first does, later ones only after some runs."""
    asked, texts = _counts.get(kinds, (0, 0))
    worth = asked >= texts * RUNS_A_TEXT
    _counts[kinds] = (asked + 1, texts + worth)
    return worth


def known(steps: Sequence[Step], make: Make) -> bool:
    """Return whether a text exists for nodes of these classes, not counting observers."""
    # The engine has no text for observers, which get batches of messages.
    classes = tuple(type(s.block) for s in steps if not isinstance(s.block, Observer))
    return any(kept.kinds[:2] == (classes, make) for kept in _texts)


def _with_line(error: Exception) -> str:
    """Return an error of a text with the line of the text."""
    frames = traceback.extract_tb(error.__traceback__)
    return f"{type(error).__name__}: {error} (`{frames[-1].line}`)"


class Fitted:
    """A text with all arguments of its function, for the current blocks.

    Parameters
    ----------
    kept : Kept
    core : Core
    recorded : sequence of Step
        Members whose answers are written into tables, because they are recorded or watched.
    plan : Plan
        Plan of the whole rig.
    typed : bool
        See `rig_text`.

    Attributes
    ----------
    discarded : bool
        Whether the last call has discarded a tick.
    odd : str
        The TypeError that caused it; empty if a discarded tick had another cause.
    when, reported : arrays
        Tables that native code changes: see `WHEN` and `Reports`.
    rows : dict of int to Answers
        Buffers for the answers of each recorded step, by its identity.

    Raises
    ------
    NotNative
        Part of the blocks' tables is not supported by native code.
    """

    def __init__(self, kept: CachedText, core: Core, recorded: Sequence[Step], plan: Plan, typed: bool) -> None:
        self.kept, self.recorded, self.discarded, self.odd = kept, recorded, False, ""
        self._core, self._steps, self._plan, self._typed = core, core.steps, plan, typed
        program, roots = kept.text.program, [s.block for s in core.steps]
        self._constants = program.constants(roots)
        tables: dict[str, Any] = dict(zip(program.arrays.values(), program.tables(roots), strict=True))
        tables |= {name: follow(path, roots).scratch() for path, name in program.scratches.items()}
        self._sources = {name: follow(path, roots) for path, name in program.draws.items()}
        self._tables = tables
        for draws in self._sources.values():
            # Numbers that another text has drawn for the same block serve this one, too.
            draws.at_hand = draws.at_hand or Window(draws, min(MOST, 2 * ((self._plan.ticks or 0) + SIZE)))
        self._put_draws()
        # These are valid as long as states have these forms; the conversion back is known with the first returned
        # states.
        self._pack = [packer(s.x, typed) for s in core.steps]
        self._unpack: list[Way] = []
        self._newest = [follow(path, roots) for path in program.newest]
        self._keys = [newest.key for newest in self._newest]
        self._written = [(core.steps.index(s), s, len(numbers_of(s)), len(stamps_of(s))) for s in recorded]
        self._n = self._zeros(3, int)  # tick under way, random numbers that are missing, tick with which places begin
        self.when = self._zeros(1 + len(core.holdings) + len(core.speakers), int)
        self.reported = self._zeros(program.reports.size if program.reports else 0, float)
        self._arrays: tuple[Any, ...] = ()  # arguments of the function after its state, as `RigText.arrays`
        self._begin, self.rows = 0, dict[int, Answers]()

    @property
    def remade(self) -> bool:
        """Return whether a block has created constants again, so that another text may be needed."""
        return [newest.key for newest in self._newest] != self._keys

    @property
    def size(self) -> float:
        """Return the average size in bytes of the answers of one clock tick."""
        return sum(8.0 * (size + stamps) / self._plan.every(s.schedule) for _, s, size, stamps in self._written)

    def under_way(self) -> str:
        """Describe the tick that a call has reached: for another thread, while it does not return (`run.stuck`)."""
        loaded = [s.name for s in self._steps if isinstance(s.block, FromFiles)]  # code that nobody here has read
        names = ", ".join(loaded or [s.name for s in self._steps])
        return f"the tick at t = {self._plan.clock.time(int(self._n[0])) / SECOND:.9g} s of {names} (compiled)"

    def drop(self) -> None:
        """Release the arrays of answers and of random numbers, which are large; the recording has its own copy."""
        self._arrays, self.rows = (), {}
        for draws in self._sources.values():
            draws.at_hand = None

    def _put_draws(self) -> None:
        """Put the random numbers at hand among the tables; Python, which answers the last tick, reads them, too."""
        tables = {name: draws.at_hand.table for name, draws in self._sources.items()}
        self._tables |= tables if self._typed else {name: table.tolist() for name, table in tables.items()}

    def _zeros(self, count: int, kind: type) -> Any:
        return np.zeros(count, kind) if self._typed else [kind()] * count

    def begin(self, first: int, last: int) -> None:
        """Create buffers for the native answers of the ticks from `first` up to `last`."""
        self._begin = first
        # The earlier tables are dropped first, so that the new ones of a long run can have the same memory.
        self._arrays, self.rows = (), {}
        tables = list(self._tables_of(last))
        if self._typed:
            numbers = spacious([(count, size) for _, count, size, _ in tables])
            self.rows = {
                key: Answers(rows, np.empty((count, stamps), np.int64))
                for rows, (key, count, _, stamps) in zip(numbers, tables, strict=True)
            }
        else:
            self.rows = {key: Answers([], []) for key, *_ in tables}
        self._name()

    def _tables_of(self, last: int) -> Iterator[tuple[int, int, int, int]]:
        """Yield of each recorded step: its identity, and how many ticks, numbers and stamps its tables have."""
        for _, s, numbers, stamps in self._written:
            yield id(s), len(self._plan.own(s.schedule, self._begin, last)), numbers, stamps

    def _name(self) -> None:
        """Name the arguments of native code in their order."""
        named = self._tables | {WHEN: self.when, "reports": self.reported}
        for k, s, _, _ in self._written:
            named[f"o{k}"], named[f"p{k}"] = self.rows[id(s)]
        self._arrays = tuple(named[name] for name in self.kept.text.arrays)

    def answers(self, last: int) -> dict[int, Answers]:
        """Return the answers up to the tick `last`, as arrays."""
        result = {}
        for key, count, *sizes in self._tables_of(last):
            tables = zip(self.rows[key], sizes, (np.float64, np.int64), strict=True)
            result[key] = Answers(*(np.asarray(table[:count], kind).reshape(count, n) for table, n, kind in tables))
        return result

    def handed(self) -> tuple[Any, ...]:
        """Return the arguments of the function as they are after its ticks."""
        kept = self.kept
        before = (
            *(applied(way, s.x) for way, s in zip(self._pack, self._steps, strict=True)),
            *(numbers_of(s) for s in self._steps),
            *(stamps_of(self._steps[k]) for k in kept.text.stamped),
            *(packed(holding.value) for holding in self._core.holdings),
        )
        published = [self._steps[k].published_at[j] for k, j in self._core.speakers]
        self._n[:] = 0, 0, self._begin
        self.when[:] = [
            0,
            *(holding.stamp for holding in self._core.holdings),
            *(NEVER if t is None else t for t in published),
        ]
        self.reported[:] = [0.0] * len(self.reported)
        return self._n, self._constants, before, *self._arrays

    def call(self, first: int, last: int) -> tuple[int, Any]:
        """Run ticks from `first` up to `last`, or as far as native code can.

        Returns
        -------
        reached : int
        after : tuple or None
            State and last outputs after these ticks; None if no tick was run.
        """
        kept = self.kept
        self.discarded, self.odd, kept.compiled = False, "", True
        while True:
            handed = self.handed()
            n = self._n
            try:
                after = kept.function(first, last, *handed)
            except NATIVE as error:
                # A block may raise a TypeError itself. Only if Python answers the same tick without one is the text
                # wrong.
                self.odd = _with_line(error) if isinstance(error, TypeError) else ""
                # The text stops at its tick: numpy tables have no row of it, lists have grown by the earlier ticks. All
                # is computed again up to that tick, because states are returned at the end only.
                for key, count, *_ in self._tables_of(first) if not self._typed else ():
                    for table in self.rows[key]:
                        del table[count:]
                # The random numbers that were drawn in advance have run out.
                # `drawn_` sets n[1], so that this IndexError is not taken for one of the block.
                if self.follow_draws():
                    continue
                self.discarded = True
                if n[0] <= first:
                    return first, None
                last = int(n[0])
                continue
            # An UnboundLocalError is a NameError, too; it has been caught above, because a block's values can cause it.
            except NameError as error:
                raise RunError(f"{_with_line(error)}: {DEFECT}; until then run with SOFTRIG_JIT=0") from error
            except Exception as error:
                # numba compiles at the first call, so unsupported constructs raise here.
                if type(error).__module__.partition(".")[0] != "numba":
                    raise
                # The next rig of this kind must not find a text that numba has refused.
                _texts[:] = [text for text in _texts if text is not kept]
                # numba's messages fill pages; the beginning names the construct.
                raise NotNative(f"numba: {' '.join(str(error).split())[:300]}") from None
            return int(n[0]), after

    def follow_draws(self) -> bool:
        """Draw further random numbers if the last tick was discarded for lack of them; return whether it was."""
        if not self._n[1]:
            return False
        for name, draws in self._sources.items():
            if missed := self._tables[name][1]:
                draws.at_hand.follow(missed)
        self._put_draws()
        self._name()
        return True

    def compilation(self, k: int) -> Callable[[], None]:
        """Return a function that compiles the text by a call that answers no tick."""
        self.kept.compiled = True
        self.begin(k, k)
        arguments = k, k, *self.handed()

        def compile_() -> None:
            with suppress(Exception):  # an error is reported when the function is called for ticks
                self.kept.function(*arguments)

        return compile_

    def apply(self, first: int, last: int, after: Any) -> None:
        """Store the states, answers and reports that native code has computed in the steps."""
        if (reports := self.kept.text.program.reports) is not None and self.reported[0]:
            reports.record(self.reported, self._steps)
        count = len(self._steps)
        self._unpack = self._unpack or [unpacker(value) for value in after[:count]]
        stamps = dict(zip(self.kept.text.stamped, after[2 * count :], strict=False))
        published = dict(zip(self._core.speakers, map(int, self.when[1 + len(self._core.holdings) :]), strict=True))
        for k, s in enumerate(self._steps):
            ticks = self._plan.own(s.schedule, first, last)
            if not ticks:
                continue
            s.x = applied(self._unpack[k], after[k])
            newest = {j: t for (speaker, j), t in published.items() if speaker == k} if published else {}
            answered(s, ticks[-1], after[count + k], stamps.get(k, ()), newest)
            if self._typed:
                s.native = s.native[0] + len(ticks), ""
        for holding, value in zip(self._core.holdings, after[len(after) - len(self._core.holdings) :], strict=True):
            fill = holding.fill
            # Python runs the publisher of such a link, so native code cannot have changed what its subscriber holds.
            if holding.source is None:
                continue
            if published.get((holding.source, fill.output), fill.source.t) >= self._plan.clock.time(first):
                fill.reader.values[fill.port.name] = unpacked(value)
