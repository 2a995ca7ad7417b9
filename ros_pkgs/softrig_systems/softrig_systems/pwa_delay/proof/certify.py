"""Certificates: ask a criterion at one delay, check the answer from its matrices, bisect for the largest delay."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np
from softrig_core import Array

from ..system import PwaSystem
from .applicability import require_equilibrium, require_no_sliding
from .bessel_legendre import bessel_legendre
from .lmi import Eigenvalues, Problem
from .theorem1 import theorem1

Method = Literal["theorem1", "constant"]


class Criterion(NamedTuple):
    """Stability criterion and its options."""

    method: Method = "theorem1"
    mu: float = 0.0
    order: int = 2
    cell_terms: bool = False

    def problem(self, system: PwaSystem, shortest: float = 1.0) -> Problem:
        """Write its inequalities for the delay 1 of a scaled system; constant: for all from `shortest` to 1."""
        if self.method == "constant":
            return bessel_legendre(system, self.order, shortest=shortest, cell_terms=self.cell_terms)
        return theorem1(system, self.mu, cell_terms=self.cell_terms)


THEOREM1 = Criterion()


class Certificate(NamedTuple):
    """Result of a criterion at one delay bound.

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
    shortest : float
        Shortest delay covered, s: 0 for Theorem 1; h for one constant delay alone.
    """

    h: float
    valid: bool
    t: float
    matrices: dict[str, Array]
    eigenvalues: list[Eigenvalues]
    status: str
    seconds: float
    shortest: float = 0.0


def certify(
    system: PwaSystem, h: float, criterion: Criterion = THEOREM1, *, shortest: float | None = None, sliding: bool = True
) -> Certificate:
    """Look for a certificate at one delay bound.

    Parameters
    ----------
    h : float
        Delay bound, s, > 0.
    shortest : float, optional
        Constant: for every delay from here to h, 0 to h, s; h alone when absent.
    sliding : bool
        Test for sliding too; a search tests the largest delay only.

    Raises
    ------
    NotApplicable
        No equilibrium at the origin, or sliding on a face.
    ValueError
        h, mu or shortest out of range.
    """
    if not (h > 0.0 and math.isfinite(h)):
        raise ValueError(f"h = {h}: expected a positive time")
    if not (criterion.mu >= 0.0 and math.isfinite(criterion.mu)):
        raise ValueError(f"mu = {criterion.mu}: expected at least 0")
    covered = 0.0 if criterion.method == "theorem1" else h if shortest is None else shortest
    if not 0.0 <= covered <= h:
        raise ValueError(f"shortest = {covered}: expected from 0 to h = {h}")
    begin = time.perf_counter()
    system = require_equilibrium(system)
    if sliding:
        require_no_sliding(system, h)
    problem = criterion.problem(system.scaled(h), covered / h)
    solution = problem.solve()
    eigenvalues = problem.eigenvalues(solution.matrices)
    valid = solution.status == "Solved" and solution.t > 0.0 and all(e.positive for e in eigenvalues)
    seconds = time.perf_counter() - begin
    return Certificate(h, valid, solution.t, solution.matrices, eigenvalues, solution.status, seconds, covered)


def certified_margin(
    system: PwaSystem,
    criterion: Criterion = THEOREM1,
    *,
    low: float = 0.0,
    high: float = 0.0,
    width: float = 1e-4,
    tell: Callable[[Certificate], object] | None = None,
) -> Certificate | None:
    """Look for the largest delay bound with a certificate.

    For Theorem 1 the bound is bisected. For constant delays the bound is increased in steps. Each step is certified for
    every delay in it, so no window of unstable delays is missed. The search finds the end of the first stable window; a
    later window may be stable again.

    Parameters
    ----------
    low, high : float
        Bracket, s; it is determined automatically if it is 0 or not valid.
    width : float
        Relative width at which the search ends.
    tell : callable, optional
        Called with each certificate tried.

    Returns
    -------
    Certificate or None
        The last valid certificate. Its `shortest` is 0, or `low` if there is a certificate at `low` but none down to
        zero delay. None if there is no certificate even at a delay of 1e-6 of the system's fastest time.
    """

    def ask(h: float, shortest: float | None = None) -> Certificate:
        result = certify(system, h, criterion, shortest=shortest, sliding=False)
        if tell is not None:
            tell(result)
        return result

    require_no_sliding(require_equilibrium(system), high or 1e-9)
    fast = _fast_time(system)
    begin = low or high or fast
    while not (best := ask(begin, 0.0)).valid:
        begin /= 2.0
        if begin < 1e-6 * fast:
            break
    if not best.valid and (criterion.method == "theorem1" or not low or not (best := ask(low)).valid):
        return None
    search = _walk if criterion.method == "constant" else _bisect
    end = search(ask, best, max(high - best.h, best.h), width, 1e9 * fast)
    require_no_sliding(require_equilibrium(system), end.h)
    return end


def _walk(ask: Callable[..., Certificate], best: Certificate, step: float, width: float, most: float) -> Certificate:
    """Step up from a certificate by certified steps, halving a step that has none.

    The largest step that can be certified is a third to a half of the remaining distance: it ends at a tenth of
    `width`.
    """
    shortest, failed = best.shortest, False
    # As long as other floats lie in between.
    while step > max(0.1 * width * best.h, 2.0 * math.ulp(best.h)) and best.h < most:
        result = ask(best.h + step, best.h)
        if result.valid:
            best = result
        failed = failed or not result.valid
        step *= 0.5 if not result.valid else 1.0 if failed else 2.0
    return best._replace(shortest=shortest)


def _bisect(ask: Callable[..., Certificate], best: Certificate, step: float, width: float, most: float) -> Certificate:
    """Double the delay until there is no certificate, then halve the gap."""
    high = best.h + step
    while (above := ask(high)).valid:
        best, high = above, 2.0 * high
        if high > most:
            return best  # stable for every delay, as far as that can be told
    while high - best.h > max(width * best.h, 2.0 * math.ulp(high)):
        middle = 0.5 * (best.h + high)
        if (result := ask(middle)).valid:
            best = result
        else:
            high = middle
    return best


def _fast_time(system: PwaSystem) -> float:

    return 1.0 / max(
        float(np.linalg.norm(A, 2) + np.linalg.norm(Ad, 2)) for A, Ad in zip(system.A, system.Ad, strict=True)
    )
