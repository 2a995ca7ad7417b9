"""Full state feedback with an integrator: design by pole placement, and the sampled law with anti-windup."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from softrig_core.kit import exact

Matrix = Sequence[Sequence[float]]
# Largest error of a coefficient of the loop's characteristic polynomial, relative to its size. A rank of the
# controllability matrix would depend on the units of the states, so the polynomial itself is checked.
PLACED = 1e-6


class UnstableDesign(ValueError):
    """The nominal closed loop has poles that are not in the open left half plane; the text names them."""


class Gains(NamedTuple):
    """u = -k x + ki xi, xi' = r - y."""

    k: tuple[float, ...]
    ki: float


def place(a: Matrix, b: Sequence[float], c: Sequence[float], poles: Sequence[complex]) -> Gains:
    """Compute gains that place the poles of the loop x' = A x + B u, y = C x, xi' = r - y.

    Ackermann's formula on the augmented plant [[A, 0], [-C, 0]], [B; 0]. The characteristic polynomial of the loop is
    compared with the wanted one in integer arithmetic.

    Parameters
    ----------
    a : (n, n) nested sequence
    b, c : (n,) sequence
        One input, one output.
    poles : (n + 1,) sequence of complex
        In 1/s; complex ones in conjugate pairs.

    Raises
    ------
    UnstableDesign
        A wanted pole has a real part >= 0.
    ValueError
        Wrong number of poles, a complex one without its conjugate, or the augmented plant is not controllable: the
        loop would not have the wanted poles.

    Examples
    --------
    >>> place([[-5.26, 0], [1, 0]], [2.2862, 0], [0, 1], [-3, -6, -9]).ki
    70.8599...
    """
    import numpy as np
    from softrig_core.kit import dense

    n = len(b)
    if len(poles) != n + 1:
        raise ValueError(f"{len(poles)} poles, expected {n + 1} for {n} states and the integrator")
    require_stable(poles)
    wanted = [1.0 + 0.0j]  # coefficients of the product of all (s - pole)
    for pole in poles:
        wanted = [up - pole * down for up, down in zip([*wanted, 0.0j], [0.0j, *wanted], strict=True)]
    # For conjugate pairs the coefficients are real up to rounding.
    if max(abs(w.imag) for w in wanted) > 1e-9 * max(map(abs, wanted)):
        raise ValueError(f"poles {_names(poles)}: complex ones must come in conjugate pairs")
    augmented = np.zeros((n + 1, n + 1))
    augmented[:n, :n] = a
    augmented[n, :n] = -np.asarray(c, dtype=float)
    columns = [np.append(np.asarray(b, dtype=float), 0.0)]
    for _ in range(n):
        columns.append(dense.product(augmented, columns[-1]))
    reach = np.column_stack(columns)
    character = np.zeros_like(augmented)
    for coefficient in wanted:
        character = dense.product(character, augmented) + coefficient.real * np.eye(n + 1)
    try:
        k = dense.solve(reach, character)[-1].tolist()
    except np.linalg.LinAlgError:
        k = None
    if k is None or not _has_poles(augmented.tolist(), columns[0].tolist(), k, [w.real for w in wanted], poles):
        raise ValueError("the plant with its integrator is not controllable from this input")
    return Gains(tuple(k[:n]), -k[n])


def _has_poles(
    a: Matrix, b: Sequence[float], k: Sequence[float], wanted: Sequence[float], poles: Sequence[complex]
) -> bool:
    """Return whether A - b k has the wanted characteristic polynomial, relative to one whose poles are as large."""
    if not all(map(math.isfinite, k)):
        return False
    rows, (column,), (gains,) = exact.fractions(a), exact.fractions((b,)), exact.fractions((k,))
    loop = [[x - bi * kj for x, kj in zip(row, gains, strict=True)] for row, bi in zip(rows, column, strict=True)]
    sizes = [1.0]
    for pole in poles:
        sizes = [up + abs(pole) * down for up, down in zip([*sizes, 0.0], [0.0, *sizes], strict=True)]
    try:
        result = exact.characteristic(loop)
    except ArithmeticError:
        return False
    return all(abs(x - w) <= PLACED * size for x, w, size in zip(result, wanted, sizes, strict=True))


def closed_loop_poles(
    a: Matrix, b: Sequence[float], c: Sequence[float], k: Sequence[float], ki: float | None
) -> tuple[complex, ...]:
    """Poles of the continuous loop, 1/s, by rising real part; `ki` None: without integrator.

    Parameters
    ----------
    a : (n, n) nested sequence
        System matrix of x' = A x + B u.
    b : (n,) sequence of float
        Its one input.
    c : (n,) sequence of float
        Output y = C x that the integrator follows.
    k : (n,) sequence of float
        Feedback u = -K x + ki z.
    ki : float or None
        Gain of the integrator z' = r - y; None without.
    """
    import numpy as np

    loop = np.asarray(a, dtype=float) - np.outer(b, k)
    if ki is not None:
        below = np.append(-np.asarray(c, dtype=float), 0.0)
        loop = np.vstack([np.column_stack([loop, ki * np.asarray(b, dtype=float)]), below])
    result = np.linalg.eigvals(loop)
    return tuple(sorted((complex(p) for p in result), key=lambda p: (p.real, p.imag)))


def require_stable(poles: Sequence[complex]) -> None:
    """Refuse poles on or right of the imaginary axis.

    Raises
    ------
    UnstableDesign
        Names all the poles, the unstable ones first.
    """
    # An eigenvalue routine returns a pole at zero as a few rounding errors of the largest pole.
    edge = -1e-12 * max((abs(p) for p in poles), default=0.0)
    if bad := [p for p in poles if not complex(p).real < edge]:
        raise UnstableDesign(f"the closed loop is not stable: pole {_names(bad)} among {_names(poles)} 1/s")


def _names(poles: Sequence[complex]) -> str:
    return ", ".join(f"{p:.6g}" if p.imag else f"{p.real:.6g}" for p in map(complex, poles))


class StateFeedback:
    """The sampled law u = sat(kr r - K x + ki xi), then xi += (r - y) dt; it remembers xi.

    Parameters
    ----------
    k : (n,) sequence of float
        State gains.
    ki : float
        Integrator gain; 0 without integrator.
    dt : float
        Period, s.
    limit : float
        Actuator limit: |u| <= limit.
    kr : float
        Gain of the reference, for a law without integrator.
    anti_windup : bool
        Conditional integration: xi holds while u is saturated and the error would drive it further into the limit,
        (u_sat - u) (r - y) < 0; > 0 where ki < 0.
    """

    def __init__(
        self, k: Sequence[float], ki: float, dt: float, limit: float, *, kr: float = 0.0, anti_windup: bool = False
    ) -> None:
        self._k = tuple(k)
        self._ki = ki
        self._acts = -1.0 if ki < 0.0 else 1.0
        self._kr = kr
        self._dt = dt
        self._limit = limit
        self._anti_windup = anti_windup

    def settle(self, x: Sequence[float], r: float = 0.0) -> float:
        """Return the integral xi with which the command at state x is zero: a start without a bump."""
        return -self._unlimited(0.0, r, x) / self._ki if self._ki else 0.0

    def go_on(self, xi: float, before: StateFeedback, x: Sequence[float], r: float = 0.0) -> float:
        """Return the integral that follows a law with other gains without a bump: the command at x and r stays.

        The integral absorbs the difference; without an integral the command jumps with the gains.
        """
        if self._ki and (self._ki, self._k) != (before._ki, before._k):
            return (before._unlimited(xi, r, x) - (self._unlimited(xi, r, x) - self._ki * xi)) / self._ki
        return xi

    def __call__(self, xi: float, r: float, x: Sequence[float], y: float) -> tuple[float, float]:
        """Return the integral after this period and its saturated command.

        Parameters
        ----------
        xi : float
            Integral of r - y so far.
        r, y : float
            Reference and output.
        x : (n,) sequence of float
            State.
        """
        u = self._unlimited(xi, r, x)
        limited = min(max(u, -self._limit), self._limit)
        error = r - y
        if not (self._anti_windup and (limited - u) * self._acts * error < 0.0):
            xi += error * self._dt
        return xi, limited

    def _unlimited(self, xi: float, r: float, x: Sequence[float]) -> float:
        u = self._kr * r + self._ki * xi
        for gain, state in zip(self._k, x, strict=True):
            u -= gain * state
        return u
