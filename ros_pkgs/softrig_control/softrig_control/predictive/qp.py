"""The quadratic programme of constrained GPC, by three maintained solvers.

::

    min 1/2 U' H U + q' U
    s.t. low <= U_1 + ... + U_i <= high,  |U_i| <= most      for every move i

`low` and `high` are what the bounds of the command leave from the one that acts now.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol

from softrig_core.extras import need

if TYPE_CHECKING:
    import numpy as np

SolverName = Literal["daqp", "osqp", "qpoases"]


class Answer(NamedTuple):
    """What a solver says.

    Attributes
    ----------
    moves : tuple of float, or None
        U; None when there is no solution.
    status : str
        ``optimal``, or the solver's own word for what went wrong.
    """

    moves: tuple[float, ...] | None
    status: str


class MoveSolver(Protocol):
    """A solver of the programme above with H and `most` fixed at its making."""

    def solve(self, q: Sequence[float], low: float, high: float) -> Answer:
        """Solve for a linear term and the bounds of the accumulated moves; never raises."""


def make_solver(name: SolverName, hessian: Sequence[Sequence[float]], most: float) -> MoveSolver:
    """Make a solver by name.

    Parameters
    ----------
    name : {"daqp", "osqp", "qpoases"}
        Measured for two moves with a bound active, in the order of their time: DAQP (dual active set, exact to
        rounding) is the default; OSQP (operator splitting, exact to its tolerance); qpOASES through casadi.
    hessian : (Nc, Nc)
        H, positive definite.
    most : float
        Largest move.
    """
    makers: dict[SolverName, Callable[[Sequence[Sequence[float]], float], MoveSolver]]
    makers = {"daqp": _Daqp, "osqp": _Osqp, "qpoases": _QpOases}
    return makers[name](hessian, most)


class _Base:
    """Bounds by row: first the moves, then their partial sums."""

    def __init__(self, hessian: Sequence[Sequence[float]], most: float) -> None:
        import numpy as np

        self.n = n = len(hessian)
        self.h: np.ndarray[Any, np.dtype[np.float64]] = np.array(hessian, dtype=float)
        self.sums = np.tril(np.ones((n, n)))
        self.q = np.zeros(n)
        self.lower = np.concatenate([np.full(n, -most), np.full(n, -np.inf)])
        self.upper = np.concatenate([np.full(n, most), np.full(n, np.inf)])

    def fill(self, q: Sequence[float], low: float, high: float) -> None:
        self.q[:] = q
        self.lower[self.n :] = low
        self.upper[self.n :] = high


class _Daqp(_Base):
    WORDS = {-1: "infeasible", -2: "cycling", -3: "unbounded", -4: "iteration limit", -5: "not convex"}

    def __init__(self, hessian: Sequence[Sequence[float]], most: float) -> None:
        super().__init__(hessian, most)
        import numpy as np
        from daqp import solve

        self._solve = solve
        self._sense = np.zeros(2 * self.n, dtype=np.int32)

    def solve(self, q: Sequence[float], low: float, high: float) -> Answer:
        """Solve from scratch: with two moves a warm start saves nothing, and the answer has no memory."""
        self.fill(q, low, high)
        self._sense[:] = 0
        x, _, flag, _ = self._solve(self.h, self.q, self.sums, self.upper, self.lower, self._sense)
        if flag != 1:
            return Answer(None, self.WORDS.get(flag, f"exit flag {flag}"))
        return Answer(tuple(x.tolist()), "optimal")


class _Osqp(_Base):
    def __init__(self, hessian: Sequence[Sequence[float]], most: float) -> None:
        super().__init__(hessian, most)
        need("osqp", "solver osqp")
        import numpy as np
        import osqp
        from scipy import sparse

        rows = sparse.csc_matrix(np.vstack([np.eye(self.n), self.sums]))
        self._solver = osqp.OSQP()
        # no adaptation by the clock: the same data must give the same bits on every machine
        self._solver.setup(sparse.csc_matrix(np.triu(self.h)), self.q, rows, self.lower, self.upper, verbose=False,
                           adaptive_rho=False, eps_abs=1e-9, eps_rel=1e-9, max_iter=20000)  # fmt: skip

    def solve(self, q: Sequence[float], low: float, high: float) -> Answer:
        """Solve from a cold start, so that the answer has no memory."""
        self.fill(q, low, high)
        if low > high:
            return Answer(None, "infeasible")
        self._solver.update(q=self.q, l=self.lower, u=self.upper)
        self._solver.warm_start(x=self.q * 0.0, y=self.lower * 0.0)
        found = self._solver.solve(raise_error=False)
        status = str(found.info.status)
        return Answer(tuple(found.x.tolist()), "optimal") if status == "solved" else Answer(None, status)


class _QpOases(_Base):
    def __init__(self, hessian: Sequence[Sequence[float]], most: float) -> None:
        super().__init__(hessian, most)
        import casadi as ca

        sparsity = {"h": ca.Sparsity.dense(self.n, self.n), "a": ca.Sparsity.lower(self.n)}
        options: dict[str, Any] = {"printLevel": "none", "error_on_fail": False}
        self._solver = ca.conic("moves", "qpoases", sparsity, options)
        self._data = {"h": ca.DM(self.h), "a": ca.DM(sparsity["a"], 1.0)}

    def solve(self, q: Sequence[float], low: float, high: float) -> Answer:
        """Solve from a cold start."""
        n = self.n
        self.fill(q, low, high)
        if low > high:
            return Answer(None, "infeasible")
        found = self._solver(**self._data, g=self.q, lbx=self.lower[:n], ubx=self.upper[:n], lba=self.lower[n:],
                             uba=self.upper[n:])  # fmt: skip
        stats = self._solver.stats()
        if not stats["success"]:
            return Answer(None, str(stats["return_status"]))
        return Answer(tuple(float(x) for x in found["x"].nonzeros()), "optimal")
