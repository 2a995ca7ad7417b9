"""Dual-mode certificate: a terminal cost and feedback under which the predicted cost falls for ever."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from softrig_core import Array

from .carima import Carima

STRICT = 1e-9  # share of the largest entry below which a number counts as zero


class Certificate(NamedTuple):
    """A check of K and Qbar against x(k+1) = A x + B u, u = K x.

    Attributes
    ----------
    gain : (1, n)
        K.
    terminal : (n, n)
        Qbar.
    moduli : (n,)
        |eig(A + B K)|, falling.
    definite : float
        Smallest eigenvalue of Qbar (of its symmetric part).
    residual : float
        Largest entry of |Qbar - (A + B K)' Qbar (A + B K) - Q - K' R K|.
    decrease : float
        Smallest eigenvalue of Qbar - (A + B K)' Qbar (A + B K) - K' R K - Q; not negative when V = x' Qbar x falls
        at least by the stage cost.
    """

    gain: Array
    terminal: Array
    moduli: Array
    definite: float
    residual: float
    decrease: float

    @property
    def valid(self) -> bool:
        """Return whether A + B K is stable, Qbar > 0 and V falls at least by the stage cost."""
        size = max(1.0, float(np.abs(self.terminal).max()))
        return bool(self.moduli[0] < 1.0 and self.definite > STRICT * size and self.decrease > -STRICT * size)


def companion(model: Carima) -> tuple[Array, Array, Array]:
    """Return A, B, C with y = C x and the characteristic polynomial in the first row of A (the form of paper eq. (29)).

    A (n, n), B (n, 1), C (1, n); n is the degree of A(z), or the length of B(z) if that is longer.
    """
    n = max(len(model.a) - 1, len(model.b))
    a = np.zeros((n, n))
    a[0, : len(model.a) - 1] = np.negative(model.a[1:])
    a[1:, :-1] += np.eye(n - 1)
    c = np.zeros((1, n))
    c[0, : len(model.b)] = model.b
    b = np.zeros((n, 1))
    b[0, 0] = 1.0
    return a, b, c


def assess(a: ArrayLike, b: ArrayLike, gain: ArrayLike, terminal: ArrayLike, q: ArrayLike, r: float) -> Certificate:
    """Hold K and Qbar against the corrected equation (32), u = K x.

    ::

        Qbar - (A + B K)' Qbar (A + B K) = Q + K' R K          (>= for a bound)

    Parameters
    ----------
    a, b : (n, n), (n, 1)
    gain : (1, n)
        K.
    terminal : (n, n)
        Qbar.
    q : (n, n)
    """
    a, b, k, p, q = (np.atleast_2d(np.asarray(m, dtype=float)) for m in (a, b, gain, terminal, q))
    closed = a + b @ k
    left = p - closed.T @ p @ closed - q - r * k.T @ k
    return Certificate(
        gain=k,
        terminal=p,
        moduli=np.sort(np.abs(np.linalg.eigvals(closed)))[::-1],
        definite=float(np.min(np.linalg.eigvalsh((p + p.T) / 2.0))),
        residual=float(np.abs(left).max()),
        decrease=float(np.min(np.linalg.eigvalsh((left + left.T) / 2.0))),
    )


def certify(model: Carima, r: float = 1.0, q: float = 1.0) -> Certificate:
    """Solve the Riccati equation for Q = q C'C and check its answer by `check`.

    Parameters
    ----------
    r, q : float
        Weights of u and y, positive.

    Raises
    ------
    numpy.linalg.LinAlgError
        The model cannot be stabilised.
    """
    from scipy.linalg import solve_discrete_are

    a, b, c = companion(model)
    weight = q * c.T @ c
    terminal = solve_discrete_are(a, b, weight, np.array([[r]]))
    gain = -np.linalg.solve(r + b.T @ terminal @ b, b.T @ terminal @ a)
    return assess(a, b, gain, terminal, weight, r)
