"""Steady-state Kalman filter of a small linear system, in plain floats."""

from __future__ import annotations

from collections.abc import Sequence

from .discretise import Matrix, matmul


def steady_kalman_gain(
    a: Sequence[Sequence[float]], c: Sequence[Sequence[float]], q: Sequence[float], r: Sequence[float]
) -> Matrix:
    """Gain K of the measurement update x = x- + K (y - C x-) once the covariance no longer changes.

    The covariance before a measurement solves `riccati` with the transposed of A, C^T R^-1 C and Q.

    Parameters
    ----------
    a : (n, n) nested sequence
        Sampled system matrix.
    c : (m, n) nested sequence
        Measurement matrix.
    q : sequence of n floats
        Variances of the process noise of one step.
    r : sequence of m floats
        Variances of the measurement noise.

    Raises
    ------
    numpy.linalg.LinAlgError
        No steady filter exists (a state that is neither measured nor stable).
    """
    import numpy as np
    from softrig_core.kit.dense import product, solve

    from .riccati import riccati

    C = np.array(c, dtype=float)
    H = riccati(np.transpose(a), product(C.T / np.array(r, dtype=float), C), np.diag(np.array(q, dtype=float)))
    if H is None:
        raise np.linalg.LinAlgError("no steady filter: a state is neither measured nor stable")
    CH = product(C, H)
    K = solve(product(CH, C.T) + np.diag(r), CH).T
    return tuple(tuple(map(float, row)) for row in K)


class SteadyKalman:
    """Kalman filter with the steady gain, one predict and update a sample.

    x_k = (I - K C)(A x_(k-1) + B u_(k-1)) + K y_k

    Parameters
    ----------
    a, b, c : nested sequences of shapes (n, n), (n, p), (m, n)
        Sampled system.
    q, r : sequences of n and m floats
        Variances of process (per step) and measurement noise.
    """

    def __init__(
        self,
        a: Sequence[Sequence[float]],
        b: Sequence[Sequence[float]],
        c: Sequence[Sequence[float]],
        q: Sequence[float],
        r: Sequence[float],
    ) -> None:
        n = range(len(a))
        gain = steady_kalman_gain(a, c, q, r)
        kc = matmul(gain, c)
        keep = [[float(i == j) - kc[i][j] for j in n] for i in n]
        # One matrix for the whole step, x_k = M (x_(k-1), u_(k-1), y_k), so that a sample is one product.
        self._rows = [
            (*row_a, *row_b, *row_k) for row_a, row_b, row_k in zip(matmul(keep, a), matmul(keep, b), gain, strict=True)
        ]

    def first(self) -> tuple[float, ...]:
        """Return the estimate zero."""
        return (0.0,) * len(self._rows)

    def __call__(self, x: Sequence[float], u: Sequence[float], y: Sequence[float]) -> tuple[float, ...]:
        """Return the estimate of x_k.

        Parameters
        ----------
        x : sequence of float
            Estimate of x_(k-1).
        u : sequence of float
            Input u_(k-1), held since the last sample.
        y : sequence of float
            Measurement y_k.

        Raises
        ------
        ValueError
            Wrong number of inputs or measurements.
        """
        known = (*x, *u, *y)
        results = []
        for row in self._rows:
            total = 0.0
            for m, z in zip(row, known, strict=True):
                total += m * z
            results.append(total)
        return tuple(results)
