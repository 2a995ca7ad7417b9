"""The plant's sums of power quality as a value, and their native form, to which the integration adds."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from softrig_core import Array, jit

from .averaged import advance as advance_averaged, read
from .circuit import Circuit, Period, turned
from .diodes import advance as advance_bridge
from .quality import FIGURES, PLAIN, TIME, WINDOWS, cleared, empty, measure, opened
from .switched import advance as advance_switched

Row = tuple[float, ...]
AVERAGED, SWITCHED, BRIDGE = 0, 1, 2
NO_TRACE = np.empty((0, 5))


class How(NamedTuple):
    """Settings of a period: model, steps, window (s), carrier (Hz), and whether there is injection."""

    kind: int
    steps: int
    window: float
    carrier: float
    injection: bool


class Sums:
    """Sums of the present window: they affect nothing and are not part of a linear view."""

    __slots__ = ("kept",)

    def __init__(self, kept: bytes) -> None:
        self.kept = kept

    @staticmethod
    def first() -> Sums:
        """Return those of the first window, without samples."""
        return Sums(empty().tobytes())

    def begun(self, windows: float) -> Sums:
        """Return sums without samples after some windows."""
        sums = empty()
        sums[PLAIN, WINDOWS] = windows
        return Sums(sums.tobytes())

    def moved(self, x: Row, how: How, circuit: Circuit, period: Period, figures: Row) -> tuple[Row, Sums, Row]:
        """Return a state a period later, the sums, and the figures of the newest whole window.

        Parameters
        ----------
        x : tuple of float
            (i_d, i_q, v) or (i_a, i_b, i_c, v).
        figures : tuple of float
            Those so far, as `quality.FIGURES`.
        """
        row, sums, result, _ = self.traced(x, how, circuit, period, figures, NO_TRACE)
        return row, sums, result

    def traced(
        self, x: Row, how: How, circuit: Circuit, period: Period, figures: Row, trace: Array
    ) -> tuple[Row, Sums, Row, Row]:
        """See `moved`; with the waveforms, which go into the rows of `trace` (steps, 5)."""
        moving, sums = np.array(x, dtype=float), opened(self.kept)
        result = np.array(figures)
        move(moving, how, circuit, period, sums, np.empty_like(sums), result, trace)
        return tuple(moving.tolist()), Sums(sums.tobytes()), tuple(result.tolist()), tuple(trace.ravel().tolist())

    def native(self) -> SumsRows:
        """Convert the sums to their form for native code."""
        sums = opened(self.kept)
        return SumsRows(sums, np.zeros_like(sums), np.zeros(len(FIGURES)), NO_TRACE.copy())

    def __eq__(self, other: object) -> bool:
        return self.kept == other.kept if isinstance(other, Sums) else NotImplemented

    def __hash__(self) -> int:
        return hash(self.kept)


class SumsRows(NamedTuple):
    """`Sums` in native code, which adds to them in place."""

    sums: Array
    complete: Array
    values: Array
    # It has no rows. It is a field because native code treats a global array as read only.
    trace: Array

    def begun(self, windows: float) -> SumsRows:
        """See `Sums.begun`."""
        cleared(self.sums, windows)
        return self

    def moved(self, x: Row, how: How, circuit: Circuit, period: Period, figures: Row) -> tuple[Row, SumsRows, Row]:
        """See `Sums.moved`."""
        moving = np.array(x)
        for k, value in enumerate(figures):
            self.values[k] = value
        move(moving, how, circuit, period, self.sums, self.complete, self.values, self.trace)
        row = tuple([moving[k] for k, _ in enumerate(x)])
        return row, self, tuple([self.values[k] for k, _ in enumerate(figures)])

    def python(self) -> Sums:
        """Return them as Python has them."""
        return Sums(self.sums.tobytes())


@jit
def move(
    x: Array, how: How, circuit: Circuit, period: Period, sums: Array, complete: Array, values: Array, trace: Array
) -> None:
    """Move a state over one period in place; `values` gets the figures of a window that ends in it."""
    windows = sums[PLAIN, WINDOWS]
    both = (circuit, period)
    if how.kind == BRIDGE:
        abc = np.zeros(4)
        abc[0], abc[1], abc[2], abc[3] = read(period.start, x, circuit)
        advance_bridge(abc, how.steps, how.window, both, sums, complete, trace)
        if x.size == 4:
            x[0], x[1], x[2], x[3] = abc[0], abc[1], abc[2], abc[3]
        else:
            x[0], x[1] = turned(abc[0], abc[1], abc[2], circuit.omega * (period.start + period.length))
            x[2] = abc[3]
    elif how.kind == SWITCHED:
        advance_switched(x, how.steps, how.window, both, how.carrier, how.injection, sums, complete, trace)
    else:
        advance_averaged(x, how.steps, how.window, both, sums, complete, trace)
    if sums[PLAIN, WINDOWS] != windows and complete[PLAIN, TIME] > 0.999 * how.window:
        measure(complete, values)
