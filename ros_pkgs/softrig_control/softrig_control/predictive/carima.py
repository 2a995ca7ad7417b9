"""The CARIMA model A(z) y(t) = B(z) u(t-1) + xi(t)/Delta and what it predicts.

Plain floats, no BLAS: these numbers decide every bit of a run (see `softrig_control.discretise`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import NamedTuple

from softrig_core.kit.dense import total

from ..discretise import Matrix, matmul
from ..transfer import ACCURACY, Exact, Sampled, off, sampled_exactly

Polynomial = tuple[float, ...]  # coefficients of z^0, z^-1, z^-2, ...
# A step response with a smaller error is as good as coefficients in floats can be. These coefficients are then kept,
# and with them the bits of golden bags.
BEST = 1e-12


@dataclass(frozen=True)
class Carima:
    """A sampled model: ``y(t) = -a1 y(t-1) - a2 y(t-2) - ... + b0 u(t-1) + b1 u(t-2) + ...``.

    Parameters
    ----------
    a : tuple of float
        A(z) = 1 + a1 z^-1 + a2 z^-2 + ..., monic.
    b : tuple of float
        B(z) = b0 + b1 z^-1 + ..., acting on u(t-1); a leading zero is one more period of dead time.

    Raises
    ------
    ValueError
        A is empty or not monic, B has no coefficient other than zero, or a number is not finite.
    """

    a: Polynomial
    b: Polynomial

    def __post_init__(self) -> None:
        if not self.a or self.a[0] != 1.0:
            raise ValueError(f"a = {list(self.a)}: expected 1 as its first coefficient")
        if not any(self.b):
            raise ValueError(f"b = {list(self.b)}: expected a coefficient other than zero")
        if not all(map(math.isfinite, (*self.a, *self.b))):
            raise ValueError(f"a = {list(self.a)}, b = {list(self.b)}: expected finite numbers")

    @classmethod
    def from_state_space(cls, a: Matrix, b: Matrix, c: Sequence[float]) -> Carima:
        """Return the transfer function of x(t+1) = A x(t) + B u(t), y = C x of one input.

        Parameters
        ----------
        a : (n, n) nested sequence
            System matrix.
        b : (n, 1) nested sequence
            Input column.
        c : (n,) sequence of float
            Output row.

        Raises
        ------
        ValueError
            The step response of the difference equation is off by more than 1e-9: its order is too high for poles so
            near to each other.
        """
        return cls._checked(Sampled(a, b, tuple(c)), Exact.discrete(a, b, c))

    @classmethod
    def from_continuous(cls, num: Sequence[float], den: Sequence[float], period: float) -> Carima:
        """Sample a transfer function num(s)/den(s), highest power first, with u held over each period.

        Parameters
        ----------
        num, den : sequence of float
            Coefficients, highest power first.
        period : float
            s.

        Raises
        ------
        ValueError
            As `sample_transfer_function` and `from_state_space`.
        """
        return cls._checked(*sampled_exactly(tuple(num), tuple(den), period))

    @classmethod
    def _checked(cls, system: Sampled, right: Exact) -> Carima:
        wanted = right.step_response()
        result = cls(*_polynomials(system))
        if off(result.step_response(len(wanted)), wanted) <= BEST:
            return result
        result = cls(*right.polynomials())
        error = off(result.step_response(len(wanted)), wanted)
        if error <= ACCURACY:
            return result
        raise ValueError(
            f"the step response of the difference equation of order {len(system.a)} would be off by {error:.1g} of its "
            f"largest value, expected at most {ACCURACY:g}: its poles are too near to each other for a polynomial; "
            "choose a longer period or a model of lower order"
        )

    def step_response(self, samples: int) -> list[float]:
        """Compute y(1), y(2), ... after u = 1 from t = 0 on, from rest, without xi."""
        result: list[float] = []
        for k in range(samples):
            y = total(self.b[: k + 1])
            for i, a in enumerate(self.a[1 : k + 1], 1):
                y -= a * result[k - i]
            result.append(y)
        return result


def _polynomials(system: Sampled) -> tuple[Polynomial, Polynomial]:
    """Compute A(z) and B(z) in floats, as `Exact.polynomials` does without rounding."""
    a, x, c = system
    n = len(a)
    characteristic = [1.0]
    m: Matrix = tuple(tuple(float(i == j) for j in range(n)) for i in range(n))
    for k in range(1, n + 1):
        product = matmul(a, m)
        characteristic.append(-total(product[i][i] for i in range(n)) / k)
        m = tuple(tuple(product[i][j] + characteristic[k] * (i == j) for j in range(n)) for i in range(n))
    markov = []
    for _ in range(n):
        markov.append(matmul((c,), x)[0][0])
        x = matmul(a, x)
    return tuple(characteristic), multiply(characteristic, markov)[:n]


class Prediction(NamedTuple):
    """y(t+j) = sum over G of future moves + F over past outputs + H over past moves; one row for j = N1 ... Np.

    Attributes
    ----------
    g : (N, Nc)
        Step matrix: coefficients of Delta u(t), Delta u(t+1), ...
    f : (N, na + 1)
        Coefficients of y(t), y(t-1), ...
    h : (N, nb)
        Coefficients of Delta u(t-1), Delta u(t-2), ...
    """

    g: Matrix
    f: Matrix
    h: Matrix


def multiply(p: Sequence[float], q: Sequence[float]) -> Polynomial:
    """Product of two polynomials in z^-1.

    Parameters
    ----------
    p, q : sequence of float
        Coefficients of z^0, z^-1, ...
    """
    result = [0.0] * (len(p) + len(q) - 1)
    for i, x in enumerate(p):
        for j, y in enumerate(q):
            result[i + j] += x * y
    return tuple(result)


def add(p: Sequence[float], q: Sequence[float], shift: int = 0) -> Polynomial:
    """Sum p + z^-shift q.

    Parameters
    ----------
    p, q : sequence of float
        Coefficients of z^0, z^-1, ...
    shift : int
        Number of samples by which q is late.
    """
    return tuple(x + y for x, y in zip_longest(p, (*(0.0,) * shift, *q), fillvalue=0.0))


def diophantine(a: Sequence[float], horizon: int) -> list[tuple[Polynomial, Polynomial]]:
    """Solve 1 = E_j(z) A(z) Delta + z^-j F_j(z) for j = 1 ... horizon by recursion.

    ::

        E_1 = 1,  F_1 = z (1 - A Delta)
        e_j = f_(j,0),  E_(j+1) = E_j + e_j z^-j,  F_(j+1) = z (F_j - e_j A Delta)

    Parameters
    ----------
    a : sequence of float
        Monic A(z).

    Returns
    -------
    list of (E_j, F_j)
        E_j of degree j - 1, F_j of the degree of A.

    References
    ----------
    Clarke, Mohtadi, Tuffs: Generalized predictive control, part I, Automatica 23(2), 1987.
    """
    a_delta = multiply(a, (1.0, -1.0))
    e: Polynomial = (1.0,)
    f = tuple(-x for x in a_delta[1:])
    result = [(e, f)]
    for _ in range(horizon - 1):
        lead = f[0]
        e = (*e, lead)
        f = tuple(x - lead * y for x, y in zip((*f[1:], 0.0), a_delta[1:], strict=True))
        result.append((e, f))
    return result


def predict(model: Carima, first: int, horizon: int, moves: int) -> Prediction:
    """Build the prediction of y(t+first) ... y(t+horizon) for `moves` future moves.

    E_j B = G_j + z^-j H_j splits each row into the part of the future moves and that of the past ones.

    Parameters
    ----------
    model : Carima
        A(z) y(t) = B(z) u(t-1) + xi(t)/Delta.
    first, horizon : int
        First and last sample predicted, counted from now.
    moves : int
        Number of future increments of u; later ones are zero.
    """
    nb = len(model.b) - 1
    g, f, h = [], [], []
    for j, (e_j, f_j) in enumerate(diophantine(model.a, horizon), 1):
        if j < first:
            continue
        product = multiply(e_j, model.b)
        g.append(tuple(product[j - 1 - i] if i < j else 0.0 for i in range(moves)))
        f.append(f_j)
        h.append(product[j : j + nb])
    return Prediction(tuple(g), tuple(f), tuple(h))
