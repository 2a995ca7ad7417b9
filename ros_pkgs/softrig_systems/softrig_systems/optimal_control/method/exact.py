"""Exactly known least costs, and a solver of the two-point boundary value problem to check all others."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ..problem import Problem


class Scalar(NamedTuple):
    """Exact answer of the scalar problem."""

    c: float
    alpha: float
    cost: float


def scalar(x_end: float, horizon: float = 1.0, x0: float = 0.0) -> Scalar:
    r"""Solve the scalar problem by quadrature.

    The Hamiltonian is constant along an extremal: :math:`\dot x^2 = c + f^2`, f = x^2 sin(x)/2, so
    :math:`\int_{x_0}^{x_T} dx / \sqrt{c + f^2} = T` fixes c; u = x' - f and alpha = -2 u(0).
    """
    from scipy.integrate import quad
    from scipy.optimize import brentq

    sign = 1.0 if x_end >= x0 else -1.0

    def f(x: float) -> float:
        return 0.5 * x * x * math.sin(x)

    def integral(function: object) -> float:
        return float(quad(function, x0, x_end, epsabs=1e-15, epsrel=1e-13)[0])

    def late(c: float) -> float:
        return sign * integral(lambda x: 1.0 / math.sqrt(c + f(x) ** 2)) - horizon

    c = float(brentq(late, 1e-9, 1e6, xtol=1e-16, rtol=1e-15))
    cost = sign * integral(lambda x: (sign * math.sqrt(c + f(x) ** 2) - f(x)) ** 2 / math.sqrt(c + f(x) ** 2))
    return Scalar(c, -2.0 * (sign * math.sqrt(c + f(x0) ** 2) - f(x0)), cost)


def scalar_cost(problem: Problem) -> float:
    """Least cost of the scalar problem."""
    assert problem.x_end is not None
    return scalar(problem.x_end[0], problem.horizon, problem.x0[0]).cost


def spacecraft_cost(problem: Problem, inertia: Sequence[float]) -> float:
    """Return the least cost |I w0|^2/(2T) of bringing a spacecraft to rest.

    The gyroscopic torque cannot change |h|, h = I w, so |u| integrates to at least |h0|; u = -h/(T - t) does it with
    constant |u|. It holds for every inertia, rate and horizon.
    """
    return float(np.sum((np.array(inertia) * problem.x0) ** 2)) / (2.0 * problem.horizon)


class Trajectory(NamedTuple):
    """An extremal over time."""

    t: NDArray[np.float64]
    """(points,) s"""

    z: NDArray[np.float64]
    """(2 n, points) states, then costates"""

    cost: float


def tpbvp(problem: Problem, tolerance: float = 1e-9, start: NDArray[np.float64] | None = None) -> Trajectory:
    """Solve Pontryagin's conditions as a two-point boundary value problem by scipy's collocation; the cost as a state.

    Parameters
    ----------
    start : ndarray, (2 n,), optional
        Costates and states held constant are the first guess when absent: those of a linear path.

    Raises
    ------
    RuntimeError
        It did not converge.
    """
    import casadi as ca
    from scipy.integrate import solve_bvp

    x, u, _, L = problem.expressions()
    n = x.numel()
    rate = ca.Function("rate", [x, u], [L])
    x0 = np.array(problem.x0)
    end = x0 if problem.x_end is None else np.array(problem.x_end)
    J = len(x0) * 2

    def slopes(s: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        F, control = problem.extremal.function(y[:J])
        return problem.horizon * np.vstack([np.array(F), np.array(rate(y[:n], control))])

    def ends(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.concatenate([a[:n] - x0, problem.end_error(b[:J]), [a[J]]])

    s = np.linspace(0.0, 1.0, 41)
    first = np.zeros((J + 1, s.size))
    first[:n] = x0[:, None] + (end - x0)[:, None] * s
    if start is not None:
        first[:J] = start[:, None]
    result = solve_bvp(slopes, ends, s, first, tol=tolerance, max_nodes=50_000)
    if result.status != 0:
        raise RuntimeError(f"boundary value problem of {problem.name}: {result.message}")
    return Trajectory(result.x * problem.horizon, result.y[:J], float(result.y[J, -1]))


def least_cost(problem: Problem) -> float:
    """Return the least cost: exactly if the problem has a closed form, else that of the boundary value problem."""
    return problem.exact(problem) if problem.exact is not None else tpbvp(problem).cost
