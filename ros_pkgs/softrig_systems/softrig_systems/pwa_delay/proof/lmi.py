"""Linear matrix inequalities in named unknowns: solved with Clarabel, evaluated again from the matrices found.

cvxpy would build the same cone program; assembling it here, from terms that are evaluated again for the check, takes a
twentieth of its time.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from softrig_core import Array

TRACE = 1000.0  # the sum of the traces: certificates are rays, this picks a point on each
SMALLEST = 1e-9  # smallest eigenvalue of a strict inequality, as a share of its largest


class Term(NamedTuple):
    """Left X Right' + (Left X Right')' of an unknown X."""

    name: str
    left: Array
    right: Array


def quadratic(name: str, left: Array, factor: float = 1.0) -> Term:
    """Return the term factor Left X Left' of a symmetric unknown."""
    return Term(name, 0.5 * factor * left, left)


class Inequality(NamedTuple):
    """A sum of terms that must be positive definite."""

    name: str
    terms: tuple[Term, ...]
    size: int


class Unknown(NamedTuple):
    """An unknown: its position in the vector of all unknowns, its shape, whether it is symmetric and entrywise >= 0."""

    start: int
    shape: tuple[int, int]
    symmetric: bool
    positive: bool

    @property
    def count(self) -> int:
        """Free entries."""
        n, m = self.shape
        return n * (n + 1) // 2 if self.symmetric else n * m


class Eigenvalues(NamedTuple):
    """Smallest and largest eigenvalue of an inequality."""

    name: str
    smallest: float
    largest: float

    @property
    def positive(self) -> bool:
        """Return whether it is positive definite beyond doubt."""
        return self.smallest > SMALLEST * max(abs(self.largest), abs(self.smallest))


class Solution(NamedTuple):
    """Result of the solver: its status, the margin t, the unknowns, and the computation time (s)."""

    status: str
    t: float
    matrices: dict[str, Array]
    seconds: float
    iterations: int


class Problem:
    """Inequalities to be solved with the largest margin t: each >= t I, with a fixed sum of some traces."""

    def __init__(self) -> None:
        self.unknowns: dict[str, Unknown] = {}
        self.inequalities: list[Inequality] = []
        self.traced: list[Inequality] = []
        self.size = 0

    def symmetric(self, name: str, n: int, *, positive: bool = False) -> None:
        """Declare a symmetric unknown (n, n); with `positive` its entries are >= 0."""
        self._declare(name, (n, n), True, positive)

    def matrix(self, name: str, rows: int, columns: int) -> None:
        """Declare an unknown (rows, columns)."""
        self._declare(name, (rows, columns), False, False)

    def _declare(self, name: str, shape: tuple[int, int], symmetric: bool, positive: bool) -> None:
        self.unknowns[name] = Unknown(self.size, shape, symmetric, positive)
        self.size += self.unknowns[name].count

    def positive(self, name: str, terms: list[Term], *, traced: bool = False) -> None:
        """Require that a sum of terms is positive definite; `traced`: its trace counts in the fixed sum."""
        self.inequalities.append(Inequality(name, tuple(terms), terms[0].left.shape[0]))
        if traced:
            self.traced.append(self.inequalities[-1])

    def solve(self) -> Solution:
        """Ask Clarabel; deterministic, one thread.

        Returns
        -------
        Solution
            Its status and t are the solver's; only `check` makes a certificate of it.
        """
        import clarabel
        import scipy.sparse as sp

        begin = time.perf_counter()
        width = self.size + 1  # t last
        row = np.zeros(width)
        for inequality in self.traced:
            for name, matrix in self._coefficients(inequality).items():
                u = self.unknowns[name]
                row[u.start : u.start + u.count] += matrix[_diagonal(inequality.size)].sum(axis=0)
        blocks, sides, cones = [sp.csc_matrix(row[None, :])], [np.array([TRACE])], [clarabel.ZeroConeT(1)]
        signed = [k for u in self.unknowns.values() if u.positive for k in range(u.start, u.start + u.count)]
        if signed:
            n = len(signed)
            blocks.append(sp.csc_matrix((-np.ones(n), (np.arange(n), signed)), shape=(n, width)))
            sides.append(np.zeros(n))
            cones.append(clarabel.NonnegativeConeT(n))
        for inequality in self.inequalities:
            rows, columns, values = [], [], []
            for name, matrix in self._coefficients(inequality).items():
                r, c = np.nonzero(matrix)
                rows.append(r)
                columns.append(c + self.unknowns[name].start)
                values.append(-matrix[r, c])
            diagonal = _diagonal(inequality.size)
            rows.append(diagonal)
            columns.append(np.full(diagonal.size, self.size))
            values.append(np.ones(diagonal.size))
            n = inequality.size * (inequality.size + 1) // 2
            entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
            blocks.append(sp.csc_matrix(entries, shape=(n, width)))
            sides.append(np.zeros(n))
            cones.append(clarabel.PSDTriangleConeT(inequality.size))
        aim = np.zeros(width)
        aim[-1] = -1.0
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.max_threads = 1
        settings.tol_gap_abs = settings.tol_gap_rel = 1e-7  # t decides by its sign; more makes the last steps inexact
        solver = clarabel.DefaultSolver(
            sp.csc_matrix((width, width)), aim, sp.vstack(blocks, format="csc"), np.concatenate(sides), cones, settings
        )
        solution = solver.solve()
        x = np.array(solution.x)
        return Solution(
            str(solution.status),
            float(x[-1]),
            self._split(x),
            time.perf_counter() - begin,
            int(solution.iterations),
        )

    def _coefficients(self, inequality: Inequality) -> dict[str, Array]:
        """Return, for each unknown, the matrix from its free entries to the scaled upper triangle of the inequality."""
        i, j = _triangle(inequality.size)
        weight = np.where(i == j, 1.0, np.sqrt(2.0))[:, None]
        result: dict[str, Array] = {}
        for name, left, right in inequality.terms:
            u = self.unknowns[name]
            if u.symmetric:
                a, b = _triangle(u.shape[0])
                matrix = left[i][:, a] * right[j][:, b] + left[j][:, a] * right[i][:, b]
                off = a != b
                matrix[:, off] += left[i][:, b[off]] * right[j][:, a[off]] + left[j][:, b[off]] * right[i][:, a[off]]
            else:
                a, b = (k.ravel() for k in np.indices(u.shape))
                matrix = left[i][:, a] * right[j][:, b] + left[j][:, a] * right[i][:, b]
            matrix *= weight
            result[name] = result[name] + matrix if name in result else matrix
        return result

    def _split(self, x: Array) -> dict[str, Array]:
        result = {}
        for name, u in self.unknowns.items():
            values = x[u.start : u.start + u.count]
            if u.positive:
                values = np.maximum(values, 0.0)  # an interior point may be a rounding error outside
            if u.symmetric:
                result[name] = np.zeros(u.shape)
                a, b = _triangle(u.shape[0])
                result[name][a, b] = result[name][b, a] = values
            else:
                result[name] = values.reshape(u.shape)
        return result

    def eigenvalues(self, matrices: Mapping[str, Array]) -> list[Eigenvalues]:
        """Evaluate every inequality only from given matrices, in float64, without the solver.

        Negative entries of an unknown that must have none count as a violated inequality.
        """
        result = []
        for inequality in self.inequalities:
            total = np.zeros((inequality.size, inequality.size))
            for name, left, right in inequality.terms:
                product = left @ matrices[name] @ right.T
                total += product + product.T
            values = np.linalg.eigvalsh(total)
            result.append(Eigenvalues(inequality.name, float(values[0]), float(values[-1])))
        for name, u in self.unknowns.items():
            if u.positive and np.any(matrices[name] < 0.0):
                result.append(Eigenvalues(f"entries of {name}", float(np.min(matrices[name])), 0.0))
        return result


def _triangle(n: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns of the upper triangle, column by column."""
    return (
        np.concatenate([np.arange(k + 1) for k in range(n)]),
        np.concatenate([np.full(k + 1, k) for k in range(n)]),
    )


def _diagonal(n: int) -> NDArray[np.int64]:
    """Places of the diagonal in the triangle."""
    k = np.arange(n)
    return k * (k + 3) // 2
