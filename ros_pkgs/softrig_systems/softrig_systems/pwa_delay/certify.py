"""Certificates: ask a criterion at one delay, check the answer from its matrices, bisect for the largest delay."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np

from .applicability import require_equilibrium, require_no_sliding
from .bessel import bessel
from .lmi import Array, Eigenvalues, Problem
from .system import PwaSystem
from .theorem1 import theorem1

Method = Literal["theorem1", "constant"]


class Criterion(NamedTuple):
    """Which criterion, and its options."""

    method: Method = "theorem1"
    mu: float = 0.0
    order: int = 2
    cell_terms: bool = False

    def problem(self, system: PwaSystem) -> Problem:
        """Write its inequalities for the delay 1 of a scaled system."""
        if self.method == "constant":
            return bessel(system, self.order, cell_terms=self.cell_terms)
        return theorem1(system, self.mu, cell_terms=self.cell_terms)


THEOREM1 = Criterion()


class Certificate(NamedTuple):
    """What is known at one delay bound.

    Parameters
    ----------
    h : float
        Delay bound, s.
    valid : bool
        Every inequality holds, evaluated from `matrices`; never the solver's word alone.
    t : float
        The solver's margin.
    matrices : dict of str to array
        The unknowns, in the time t/h.
    eigenvalues : list of Eigenvalues
        Of each inequality.
    status : str
        The solver's.
    seconds : float
        Wall-clock time of assembly, solver and check.
    """

    h: float
    valid: bool
    t: float
    matrices: dict[str, Array]
    eigenvalues: list[Eigenvalues]
    status: str
    seconds: float


def certify(system: PwaSystem, h: float, criterion: Criterion = THEOREM1, *, sliding: bool = True) -> Certificate:
    """Look for a certificate at one delay bound.

    Parameters
    ----------
    system : PwaSystem
    h : float
        Delay bound, s, > 0.
    criterion : Criterion
    sliding : bool
        Test for sliding too; a search tests the largest delay only.

    Raises
    ------
    NotApplicable
        No equilibrium at the origin, or sliding on a face.
    ValueError
        h or mu out of range.
    """
    if not (h > 0.0 and math.isfinite(h)):
        raise ValueError(f"h = {h}: expected a positive time")
    if not (criterion.mu >= 0.0 and math.isfinite(criterion.mu)):
        raise ValueError(f"mu = {criterion.mu}: expected at least 0")
    begin = time.perf_counter()
    system = require_equilibrium(system)
    if sliding:
        require_no_sliding(system, h)
    problem = criterion.problem(system.scaled(h))
    found = problem.solve()
    eigenvalues = problem.check(found.matrices)
    valid = found.status == "Solved" and found.t > 0.0 and all(e.positive for e in eigenvalues)
    return Certificate(h, valid, found.t, found.matrices, eigenvalues, found.status, time.perf_counter() - begin)


def certified_margin(
    system: PwaSystem, criterion: Criterion = THEOREM1, *, low: float = 0.0, high: float = 0.0, width: float = 1e-4,
    tell: Callable[[Certificate], object] | None = None,
) -> Certificate | None:  # fmt: skip
    """Bisect for the largest delay bound with a certificate.

    Parameters
    ----------
    low, high : float
        Bracket, s; found by doubling where it is 0 or does not hold.
    width : float
        Relative width at which it ends.
    tell : callable, optional
        Called with each certificate tried.

    Returns
    -------
    Certificate or None
        The last valid one; None when there is none even at a delay of 1e-6 of the system's fastest time.
    """

    def ask(h: float) -> Certificate:
        found = certify(system, h, criterion, sliding=False)
        if tell is not None:
            tell(found)
        return found

    require_no_sliding(require_equilibrium(system), high or 1e-9)
    high = high or low or _fast_time(system)
    best = ask(low) if low > 0.0 else None
    if best is None or not best.valid:
        smallest = 1e-6 * _fast_time(system)
        low = min(high, low or high) / 2.0
        while not (best := ask(low)).valid:
            high, low = low, low / 2.0
            if low < smallest:
                return None
    while (above := ask(high)).valid:
        best, low, high = above, high, 2.0 * high
        if high > 1e9 * _fast_time(system):
            return best  # stable for every delay, as far as that can be told
    while high - low > max(width * low, 2.0 * math.ulp(high)):  # numbers between them, too
        middle = 0.5 * (low + high)
        found = ask(middle)
        if found.valid:
            best, low = found, middle
        else:
            high = middle
    require_no_sliding(require_equilibrium(system), low)
    return best


def _fast_time(system: PwaSystem) -> float:

    return 1.0 / max(
        float(np.linalg.norm(A, 2) + np.linalg.norm(Ad, 2)) for A, Ad in zip(system.A, system.Ad, strict=True)
    )
