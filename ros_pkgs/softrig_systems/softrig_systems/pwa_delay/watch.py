"""The functional of Theorem 1 along a trajectory as a value, and its native form: the state of a monitor."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from softrig_core import Array, jit

from .system import PwaSystem

Evaluation = tuple[
    float, float, float, float
]  # whether there is a value; V, its rate (1/s), its relative rise over a delay
REACH = (
    4  # delays that the record covers: the slope of its oldest sample needs the state one delay of the plant earlier
)
CELLS, MATRICES = ("A", "Ad", "E", "e", "F"), ("L1", "S", "R", "Q", "Z")


class Fixed(NamedTuple):
    """System and certificate for the compiled functions.

    Attributes
    ----------
    A, Ad : (cells, n, n) array
    E, e : (cells, rows, 2 n) and (cells, rows) array
    F : (cells, features, 2 n) array
    L1, S, R, Q, Z : array
        Matrices of the certificate.
    m : int
        Samples in the delay bound.
    period : float
        s.
    """

    A: Array
    Ad: Array
    E: Array
    e: Array
    F: Array
    L1: Array
    S: Array
    R: Array
    Q: Array
    Z: Array
    m: int
    period: float


def fixed(system: PwaSystem, matrices: Mapping[str, Array], m: int, period: float) -> Fixed:
    """Pack a system and the matrices of its certificate."""
    cells = {name: np.stack([np.asarray(v, dtype=float) for v in getattr(system, name)]) for name in CELLS}
    known = {name: np.ascontiguousarray(matrices[name]) for name in MATRICES}
    return Fixed(**cells, **known, m=m, period=period)


class Watch:
    """The newest samples of state, slope and V, a value."""

    __slots__ = ("counts", "fixed", "rows", "slopes", "values")

    def __init__(self, fixed: Fixed) -> None:
        size, n = REACH * fixed.m + 1, fixed.A.shape[1]
        self.fixed, self.rows, self.slopes = fixed, np.zeros((size, n)), np.zeros((size, n))
        self.values, self.counts = np.zeros(fixed.m + 1), np.zeros(2, np.int64)

    def seen(self, state: tuple[float, ...], delay: float) -> tuple[Watch, Evaluation]:
        """Return the record with one more sample, and the value of the functional then.

        Raises
        ------
        ValueError
            No cell holds the state.
        """
        new = _copied(self)
        return new, evaluate(new.fixed, new.rows, new.slopes, new.values, new.counts, np.array(state), delay)

    def begun(self) -> Watch:
        """Return an empty record of the same certificate."""
        return Watch(self.fixed)

    def native(self) -> WatchRows:
        """Convert it to its form for native code."""
        new = _copied(self)
        return WatchRows(new.fixed, new.rows, new.slopes, new.values, new.counts)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Watch):
            return NotImplemented
        pairs = ((getattr(self, name), getattr(other, name)) for name in ("counts", "rows", "slopes", "values"))
        return all(np.array_equal(a, b) for a, b in pairs)


class WatchRows(NamedTuple):
    """A `Watch` in native code, which writes into its rings."""

    fixed: Fixed
    rows: Array
    slopes: Array
    values: Array
    counts: NDArray[np.int64]

    def seen(self, state: tuple[float, ...], delay: float) -> tuple[WatchRows, Evaluation]:
        """See `Watch.seen`."""
        return self, evaluate(self.fixed, self.rows, self.slopes, self.values, self.counts, np.array(state), delay)

    def python(self) -> Watch:
        """Return its Python form."""
        return _copied(self)


def _copied(watch: Watch | WatchRows) -> Watch:
    new = object.__new__(Watch)
    new.fixed, new.rows, new.slopes = watch.fixed, watch.rows.copy(), watch.slopes.copy()
    new.values, new.counts = watch.values.copy(), watch.counts.copy()
    return new


@jit
def evaluate(
    p: Fixed, rows: Array, slopes: Array, values: Array, counts: NDArray[np.int64], now: Array, delay: float
) -> Evaluation:
    """Add a sample to the rings in place, and evaluate the functional once they are long enough.

    Parameters
    ----------
    rows, slopes : (4 m + 1, n) array
        Rings of the states and of dx/d(t/h).
    values : (m + 1,) array
        Ring of V.
    counts : (2,) array of int
        Samples and values so far.
    now : (n,) array
    delay : float
        Of the plant, s.
    """
    size, n, m = rows.shape[0], now.shape[0], p.m
    count = counts[0]
    for j in range(n):
        rows[count % size, j] = now[j]
    counts[0] = count + 1
    back = round(delay / p.period)
    # Before the record is that long, the oldest sample stands for the time before it.
    stored = min(count + 1, size)
    delayed = rows[(count - min(back, stored - 1)) % size]
    cell = cell_of(p, now, delayed)
    if cell < 0:
        raise ValueError("no cell holds the state")
    h = m * p.period
    for i in range(n):
        ahead, late = 0.0, 0.0
        for j in range(n):
            ahead += p.A[cell, i, j] * now[j]
            late += p.Ad[cell, i, j] * delayed[j]
        slopes[count % size, i] = h * (ahead + late)
    if min(count + 1, size) <= m + min(back, 3 * m):
        return 0.0, 0.0, 0.0, 0.0
    value = functional_at(p, rows, slopes, count - m, m - round(min(delay / h, 1.0) * m))
    number, room = counts[1], values.shape[0]
    rate = (value - values[(number - 1) % room]) / p.period if number > 0 else 0.0
    rise = value / values[number % room] - 1.0 if number >= room else 0.0
    values[number % room] = value
    counts[1] = number + 1
    return 1.0, value, rate, rise


@jit
def cell_of(p: Fixed, now: Array, delayed: Array) -> int:
    """Return the first cell that contains (x, x_d); -1: none does."""
    n = now.shape[0]
    for cell in range(p.E.shape[0]):
        contained = True
        for row in range(p.E.shape[1]):
            total = 0.0
            for j in range(n):
                total += p.E[cell, row, j] * now[j]
            for j in range(n):
                total += p.E[cell, row, n + j] * delayed[j]
            contained = contained and total + p.e[cell, row] >= 0.0
        if contained:
            return cell
    return -1


@jit
def form(M: Array, z: Array) -> float:
    """Return z' M z."""
    total = 0.0
    for i in range(z.shape[0]):
        row = 0.0
        for j in range(z.shape[0]):
            row += M[i, j] * z[j]
        total += row * z[i]
    return total


@jit
def functional_at(p: Fixed, rows: Array, slopes: Array, first: int, k: int) -> float:
    """Evaluate V on m + 1 samples of the rings from sample `first` on; k is that of t - d (`lyapunov.functional`)."""
    size, n, m = rows.shape[0], rows.shape[1], p.m
    now, delayed = rows[(first + m) % size], rows[(first + k) % size]
    cell = cell_of(p, now, delayed)
    if cell < 0:
        raise ValueError("no cell holds the state")
    z = np.zeros(p.F.shape[1])
    for i in range(z.shape[0]):
        for j in range(n):
            z[i] += p.F[cell, i, j] * now[j]
        for j in range(n):
            z[i] += p.F[cell, i, n + j] * delayed[j]
    z2, z3 = np.zeros(3 * n), np.empty(3 * n)
    late, early, energy = 0.0, 0.0, 0.0
    for s in range(m + 1):
        x, dx = rows[(first + s) % size], slopes[(first + s) % size]
        # Trapezoids, whose ends have half the weight; one sample alone has none.
        if s >= k and k < m:
            weight = 0.5 if s in (k, m) else 1.0
            for j in range(n):
                z2[n + j] += weight * x[j] / m
                z3[j], z3[n + j], z3[2 * n + j] = x[j], dx[j], now[j] - x[j]
            late += weight * form(p.Q, z3)
        if s <= k and k > 0:
            weight = 0.5 if s in (0, k) else 1.0
            for j in range(n):
                z2[2 * n + j] += weight * x[j] / m
                z3[j], z3[n + j], z3[2 * n + j] = x[j], dx[j], delayed[j] - x[j]
            early += weight * form(p.Z, z3)
        energy += (0.5 if s in (0, m) else 1.0) * (s / m) * form(p.R, dx)
    for j in range(n):
        z2[j] = rows[first % size, j]
    return form(p.L1, z) + form(p.S, z2) + (late + early + energy) / m
