"""Piecewise affine systems with delay: cells, features, and the published examples."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from softrig_core import Array
from softrig_core.kit import dense

ROUNDING = 1e-9  # share of the sizes of its terms up to which a sum counts as zero


class BadSystem(ValueError):
    """Matrices that are no piecewise affine system; the text names cell and face."""


@dataclass(frozen=True)
class PwaSystem:
    """x' = A_i x + Ad_i x_d + a_i in cell i, x_d = x(t - d(t)).

    Cell i is where ``E_i [x; x_d] + e_i >= 0``, row by row. The features ``F_i [x; x_d]`` are continuous over the
    cells; the functional is quadratic in them, P_i = F_i' L F_i.

    Parameters
    ----------
    A, Ad : tuple of (n, n) array
        One a cell.
    a : tuple of (n,) array
        Offset of each cell.
    E : tuple of (rows, 2 n) array
        Rows of each cell; none for a cell that is everything.
    e : tuple of (rows,) array
        Offsets of the rows.
    F : tuple of (m, 2 n) array
        Features of each cell, the last 2 n rows the identity.
    lines, lines_delayed : (k, n) array
        The switching lines c'x = 0 and c'x_d = 0, where the cells come from such.

    Raises
    ------
    BadSystem
        Unequal sizes, values that are not finite, cells that overlap or leave a gap, features that jump.
    """

    A: tuple[Array, ...]
    Ad: tuple[Array, ...]
    a: tuple[Array, ...]
    E: tuple[Array, ...]
    e: tuple[Array, ...]
    F: tuple[Array, ...]
    lines: Array
    lines_delayed: Array

    def __post_init__(self) -> None:
        self._check_sizes()
        self._check_cover()
        self._check_features()

    @property
    def n(self) -> int:
        """Number of states."""
        return self.A[0].shape[0]

    @property
    def cells(self) -> int:
        """Number of cells."""
        return len(self.A)

    def cell(self, x: Array, x_d: Array) -> int:
        """Return the first cell that contains (x, x_d)."""
        z = np.concatenate([x, x_d])
        for i in range(self.cells):
            if np.all(dense.product(self.E[i], z) + self.e[i] >= 0.0):
                return i
        raise BadSystem(f"no cell holds x = {x}, x_d = {x_d}")

    def scaled(self, h: float) -> PwaSystem:
        """Return the system in the time t/h, in which a delay of h is 1."""
        result = copy(self)  # cells and features stay, and what was checked of them
        for name in ("A", "Ad", "a"):
            object.__setattr__(result, name, tuple(h * m for m in getattr(self, name)))
        return result

    def _check_sizes(self) -> None:
        n, cells = self.A[0].shape[0], len(self.A)
        for name in ("Ad", "a", "E", "e", "F"):
            if len(getattr(self, name)) != cells:
                raise BadSystem(f"{len(getattr(self, name))} matrices {name} for {cells} cells")
        for i in range(cells):
            rows = self.E[i].shape[0]
            wanted = {
                "A": (n, n),
                "Ad": (n, n),
                "a": (n,),
                "E": (rows, 2 * n),
                "e": (rows,),
                "F": (self.F[0].shape[0], 2 * n),
            }
            for name, shape in wanted.items():
                matrix = getattr(self, name)[i]
                if matrix.shape != shape:
                    raise BadSystem(f"{name} of cell {i} has the shape {matrix.shape}, expected {shape}")
                if not np.all(np.isfinite(matrix)):
                    raise BadSystem(f"{name} of cell {i} is not finite")

    def _check_cover(self) -> None:
        """Draw points; each must be inside one cell, and in no other."""
        points = np.random.default_rng(1).normal(size=(600, 2 * self.n))
        least = np.array(
            [
                np.min((points @ E.T + e) / (np.abs(points) @ np.abs(E.T) + np.abs(e)), axis=1, initial=np.inf)
                for E, e in zip(self.E, self.e, strict=True)
            ]
        )
        interior, near = least > 1e-12, least >= -1e-12
        for k in np.flatnonzero(~near.any(axis=0) | (interior.sum(axis=0) > 1))[:1]:
            point = f"x = {np.round(points[k, : self.n], 3)}, x_d = {np.round(points[k, self.n :], 3)}"
            if not near[:, k].any():
                raise BadSystem(f"no cell holds {point}: the cells leave a gap")
            first, second = np.flatnonzero(interior[:, k])[:2]
            raise BadSystem(f"cells {first} and {second} overlap at {point}")

    def faces(self) -> list[tuple[int, int, int]]:
        """Return the common faces as (cell, row, other cell): the row of E that is an equality there."""
        result = []
        rng = np.random.default_rng(2)
        for i in range(self.cells):
            for row in range(self.E[i].shape[0]):
                near = set()
                for z in self.on_face(i, row, rng, 20):
                    beyond = z - 1e-6 * self.E[i][row] / np.linalg.norm(self.E[i][row])
                    near |= {j for j in range(self.cells) if j != i and np.all(self.E[j] @ beyond + self.e[j] >= 0.0)}
                result += [(i, row, j) for j in sorted(near)]
        return result

    def on_face(self, i: int, row: int, rng: np.random.Generator, count: int) -> list[Array]:
        """Draw points (x, x_d) of cell i on which its row is an equality."""
        normal, offset = self.E[i][row], self.e[i][row]
        others = np.delete(np.arange(self.E[i].shape[0]), row)
        result: list[Array] = []
        for z in rng.normal(size=(200 * count, 2 * self.n)):
            z = z - normal * (normal @ z + offset) / (normal @ normal)
            if np.all(self.E[i][others] @ z + self.e[i][others] >= 0.0):
                result.append(z)
                if len(result) == count:
                    break
        return result

    def _check_features(self) -> None:
        rng = np.random.default_rng(3)
        for i, row, j in self.faces():
            for z in self.on_face(i, row, rng, 5):
                size = float(np.abs(z).max())  # z is right beside its largest entry
                slack = ROUNDING * (np.abs(self.E[j]).sum(axis=1) * size + np.abs(self.e[j]))
                if np.all(self.E[j] @ z + self.e[j] >= -slack):
                    gaps = np.abs(self.F[i] @ z - self.F[j] @ z)
                    gap = float(gaps.max())
                    if np.any(gaps > ROUNDING * size * (np.abs(self.F[i]) + np.abs(self.F[j])).sum(axis=1)):
                        raise BadSystem(
                            f"features of cells {i} and {j} differ by {gap:.3g} on their face "
                            f"{np.round(self.E[i][row], 3).tolist()} [x; x_d] = 0"
                        )


def from_lines(
    A: Sequence[ArrayLike],
    Ad: Sequence[ArrayLike],
    lines: ArrayLike = (),
    lines_delayed: ArrayLike = (),
    a: Sequence[ArrayLike] | None = None,
) -> PwaSystem:
    """Build a system whose cells are the signs of c'x and c'x_d for some lines c, with their hinges as features.

    A hinge max(0, c'x) or max(0, c'x_d) for each line, stacked on x and x_d: in a cell its row is c where the hinge is
    active and 0 elsewhere, so the features are continuous.

    Parameters
    ----------
    A, Ad : sequence of (n, n)
        One a cell; the first line's sign changes slowest, negative first.
    lines, lines_delayed : (k, n)
        Lines on x and on x_d.
    a : sequence of (n,), optional
        Offsets; none.

    Raises
    ------
    BadSystem
        Not one matrix a combination of signs, or what `PwaSystem` refuses.
    """
    first = np.atleast_2d(np.asarray(A[0], dtype=float))
    n = first.shape[0]
    on_x = np.asarray(lines, dtype=float).reshape(-1, n)
    on_d = np.asarray(lines_delayed, dtype=float).reshape(-1, n)
    rows = np.vstack([np.hstack([on_x, np.zeros_like(on_x)]), np.hstack([np.zeros_like(on_d), on_d])])
    if not np.all(np.isfinite(rows)) or np.any(np.linalg.norm(rows, axis=1) == 0.0):
        raise BadSystem("a switching line is zero or not finite")
    signs = list(itertools.product((-1.0, 1.0), repeat=rows.shape[0]))
    if len(A) != len(signs) or len(Ad) != len(signs):
        raise BadSystem(f"{len(A)} matrices A and {len(Ad)} Ad for {len(signs)} cells of {rows.shape[0]} lines")
    E = tuple(np.array(s)[:, None] * rows if s else np.zeros((0, 2 * n)) for s in signs)
    F = tuple(
        np.vstack([np.where(np.array(s)[:, None] > 0.0, rows, 0.0), np.eye(2 * n)]) if s else np.eye(2 * n)
        for s in signs
    )

    def square(m: ArrayLike) -> Array:
        return np.atleast_2d(np.asarray(m, dtype=float))

    offsets = [np.zeros(n)] * len(signs) if a is None else [np.asarray(v, dtype=float).reshape(-1) for v in a]
    return PwaSystem(
        tuple(map(square, A)),
        tuple(map(square, Ad)),
        tuple(offsets),
        E,
        tuple(np.zeros(r.shape[0]) for r in E),
        F,
        on_x,
        on_d,
    )


def switched() -> PwaSystem:
    """P1: x' = -0.1 x + Ad x_d with two matrices Ad, chosen by the sign of |x1| - |x2| (of x, not of x_d)."""
    tall, wide = [[0.0, 5.0], [-1.0, 0.0]], [[0.0, 1.0], [-5.0, 0.0]]
    # signs of (x1 - x2, x1 + x2): |x1| >= |x2| where they agree
    return from_lines([-0.1 * np.eye(2)] * 4, [tall, wide, wide, tall], [[1.0, -1.0], [1.0, 1.0]])


def pendulum(k_negative: float = 1.0, k_positive: float = 5.0) -> PwaSystem:
    """P3: theta' = omega, omega' = a theta - k (theta_d + omega_d); a by the sign of theta, k by that of theta_d."""
    A, Ad = [], []
    for a in (-0.825, -0.4875):
        for k in (k_negative, k_positive):
            A.append([[0.0, 1.0], [a, 0.0]])
            Ad.append([[0.0, 0.0], [-k, -k]])
    return from_lines(A, Ad, [[1.0, 0.0]], [[1.0, 0.0]])


TANK_C = math.sqrt(1000.0 * 9.8) / (10.0 * 1000.0 * 11.3882)  # sqrt(phi g)/(A phi H); the mix of units is the paper's
SLOPE_LOW, SLOPE_HIGH = -8.6928e-4, -5.0188e-4
OFFSET_LOW, OFFSET_HIGH = -2.1732e-4, -3.7641e-4


def continuous_tank() -> PwaSystem:
    """P2c: z' = a(z) z - k(z_d) z_d, z = level - 0.5: the slopes of the tank with a continuous law."""
    A = [[[a]] for a in (SLOPE_LOW, SLOPE_HIGH) for _ in range(2)]
    Ad = [[[-k]] for _ in range(2) for k in (0.2, 0.1)]
    return from_lines(A, Ad, [[1.0]], [[1.0]])


def tank() -> PwaSystem:
    """P2 as the paper writes it, z = level - 0.5: gain 0.2 or -0.1 chosen by the level, so nothing rests at z = 0."""
    low, high = SLOPE_LOW * 0.5 + OFFSET_LOW + 0.2 * 0.5, SLOPE_HIGH * 0.5 + OFFSET_HIGH - 0.1 * 0.5
    return from_lines([[[SLOPE_LOW]], [[SLOPE_HIGH]]], [[[0.2]], [[-0.1]]], [[1.0]], a=[[low], [high]])


def linear(A: ArrayLike, Ad: ArrayLike) -> PwaSystem:
    """Return one cell: x' = A x + Ad x_d."""
    return from_lines([A], [Ad])
