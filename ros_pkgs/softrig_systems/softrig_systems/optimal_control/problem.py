r"""An optimal control problem, stated once; Pontryagin's conditions, plant and planners are derived from the statement.

.. math:: \dot x = f(x, u), \quad \min J = \int_0^T L(x, u) dt, \quad x(0) = x_0, \quad x(T) = x_T \text{ or free}

with f affine and L quadratic in u. With the Hamiltonian :math:`H = L + \lambda^T f` the conditions are

.. math:: 0 = H_u, \quad \dot\lambda = -H_x, \quad \lambda(T) = 0 \text{ where the end is free.}

They are necessary. The paper calls them sufficient because J is convex; for nonlinear f that does not follow.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from .method.tape import Tape

if TYPE_CHECKING:
    import casadi as ca
    from numpy.typing import NDArray


_EXTREMALS: dict[tuple[object, ...], Extremal] = {}


class ProblemError(ValueError):
    """An impossible problem; the text names what is wrong."""


@dataclass(frozen=True)
class Problem:
    """Statement of a problem.

    Parameters
    ----------
    states, controls : mapping of str to str
        Name to unit.
    ode : callable
        (x, u), two casadi vectors, to the sequence of dx/dt.
    cost : callable
        (x, u) to the running cost L.
    x0 : tuple of float
        Published start.
    horizon : float
        T, s.
    x_end : tuple of float, optional
        End state; free when absent.
    carrier : {"position", "velocity"}
        Which number of a JointState carries the states.
    topic : str
        Name of the system in topics.
    exact : callable, optional
        (problem) to the least cost, where it is known in closed form or by quadrature.
    """

    name: str
    states: Mapping[str, str]
    controls: Mapping[str, str]
    ode: Callable[[Any, Any], Sequence[Any]]
    cost: Callable[[Any, Any], Any]
    x0: tuple[float, ...]
    horizon: float
    x_end: tuple[float, ...] | None = None
    carrier: str = "position"
    exact: Callable[[Problem], float] | None = None
    R: tuple[float, ...] = ()

    def changed(
        self,
        *,
        x0: Sequence[float] | None = None,
        horizon: float | None = None,
        x_end: Sequence[float] | None = None,
        R: Sequence[float] = (),
    ) -> Problem:
        """Return the same problem from another start, over another time, to another end, with another weight of u.

        Raises
        ------
        ProblemError
            Wrong numbers; the text begins with the name.
        """
        result = self
        if x0 is not None:
            result = replace(result, x0=self._state("x0", x0))
        if x_end is not None:
            result = replace(result, x_end=self._state("x_end", x_end))
        if horizon is not None:
            if not 0.0 < horizon < np.inf:
                raise ProblemError(f"horizon = {horizon:g} s: expected a positive time")
            result = replace(result, horizon=float(horizon))
        if len(R):
            result = replace(result, R=tuple(map(float, R)))
            result.weight()
        return result

    def _state(self, name: str, values: Sequence[float]) -> tuple[float, ...]:
        if len(values) != len(self.states) or not all(np.isfinite(values)):
            raise ProblemError(f"{name} = {tuple(values)}: expected {len(self.states)} finite numbers")
        return tuple(map(float, values))

    def weight(self) -> NDArray[np.float64]:
        """Return R as a matrix, shape (m, m); a ProblemError if it is invalid or not positive definite."""
        m = len(self.controls)
        if len(self.R) != m * m:
            raise ProblemError(f"R: expected {m * m} numbers, row by row, not {len(self.R)}")
        R = np.reshape(self.R, (m, m))
        if not np.all(np.isfinite(R)) or not np.allclose(R, R.T) or np.linalg.eigvalsh(R)[0] <= 0.0:
            raise ProblemError(f"R = {R.tolist()}: expected a symmetric positive definite matrix")
        return R

    def expressions(self) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
        """Return x, u, dx/dt and L as casadi expressions; a weight R replaces the part of L that is quadratic in u."""
        import casadi as ca

        x, u = ca.SX.sym("x", len(self.states)), ca.SX.sym("u", len(self.controls))
        dx = ca.vertcat(*self.ode(x, u))
        L = ca.SX(self.cost(x, u))
        if self.R:
            hessian = ca.hessian(L, u)[0]
            L = L - ca.dot(u, hessian @ u) / 2 + ca.dot(u, ca.DM(self.weight()) @ u) / 2
        if dx.numel() != len(self.states):
            raise ProblemError(f"ode: expected {len(self.states)} derivatives, not {dx.numel()}")
        return x, u, dx, L

    @property
    def extremal(self) -> Extremal:
        """Return Pontryagin's conditions, derived once for all starts, ends and horizons."""
        if self.key not in _EXTREMALS:
            _EXTREMALS[self.key] = Extremal(self)
        return _EXTREMALS[self.key]

    @property
    def key(self) -> tuple[object, ...]:
        """Return a hashable key of the values on which the equations depend."""
        return self.name, self.ode, self.cost, self.R, tuple(self.states), tuple(self.controls)

    def end_error(self, end: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the error at the end: x(T) - x_T, or the costate where the end is free; `end` is (x, lambda) at T."""
        n = len(self.states)
        return end[n:] if self.x_end is None else end[:n] - np.array(self.x_end)


class Extremal:
    """Canonical equations of a problem: z = (x, lambda), dz/dt = F(z), u = u(z).

    Attributes
    ----------
    function : casadi.Function
        z to (F, u).
    tape : Tape
        z to F, then u.
    variational : Tape
        (z, S) to their derivatives, where S = dz/d(lambda(0)), column after column.
    cost : Tape
        (x, u) to L.
    plant : Tape
        (x, u) to dx/dt, then L.
    """

    def __init__(self, problem: Problem) -> None:
        import casadi as ca

        x, u, dx, L = problem.expressions()
        n = x.numel()
        lam = ca.SX.sym("lambda", n)
        H = L + ca.dot(lam, dx)
        H_u = ca.gradient(H, u)
        H_uu = ca.jacobian(H_u, u)
        if ca.depends_on(H_uu, u) or ca.depends_on(ca.jacobian(dx, u), u):
            raise ProblemError(f"{problem.name}: the control must enter dynamics linearly and cost quadratically")
        at_rest = np.array(ca.evalf(ca.substitute(H_uu, ca.vertcat(x, lam), np.ones(2 * n))))
        if not np.all(np.isfinite(at_rest)) or np.linalg.eigvalsh(at_rest)[0] <= 0.0:
            raise ProblemError(f"R: the cost of {problem.name} has no positive definite weight of the control")
        u_star = -ca.solve(H_uu, ca.substitute(H_u, u, 0))
        F = ca.vertcat(ca.substitute(dx, u, u_star), -ca.substitute(ca.gradient(H, x), u, u_star))
        z = ca.vertcat(x, lam)
        S = ca.SX.sym("S", 2 * n, n)
        dS = ca.jacobian(F, z) @ S
        self.function = ca.Function("extremal", [z], [F, u_star])
        self.tape = _tape("tape", [z], [F, u_star])
        self.variational = _tape("variational", [z, ca.vec(S)], [F, ca.vec(dS)])
        self.cost = _tape("cost", [x, u], [L])
        self.plant = _tape("plant", [x, u], [dx, L])


def _tape(name: str, inputs: list[ca.SX], outputs: list[ca.SX]) -> Tape:
    import casadi as ca

    return Tape.of(ca.Function(name, [ca.vertcat(*inputs)], [ca.vertcat(*outputs)]))
