"""Grid, then a bracketed minimum: the deterministic search for a function of one variable."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .search import Moves, Search, Seed

GOLDEN = 0.5 * (3.0 - math.sqrt(5.0))
# Around a smooth minimum the value changes by less than its rounding within this share of the variable.
EPS = math.sqrt(2.2e-16)


@dataclass(eq=False, repr=False, kw_only=True)
class Scan(Search):
    """A grid over the box, then Brent's bounded search in the two cells beside the best grid point.

    Finds the best minimum that the grid separates.

    Parameters
    ----------
    n_grid : int
        Grid points, bounds included.
    tolerance : float
        Absolute tolerance of the variable; 0 leaves it at the grid.
    **options
        Those of `Search`.

    References
    ----------
    R. P. Brent, Algorithms for minimization without derivatives, 1973, ch. 5 (the form of fminbound).
    """

    n_grid: int = 20
    tolerance: float = 1e-3

    def __post_init__(self, seed: Seed) -> None:
        if len(self.lower) != 1:
            raise ValueError(f"a scan has one variable, got bounds of {len(self.lower)}")
        if self.n_grid < 3:
            raise ValueError(f"n_grid is {self.n_grid}, expected at least 3")
        super().__post_init__(seed)

    def moves(self) -> Moves:  # noqa: D102
        grid = np.linspace(self.lower[0], self.upper[0], self.n_grid).tolist()
        costs = yield [(x,) for x in grid]
        if self.tolerance == 0.0:
            return
        i = int(np.argmin(costs))
        yield from self._brent(grid[max(i - 1, 0)], grid[min(i + 1, self.n_grid - 1)])

    def _brent(self, a: float, b: float) -> Moves:
        """Golden section with parabolic steps where they behave; names as in Brent's localmin."""
        x = w = v = a + GOLDEN * (b - a)
        d = e = 0.0
        (fx,) = yield [(x,)]
        fw = fv = fx
        while True:
            self.iteration += 1
            m = 0.5 * (a + b)
            tol = EPS * abs(x) + self.tolerance / 3.0
            if abs(x - m) <= 2.0 * tol - 0.5 * (b - a):
                return
            golden = True
            if abs(e) > tol:
                r = (x - w) * (fx - fv)
                q = (x - v) * (fx - fw)
                p = (x - v) * q - (x - w) * r
                q = 2.0 * (q - r)
                if q > 0.0:
                    p = -p
                q = abs(q)
                r, e = e, d
                if abs(p) < abs(0.5 * q * r) and q * (a - x) < p < q * (b - x):
                    golden = False
                    d = p / q
                    if x + d - a < 2.0 * tol or b - x - d < 2.0 * tol:
                        d = math.copysign(tol, m - x)
            if golden:
                e = (a if x >= m else b) - x
                d = GOLDEN * e
            # Two evaluations closer than tol cannot be told apart. The comparison with 0.0 sends a step of -0.0 up too.
            u = x + (d if abs(d) >= tol else tol if d >= 0.0 else -tol)
            (fu,) = yield [(u,)]
            if fu <= fx:
                a, b = (x, b) if u >= x else (a, x)
                v, fv, w, fw, x, fx = w, fw, x, fx, u, fu
            else:
                a, b = (u, b) if u < x else (a, u)
                if fu <= fw or w == x:
                    v, fv, w, fw = w, fw, u, fu
                # The equalities of points are exact on purpose: they are copies of each other, as in Brent's localmin.
                elif fu <= fv or v in (x, w):
                    v, fv = u, fu
