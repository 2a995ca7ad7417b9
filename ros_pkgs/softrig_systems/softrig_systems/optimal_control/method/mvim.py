r"""Modified variational iteration: Pontryagin's conditions as an initial value problem, solved by power series.

The paper's step is

.. math:: V_{n+1} = V_n - \int_0^t \{R(V_n - V_{n-1}) + (G_n - G_{n-1})\} d\tau, \quad V_{-1} = 0, \quad V_0 = V(0)

with :math:`G_n` the Maclaurin polynomial up to :math:`t^n` of the nonlinear term. (The inhomogeneous term "- g" of its
step (8) belongs to n = 0 only: as printed it would be added at every step.) :math:`V_n` is exactly the Maclaurin
polynomial of degree n of the solution, so it is computed by recursion on the coefficients, in scaled time s = t/T,
at a cost of n^2 a product. The initial costate alpha = lambda(0) follows from the end conditions by Newton's method;
the derivative of the polynomial with respect to alpha is the polynomial of the variational equations, so the Jacobian
is exact.

Beyond the radius of convergence the horizon is cut into stages of equal length, each with a polynomial of its own.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np
from softrig_core import jit
from softrig_core.kit import dense

from .quadrature import gauss_legendre
from .roots import Root, best, distinct
from .series import slope, value
from .tape import evaluate, expand

if TYPE_CHECKING:
    from collections.abc import Sequence

    from softrig_core import Array

    from ..problem import Problem
    from .tape import Tape


NEWTON = 40  # steps at most
HALVINGS = 12  # halvings of a step that increases the end error
SHARES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)  # shares of the horizon
AROUND = (-2.0, -1.0, 1.0, 2.0)  # places at which other roots are searched, in sizes of alpha
LOW = 3  # orders up to which all roots are looked for, ...
NEAR = 0.1  # ... when alpha changes by more than this from one to the next, of its size
JUMP = 0.5  # change of alpha from one order to the next, of its size, that is taken for the same branch
NODES, WEIGHTS = gauss_legendre(64)
GRID = np.linspace(0.0, 1.0, 65)
END = 1e-8  # end error allowed, of the size of the states


@dataclass
class Solution:
    """An extremal in polynomials, and how it was found.

    Parameters
    ----------
    coefficients : ndarray, (stages, states + costates + controls, order + 1)
        Of powers of s = (t - t_stage)/(T/stages).
    horizon : float
        T, s.
    alpha : ndarray, (states,)
        lambda(0).
    J : list of float
        Integral of the running cost along the polynomials, for each order from 1 on. It is not the cost of the plant,
        and it can lie below the true minimum.
    ratio : list of float
        abs(J_n - J_(n-1)) / abs(J_n); infinite at order 1.
    residual : list of float
        Largest T abs(dz/dt - F(z)), relative to the largest state or to the largest costate.
    state_residual : list of float
        Largest abs(dx/dt - f(x, u)), in the states' unit per s.
    end_error : float
        Largest violation of the end conditions.
    accurate : bool
        Whether the end error is within 1e-8 of the size of the states.
    converged : bool
        Sound rule: two ratios in a row below eps, and the residual below eps_res.
    seed_order : int
        Order at which the paper's rule (one ratio below eps) would have stopped; 0: at none so far.
    roots : dict of int to list of Root
        For the low orders at which several alphas meet the end conditions: all of them, the chosen one first.
    """

    coefficients: Array
    horizon: float
    order: int
    alpha: Array
    J: list[float] = field(default_factory=list)
    ratio: list[float] = field(default_factory=list)
    residual: list[float] = field(default_factory=list)
    state_residual: list[float] = field(default_factory=list)
    alphas: list[Array] = field(default_factory=list)
    end_error: float = np.inf
    accurate: bool = False
    converged: bool = False
    seed_order: int = 0
    roots: dict[int, list[Root]] = field(default_factory=dict)
    reason: str = ""

    def __call__(self, t: float) -> Array:
        """Values of states, costates and controls at t (s)."""
        return polynomials(self.coefficients, t / self.horizon)


def polynomials(coefficients: Array, s: float) -> Array:
    """Values of a plan of stages x variables x powers at s in [0, 1] of its horizon."""
    stages = coefficients.shape[0]
    stage = min(max(int(s * stages), 0), stages - 1)
    local = s * stages - stage
    return np.array([value(row, local) for row in coefficients[stage]])


@jit
def chain(tape: Tape, start: Array, T: float, stages: int, z: Array, more: Array) -> None:
    """Expand stage after stage, each from where the one before ends; z (stages, n, k), more (stages, m, k)."""
    for stage in range(stages):
        for i in range(start.shape[0]):
            z[stage, i, 0] = start[i] if stage == 0 else value(z[stage - 1, i], 1.0)
        expand(tape, z[stage], more[stage], T / stages)


@jit
def sample(z: Array, grid: Array, values: Array, slopes: Array) -> None:
    """Values and derivatives (by s) of polynomials z (n, k) on a grid, into (points, n) each."""
    for p in range(grid.shape[0]):
        for i in range(z.shape[0]):
            values[p, i] = value(z[i], grid[p])
            slopes[p, i] = slope(z[i], grid[p])


def _ends(problem: Problem, alpha: Array, order: int, stages: int, T: float) -> tuple[Array, Array]:
    """End error after T s and its Jacobian with respect to alpha."""
    n = alpha.size
    start = np.concatenate([problem.x0, alpha, np.zeros(2 * n * n)])
    for i in range(n):
        start[2 * n + i * 2 * n + n + i] = 1.0
    z = np.zeros((stages, start.size, order + 1))
    chain(problem.extremal.variational, start, T, stages, z, np.zeros((stages, 0, order + 1)))
    end = z[-1].sum(axis=1)
    S = end[2 * n :].reshape(n, 2 * n).T
    return problem.end_error(end[: 2 * n]), S[n:] if problem.x_end is None else S[:n]


def newton(
    problem: Problem,
    alpha: Array,
    order: int,
    stages: int,
    T: float,
    accurate: float,
    halvings: int = 0,
    steps: int = NEWTON,
) -> tuple[Array, float]:
    """Solve the end conditions for alpha by Newton's method.

    Parameters
    ----------
    accurate : float
        Error from which on steps that no longer halve it are counted, to stop where only rounding changes.
    halvings : int
        A step that increases the error is halved at most this often; 0: always full steps.
    steps : int
        At most.

    Returns
    -------
    alpha : ndarray
    error : float
        Largest remaining violation.
    """
    error, jacobian = _ends(problem, alpha, order, stages, T)
    size = float(np.max(np.abs(error)))
    best, least, idle = alpha, size, 0
    for _ in range(steps):
        if not np.isfinite(size) or not np.all(np.isfinite(jacobian)) or least == 0.0 or idle > 1:
            break
        try:
            step = dense.solve(jacobian, -error)
        except np.linalg.LinAlgError:
            break
        before = size
        for _ in range(halvings + 1):
            tried = alpha + step
            error, jacobian = _ends(problem, tried, order, stages, T)
            size = float(np.max(np.abs(error)))
            if size < before or not halvings:
                break
            step = 0.5 * step
        alpha = tried
        if least <= accurate and size > 0.5 * least:
            idle += 1
        if size < least:
            best, least = alpha, size
    return best, least


def costate(problem: Problem, alpha: Array, order: int, stages: int, accurate: float) -> tuple[Array, list[Root]]:
    """Solve the end conditions of an order from the alpha of the order before.

    If alpha changes by more than a tenth at a low order, Newton's method is started from many points around it, and the
    best of the real roots is taken, see `roots`; from there on the branch is followed. A root that differs by more than
    half of alpha may belong to another branch: Newton's method is then also started from points around alpha, and the
    nearest root is taken. If there is none, the horizon is increased in steps to T, starting from alpha = 0.

    Returns
    -------
    alpha : ndarray
    several : list of Root
        All roots, the best first, at a low order.
    """
    T = problem.horizon
    result, error = newton(problem, alpha, order, stages, T, accurate)
    if 1 < order <= LOW and not (error <= accurate and _moved(result, alpha) <= NEAR):
        roots = distinct(
            alpha, result, error, accurate, lambda start: newton(problem, start, order, stages, T, accurate, 4, 16)
        )
        if roots:
            several = (
                best(
                    problem,
                    roots,
                    lambda root: _series(problem, root, order, stages),
                    lambda z, u: _judge(problem, z, u)[0],
                )
                if roots[1:]
                else []
            )
            return (several[0].alpha if several else roots[0]), several
    if error <= accurate and _moved(result, alpha) <= JUMP:
        return result, []
    size = dense.norm(alpha)
    roots = [result] if error <= accurate else []
    for start in alpha + max(size, 1.0) * np.vstack([d for r in AROUND for d in (r * np.eye(alpha.size))]):
        tried, missing = newton(problem, start, order, stages, T, accurate, HALVINGS)
        if missing <= accurate:
            roots.append(tried)
    if roots:
        return min(roots, key=lambda root: dense.norm(root - alpha)), []
    grown = np.zeros_like(alpha)
    for share in SHARES:
        grown, missing = newton(problem, grown, order, stages, share * T, accurate, HALVINGS)
        if not missing <= accurate:
            return result, []
    return grown, []


def _moved(values: Array, alpha: Array) -> float:
    """Change of alpha from one order to the next, of its size; 0 where that is 0."""
    size = dense.norm(alpha)
    return dense.norm(values - alpha) / size if size else 0.0


def _series(problem: Problem, alpha: Array, order: int, stages: int) -> tuple[Array, Array]:
    """Polynomials of states and costates, (stages, 2 n, order + 1), and of the controls."""
    z = np.zeros((stages, 2 * alpha.size, order + 1))
    u = np.zeros((stages, len(problem.controls), order + 1))
    chain(problem.extremal.tape, np.concatenate([problem.x0, alpha]), problem.horizon, stages, z, u)
    return z, u


def _judge(problem: Problem, z: Array, u: Array) -> tuple[float, float, float]:
    """Return the cost along the polynomials, the relative residual of all equations, the absolute one of the
    states'.
    """
    extremal, stages = problem.extremal, z.shape[0]
    n, T = len(problem.states), problem.horizon / z.shape[0]
    J = 0.0
    off, sizes = np.zeros(2 * n), np.zeros(2 * n)
    both = np.concatenate([z, u], axis=1)
    for stage in range(stages):
        values, rate = np.empty((NODES.size, both.shape[1])), np.empty((NODES.size, both.shape[1]))
        sample(both[stage], NODES, values, rate)
        L = np.empty((NODES.size, 1))
        evaluate(extremal.cost, np.concatenate([values[:, :n], values[:, 2 * n :]], axis=1), L)
        J += T * float(dense.product(WEIGHTS, L[:, 0]))
        values, rate = np.empty((GRID.size, 2 * n)), np.empty((GRID.size, 2 * n))
        sample(z[stage], GRID, values, rate)
        F = np.empty((GRID.size, 2 * n))
        evaluate(extremal.tape, values, F)
        off = np.maximum(off, np.max(np.abs(rate / T - F), axis=0))
        sizes = np.maximum(sizes, np.max(np.abs(values), axis=0))
    states, costates = float(np.max(off[:n])), float(np.max(off[n:]))
    tiny = np.finfo(float).tiny
    relative = problem.horizon * max(states / max(np.max(sizes[:n]), tiny), costates / max(np.max(sizes[n:]), tiny))
    return J, float(relative), states


def solve(
    problem: Problem,
    order: int = 8,
    order_max: int | None = None,
    *,
    eps: float = 1e-3,
    eps_res: float = 1e-4,
    stages: int = 1,
    alpha_mode: Literal["own", "frozen"] = "own",
    frozen_order: int = 0,
    frozen_alpha: Sequence[float] = (),
) -> Solution:
    """Solve a problem by series of rising order.

    Parameters
    ----------
    order : int
        Least order of the answer.
    order_max : int, optional
        The order increases from `order` until the sound rule is met, at most to this one; `order` when absent.
    eps, eps_res : float
        Of the stopping rule.
    stages : int
        Parts of the horizon, each with polynomials of its own.
    alpha_mode : {"own", "frozen"}
        Solve for alpha at each order, starting from that of the order before, or take one alpha at all of them.
    frozen_order : int
        Order whose alpha is the frozen one; 0: `order`.
    frozen_alpha : sequence of float
        The frozen alpha itself, in place of `frozen_order`.

    Returns
    -------
    Solution
    """
    n = len(problem.states)
    last = order if order_max is None else order_max
    scale = max(map(abs, (*problem.x0, *(problem.x_end or ())))) or 1.0
    alpha = np.zeros(n)
    if alpha_mode == "frozen":
        if len(frozen_alpha):
            alpha = np.array(frozen_alpha, dtype=float)
        else:
            for k in range(1, (frozen_order or order) + 1):
                alpha, _ = costate(problem, alpha, k, stages, END * scale)
    result = Solution(np.empty(0), problem.horizon, 0, alpha)
    for k in range(1, last + 1):
        if alpha_mode == "own":
            alpha, several = costate(problem, alpha, k, stages, END * scale)
            if len(several) > 1:
                result.roots[k] = several
        z, u = _series(problem, alpha, k, stages)
        J, residual, state_residual = _judge(problem, z, u)
        result.ratio.append(abs(J - result.J[-1]) / max(abs(J), np.finfo(float).tiny) if result.J else np.inf)
        result.J.append(J)
        result.residual.append(residual)
        result.state_residual.append(state_residual)
        result.alphas.append(alpha)
        if not result.seed_order and result.ratio[-1] < eps:
            result.seed_order = k
        result.converged = max(result.ratio[-2:]) < eps and residual < eps_res  # the first ratio is infinite
        if k >= order and result.converged:
            break
    result.order, result.alpha, result.coefficients = k, alpha, np.concatenate([z, u], axis=1)
    result.end_error = float(np.max(np.abs(problem.end_error(z[-1].sum(axis=1)))))
    result.accurate = bool(result.end_error <= END * scale)
    result.reason = _reason(result, eps, eps_res)
    return result


def _reason(solution: Solution, eps: float, eps_res: float) -> str:
    if not solution.accurate:
        return f"end conditions missed by {solution.end_error:.3g}"
    if solution.residual[-1] >= eps_res:
        return f"residual {solution.residual[-1]:.3g} is not below {eps_res:g}"
    if not solution.converged:
        return f"cost has not settled: ratios {', '.join(f'{r:.3g}' for r in solution.ratio[-2:])} against {eps:g}"
    return f"converged at order {solution.order}"


def several(solution: Solution) -> str:
    """Describe the orders with several roots, and the plant's cost under each, the first chosen one first."""
    messages = []
    for order, roots in solution.roots.items():
        paid = ", ".join(f"{r.paid:.5g}" if np.isfinite(r.paid) else "without end" for r in roots)
        messages.append(f"{len(roots)} roots at order {order}, under which the plant pays {paid}: the first is taken")
    return "; ".join(messages)


def enough_stages(problem: Problem, order: int, eps_res: float, most: int = 16) -> int:
    """Return the least power of two of stages, up to `most`, for which the order suffices; 0 if none does."""
    stages = 2
    while stages <= most:
        solution = solve(problem, order, eps_res=eps_res, stages=stages)
        if solution.accurate and solution.residual[-1] < eps_res:
            return stages
        stages *= 2
    return 0
