"""GPC in closed form."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from softrig_core.kit import dense

from ..discretise import Matrix, matmul
from .carima import Carima, add, multiply, predict


@dataclass(frozen=True)
class Tuning:
    """Horizons and weight.

    Parameters
    ----------
    first : int
        N1, first predicted sample that counts.
    horizon : int
        Np, last one.
    moves : int
        Nc, number of future moves.
    weight : float
        lambda of the cost sum (y - w)^2 + lambda sum (Delta u)^2.

    Raises
    ------
    ValueError
        Not 1 <= N1 <= Np, not 1 <= Nc <= Np, or a negative weight.
    """

    first: int = 1
    horizon: int = 11
    moves: int = 2
    weight: float = 1.0

    def __post_init__(self) -> None:
        if not 1 <= self.first <= self.horizon:
            raise ValueError(f"N1 = {self.first}, Np = {self.horizon}: expected 1 <= N1 <= Np")
        if not 1 <= self.moves <= self.horizon:
            raise ValueError(f"Nc = {self.moves}, Np = {self.horizon}: expected 1 <= Nc <= Np")
        if not 0.0 <= self.weight < math.inf:
            raise ValueError(f"lambda = {self.weight}: expected a finite number, not negative")


class GpcState(NamedTuple):
    """The acting command, y(t), y(t-1), ... and Delta u(t-1), Delta u(t-2), ... as far as the model looks back."""

    u: float
    y: tuple[float, ...]
    moves: tuple[float, ...]


class Gpc:
    """Generalised predictive control of a CARIMA model; its state is a `GpcState`.

    With the free response f_j = F_j y(t) + H_j Delta u(t-1) and a constant set point w, the moves that minimise
    |G U + f - w|^2 + lambda |U|^2 (paper eqs (22) to (28)) are::

        U = (G' G + lambda I)^-1 G' (w - f)

    of which the first is applied. All terms except y, w and the past moves are known in advance, so G' (w - f) is
    stored as three small matrices that act on them.

    Raises
    ------
    ValueError
        G' G + lambda I is singular.

    Notes
    -----
    The caller passes the command that was really applied (`applied`). A clipped command enters the past moves in
    its clipped form; no further anti-windup is needed.
    """

    def __init__(self, model: Carima, tuning: Tuning) -> None:
        self.model, self.tuning = model, tuning
        g, f, h = predict(model, tuning.first, tuning.horizon, tuning.moves)
        transposed = tuple(zip(*g, strict=True))
        squares = matmul(transposed, g)
        self.hessian: Matrix = tuple(
            tuple(x + tuning.weight * (i == j) for j, x in enumerate(row)) for i, row in enumerate(squares)
        )
        # G' 1, the factor of w: the set point is constant over the horizon.
        self._pull = tuple(dense.total(row) for row in transposed)
        self._outputs = matmul(transposed, f)
        self._past = matmul(transposed, h) if h[0] else ((),) * tuning.moves
        inverse = invert(self.hessian)
        first = (inverse[0],)
        self.pull = matmul(first, tuple((x,) for x in self._pull))[0][0]
        self.outputs = matmul(first, self._outputs)[0]
        self.past = matmul(first, self._past)[0] if h[0] else ()

    def first(self, y: float, u: float) -> GpcState:
        """Return a state without a bump, as if y had been measured and u applied forever."""
        return GpcState(u, (y,) * len(self.outputs), (0.0,) * len(self.past))

    def measure(self, x: GpcState, y: float) -> GpcState:
        """Store the measurement y(t)."""
        return GpcState(x.u, (y, *x.y[:-1]), x.moves)

    def move(self, x: GpcState, w: float) -> float:
        """Return the first move Delta u(t) of the closed form for the set point w."""
        result = self.pull * w
        for k, y in zip(self.outputs, x.y, strict=True):
            result -= k * y
        for k, d in zip(self.past, x.moves, strict=True):
            result -= k * d
        return result

    def gradient(self, x: GpcState, w: float) -> list[float]:
        """Return -G' (w - f), the linear term of the cost 1/2 U' H U + q' U with H = `hessian` (halved cost)."""
        result = []
        for pull, outputs, past in zip(self._pull, self._outputs, self._past, strict=True):
            total = -pull * w
            for k, y in zip(outputs, x.y, strict=True):
                total += k * y
            for k, d in zip(past, x.moves, strict=True):
                total += k * d
            result.append(total)
        return result

    def applied(self, x: GpcState, u: float) -> GpcState:
        """Note the command that really acts from t on."""
        return GpcState(u, x.y, (u - x.u, *x.moves[:-1]) if x.moves else ())

    def poles(self) -> list[complex]:
        """Return the closed loop's poles in z, with the model as its plant.

        The law is R Delta u = pull w - S y with R = 1 + z^-1 past, S = outputs; with A y = z^-1 B u the characteristic
        polynomial is R A Delta + z^-1 B S.
        """
        import numpy as np

        r = add((1.0,), self.past, 1)
        characteristic = add(multiply(multiply(r, self.model.a), (1.0, -1.0)), multiply(self.model.b, self.outputs), 1)
        return [complex(z) for z in np.roots(characteristic)]


def invert(m: Sequence[Sequence[float]]) -> Matrix:
    """Invert a small symmetric positive definite matrix by Gauss and Jordan with pivots on the diagonal.

    Raises
    ------
    ValueError
        A pivot is lost: the matrix is singular to working accuracy.
    """
    n = len(m)
    rows = [[*map(float, row), *(float(i == j) for j in range(n))] for i, row in enumerate(m)]
    for k in range(n):
        pivot = rows[k][k]
        # A pivot this small beside its diagonal entry consists of rounding errors.
        if not pivot > 1e-13 * m[k][k]:
            raise ValueError("G' G + lambda I is singular: expected lambda > 0, or fewer moves Nc")
        rows[k] = [x / pivot for x in rows[k]]
        for i in range(n):
            if i != k:
                factor = rows[i][k]
                rows[i] = [x - factor * y for x, y in zip(rows[i], rows[k], strict=True)]
    return tuple(tuple(row[n:]) for row in rows)
