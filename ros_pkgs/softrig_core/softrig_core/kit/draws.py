"""Random numbers by index: the k-th number of a stream is the same for every caller and every call."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

# Numbers drawn in one call: one call for each number would take most of its time in numpy's overhead.
SIZE = 4096
# So many rows are at hand, so that going back a little draws nothing again.
KEPT = 4
# Numbers of a table for native code before its random numbers: the index of the first of them, and the index + 1 of one
# that native code has missed.
HEAD = 2
# So many random numbers are in a window at first or come at a time, 4 MB, and so many earlier ones remain: native code
# that has missed one computes all ticks of its call again.
MOST = BACK = 1 << 19
# Tables and rows of as many streams as nodes of a rig draw from, kept for the next run: those of a study often have one
# seed.
STREAMS = 12
# So many rows of a stream are kept: ticks in Python at the begin of a run draw from these.
FIRST = 2
# Of so many numbers at most.
LONGEST = 1 << 17
_begun: dict[tuple[Any, ...], Any] = {}


def _once(key: tuple[Any, ...], make: Callable[[], Any]) -> Any:
    """Return the numbers that were drawn before from the same state of a generator; draw them the first time."""
    if key not in _begun:
        result = make()
        while len(_begun) >= STREAMS:
            del _begun[next(iter(_begun))]
        _begun[key] = result
    return _begun[key]


class Stream:
    """A stream of uniform numbers from which native loops draw by themselves.

    Parameters
    ----------
    generator : numpy.random.Generator
        A new generator, as returned by `numpy.random.default_rng`; no other code may draw from it from now on.
    """

    # A number depends on its index alone; these only remember where the generator is.
    SCRATCH = frozenset({"_generator", "_at"})

    def __init__(self, generator: np.random.Generator) -> None:
        self._generator, self._begin, self._at = generator, generator.bit_generator.state, 0

    def at(self, k: int) -> np.random.Generator:
        """Return a generator whose next number is the k-th of the stream; report the draws by `drawn`."""
        if k != self._at:
            bits: Any = self._generator.bit_generator
            bits.state = self._begin
            bits.advance(k)
            self._at = k
        return self._generator

    def drawn(self, k: int) -> int:
        """Report that numbers up to the k-th have been drawn; returns k."""
        self._at = k
        return k

    def __eq__(self, other: object) -> bool:
        return self._begin == other._begin if isinstance(other, Stream) else NotImplemented


class Draws:
    """A stream of random numbers as a function of an index.

    Numbers are drawn in rows, in their order; the generator's state before each row is kept (two words), so that going
    back draws the same row again. The stored numbers are only a cache: the k-th number depends on the stream and on k
    alone.

    Parameters
    ----------
    seeds : sequence of int
        Of numpy's default generator: the stream begins with its first number.
    kind : {"standard_normal", "random"}
        Normal with mean 0 and variance 1, or uniform in [0, 1).

    Attributes
    ----------
    at_hand : Window, optional
        Numbers that a caller keeps for a time: they are not drawn again.
    """

    # A number depends on its index alone; these are a cache.
    SCRATCH = frozenset({"_generator", "_before", "_rows", "at_hand"})

    def __init__(self, seeds: Sequence[int], kind: Literal["standard_normal", "random"]) -> None:
        self._seeds, self._kind = tuple(seeds), kind
        self._before: list[Any] = [None]  # the state before each row; that before the first is set with the generator
        self._rows: dict[int, list[float]] = {}
        self.at_hand: Window | None = None

    def __call__(self, k: int) -> float:
        """Return the k-th number, from 0 on."""
        row = self._rows.get(k // SIZE)
        if row is None and self.at_hand is not None and (number := self.at_hand.number(k)) is not None:
            return number
        return (self._drawn(k // SIZE) if row is None else row)[k % SIZE]

    @property
    def normal(self) -> bool:
        """Return whether they are normal, not uniform."""
        return self._kind == "standard_normal"

    @property
    def words(self) -> tuple[int, int]:
        """State of the generator before the first number, and its increment: 128 bits each (PCG64)."""
        state: Any = self._stream().bit_generator.state
        return state["state"]["state"], state["state"]["inc"]

    @property
    def _key(self) -> tuple[Any, ...]:
        """Return all that determines the numbers."""
        return self._kind, self._seeds

    def first(self, count: int) -> NDArray[np.float64]:
        """Return the first `count` numbers, shape (count,); they must not be changed."""

        def draw() -> Any:
            return self.drawing()(count)

        result: NDArray[np.float64] = draw() if count > LONGEST else _once((*self._key, count), draw)
        return result

    def drawing(self) -> Callable[[int], NDArray[np.float64]]:
        """Return a function that draws the next numbers at each call, from the first on."""
        result: Callable[[int], NDArray[np.float64]] = getattr(self._stream(), self._kind)
        return result

    def _stream(self) -> np.random.Generator:
        """Return a new generator at the beginning of the stream."""
        import numpy as np

        return np.random.default_rng(self._seeds)

    # To make a generator takes a tenth of a millisecond, and in most runs of a study all numbers are at hand.
    @cached_property
    def _generator(self) -> np.random.Generator:
        result = self._stream()
        self._before[:1] = [result.bit_generator.state]
        return result

    def _drawn(self, n: int) -> list[float]:
        """Draw row n, and first all rows before it that have not been drawn yet."""

        def draw(m: int) -> tuple[Any, Any]:
            generator: Any = self._generator
            generator.bit_generator.state = self._before[m]
            return getattr(generator, self._kind)(SIZE).tolist(), generator.bit_generator.state

        for m in range(min(n, len(self._before) - 1), n + 1):
            # Only the first rows are kept for other runs, so what is kept does not grow with the length of a run. Two
            # kinds of numbers of one node come from alternating rows.
            row, after = _once((*self._key, "row", m), partial(draw, m)) if m < FIRST else draw(m)
            if m + 1 == len(self._before):
                self._before.append(after)
        while len(self._rows) >= KEPT:
            del self._rows[next(iter(self._rows))]
        self._rows[n] = row
        return row  # type: ignore[no-any-return]


class Window:
    """Consecutive random numbers for native code, which move on with the run.

    Parameters
    ----------
    draws : Draws
        The stream.
    count : int
        How many numbers there are at first.

    Attributes
    ----------
    table : array of float, shape (HEAD + n,)
        See `HEAD`.
    """

    def __init__(self, draws: Draws, count: int) -> None:
        import numpy as np

        self._draws, self._count, self._all = draws, count, False
        self._next: Callable[[int], NDArray[np.float64]] | None = None
        self.table = np.concatenate((np.zeros(HEAD), draws.first(count)))

    def number(self, k: int) -> float | None:
        """Return the k-th number of the stream, if it is in the table."""
        index = HEAD + k - int(self.table[0])
        return float(self.table[index]) if HEAD <= index < len(self.table) else None

    def follow(self, missed: float) -> None:
        """Move the window to a number that native code has missed; `missed` is its index + 1."""
        import numpy as np

        k, begin = int(missed) - 1, int(self.table[0])
        if self._next is None:
            # The first numbers are often those of an earlier run, so that this one has drawn none yet.
            self._next = self._draws.drawing()
            self._next(self._count)
        if k < begin:
            # Code that goes far back may do so at each tick, so that from now on all numbers are kept.
            self._next, self._all, begin, self.table = self._draws.drawing(), True, 0, self.table[:HEAD]
        end = begin + len(self.table) - HEAD
        first = begin if self._all else min(max(begin, k - BACK), end)
        overlap = self.table[HEAD + first - begin :]
        # As many new numbers as remain, so that a table which keeps all doubles and is not copied for each few numbers.
        self.table = np.concatenate(((first, 0.0), overlap, self._next(max(MOST, len(overlap), k + 1 - end))))
