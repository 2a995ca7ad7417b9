r"""Direct collocation: states and controls as unknowns of a nonlinear program, solved by an interior-point method.

On each of N intervals the state is the polynomial of degree d through its start and d Legendre points, at which it
satisfies the equations; the control is free at the same points (a polynomial of degree d - 1), the cost is Gauss'
quadrature. Costates at the ends of the intervals are the multipliers of the continuity conditions.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from softrig_core import Array

    from ..problem import Problem


class Collocated(NamedTuple):
    """A solution."""

    rows: Array
    """(states + costates + controls, samples) at equidistant times from 0 to T"""

    J: float
    alpha: Array
    """(states,) costate at t = 0"""

    residual: float
    """Largest T abs(dx/dt - f) between the collocation points, relative to the largest state."""

    end_error: float
    iterations: int
    success: bool
    reason: str


class _Grid(NamedTuple):
    solver: Any
    slopes: Any
    tau: Array
    intervals: int


_PROGRAMS: dict[tuple[object, ...], _Grid] = {}


def _program(problem: Problem, intervals: int, degree: int) -> _Grid:
    """Nonlinear program of a problem, with start and horizon as its parameters: set up once, solved often."""
    key = (*problem.key, problem.x_end, intervals, degree)
    if key not in _PROGRAMS:
        _PROGRAMS[key] = _set_up(problem, intervals, degree)
    return _PROGRAMS[key]


def _set_up(problem: Problem, intervals: int, degree: int) -> _Grid:
    import casadi as ca

    x, u, dx, L = problem.expressions()
    f = ca.Function("f", [x, u], [dx, L])
    n, m = x.numel(), u.numel()
    tau = np.concatenate([[0.0], ca.collocation_points(degree, "legendre")])
    C, D, B = ca.collocation_coeff(list(tau[1:]))
    start, T = ca.MX.sym("start", n), ca.MX.sym("T")
    X = [ca.MX.sym(f"X_{k}", n) for k in range(intervals + 1)]
    inner = [ca.MX.sym(f"Z_{k}", n, degree) for k in range(intervals)]
    U = [ca.MX.sym(f"U_{k}", m, degree) for k in range(intervals)]
    h = T / intervals
    J, g = ca.MX(0), [X[0] - start]
    for k in range(intervals):
        rate, running = f.map(degree)(inner[k], U[k])
        points = ca.horzcat(X[k], inner[k])
        g += [ca.vec(points @ C - h * rate), points @ D - X[k + 1]]
        J += h * (running @ B)
    if problem.x_end is not None:
        g.append(X[-1] - ca.DM(problem.x_end))
    unknowns = [X[0]]
    for k in range(intervals):
        unknowns += [ca.vec(inner[k]), ca.vec(U[k]), X[k + 1]]
    program: dict[str, Any] = {"x": ca.vertcat(*unknowns), "p": ca.vertcat(start, T), "f": J, "g": ca.vertcat(*g)}
    quiet: dict[str, Any] = {"print_level": 0, "sb": "yes", "tol": 1e-11, "constr_viol_tol": 1e-13, "max_iter": 200}
    solver = ca.nlpsol("collocation", "ipopt", program, {"print_time": False, "ipopt": quiet})
    return _Grid(solver, f, tau, intervals)


def solve(
    problem: Problem,
    *,
    intervals: int = 20,
    degree: int = 3,
    samples: int = 101,
    guess: Callable[[Array], Array] | None = None,
) -> Collocated:
    """Solve a problem by direct collocation.

    Parameters
    ----------
    intervals, degree : int
        Intervals of equal length, and Legendre points in each.
    samples : int
        Columns of the answer.
    guess : callable, optional
        Times as fractions of the horizon, (k,), to states and controls (states + controls, k), for a warm start; a
        straight line from start to end when absent.
    """
    from scipy.interpolate import BarycentricInterpolator, CubicSpline

    grid = _program(problem, intervals, degree)
    n, m = len(problem.states), len(problem.controls)
    x0 = np.array(problem.x0)
    block = (n + m) * degree + n
    times = (np.arange(intervals)[:, None] + grid.tau[1:]) / intervals
    ends = np.arange(intervals + 1) / intervals
    if guess is None:
        end = x0 if problem.x_end is None else np.array(problem.x_end)

        def guess(s: Array) -> Array:
            return np.vstack([x0[:, None] + (end - x0)[:, None] * s, np.zeros((m, s.size))])

    first, joints = guess(times.ravel()), guess(ends)
    w = [joints[:n, 0]]
    for k in range(intervals):
        chunk = first[:, k * degree : (k + 1) * degree]
        w += [chunk[:n].ravel(order="F"), chunk[n:].ravel(order="F"), joints[:n, k + 1]]
    result = grid.solver(x0=np.concatenate(w), p=[*x0, problem.horizon], lbg=0.0, ubg=0.0)
    status = grid.solver.stats()
    w_star, multipliers = np.array(result["x"]).ravel(), np.array(result["lam_g"]).ravel()
    xs, us, costates = np.empty((intervals, degree + 1, n)), np.empty((intervals, degree, m)), [-multipliers[:n]]
    end_x = w_star[:n]
    for k in range(intervals):
        chunk = w_star[n + k * block : n + (k + 1) * block]
        xs[k] = np.vstack([end_x, chunk[: n * degree].reshape(degree, n)])
        us[k] = chunk[n * degree : (n + m) * degree].reshape(degree, m)
        end_x = chunk[(n + m) * degree :]
        offset = n + k * (n * degree + n) + n * degree
        costates.append(multipliers[offset : offset + n])
    s = np.linspace(0.0, 1.0, samples)
    rows = np.empty((2 * n + m, samples))
    rows[n : 2 * n] = CubicSpline(ends, np.array(costates))(s).T
    interval = np.minimum((s * intervals + 1e-12).astype(int), intervals - 1)
    residual, middle = 0.0, 0.5 * (grid.tau[1:] + grid.tau[:-1])
    for k in range(intervals):
        x_k, u_k = BarycentricInterpolator(grid.tau, xs[k]), BarycentricInterpolator(grid.tau[1:], us[k])
        pick = np.flatnonzero(interval == k)
        rows[:n, pick], rows[2 * n :, pick] = (
            x_k(s[pick] * intervals - k).T,
            u_k(s[pick] * intervals - k).T,
        )
        rate = np.array(grid.slopes.map(middle.size)(x_k(middle).T, u_k(middle).T)[0]).T
        residual = max(residual, float(np.abs(x_k.derivative(middle) * intervals / problem.horizon - rate).max()))
    rows[:n, -1] = end_x
    size = max(float(np.abs(xs).max()), np.finfo(float).tiny)
    missed = problem.end_error(np.concatenate([end_x, costates[-1]])) if problem.x_end is not None else np.zeros(n)
    residual *= problem.horizon / size
    end_error = float(np.abs(missed).max())
    return Collocated(
        rows,
        float(result["f"]),
        costates[0],
        residual,
        end_error,
        int(status["iter_count"]),
        bool(status["success"]),
        str(status["return_status"]),
    )


def sampled(rows: Array, horizon: float, later: float, n: int) -> Callable[[Array], Array]:
    """Create a guess for the rest of the horizon, `later` s from now, from the rows of a plan for all of it."""
    from scipy.interpolate import CubicSpline

    spline = CubicSpline(np.linspace(0.0, 1.0, rows.shape[1]), np.delete(rows, np.s_[n : 2 * n], axis=0), axis=1)
    return lambda s: np.asarray(spline(1.0 - (1.0 - s) * later / horizon))
