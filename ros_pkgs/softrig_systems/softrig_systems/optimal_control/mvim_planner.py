"""The series planner: a measured state in, polynomials of states, costates and controls out."""

from __future__ import annotations

import math
from typing import Any, Literal

import numpy as np
from softrig_core import Work, param

from .method.mvim import Solution, enough_stages, several, solve
from .planning import Planned, Planner, PlannerParams, Request


class MvimParams(PlannerParams):
    """Orders, stopping rule and how alpha is found."""

    order: int = param(8, "least order of the polynomials", ge=1, le=60)
    order_max: int | None = param(None, "go on to it until the rule is met; order when absent", ge=1, le=60)
    stages: int = param(1, "parts of the horizon with polynomials of their own", ge=1, le=64)
    eps: float = param(1e-3, "change of the cost, relative, below which it counts as settled", gt=0.0, le=1.0)
    alpha_mode: Literal["own", "frozen"] = param("own", "alpha solved for at each order, or one for all (the paper)")
    frozen_order: int = param(0, "order whose alpha is the frozen one; 0: order", ge=0, le=60)
    frozen_alpha: tuple[float, ...] = param((), "instead: the frozen alpha itself; it ends where it ends")

    def _check(self) -> None:
        if self.order_max is not None and self.order_max < self.order:
            raise ValueError(f"order_max = {self.order_max}: expected at least order = {self.order}")
        n = len(self.statement().states)
        if self.frozen_alpha and (len(self.frozen_alpha) != n or not all(map(math.isfinite, self.frozen_alpha))):
            raise ValueError(f"frozen_alpha = {self.frozen_alpha}: expected {n} finite numbers")

    @property
    def last(self) -> int:
        """Highest order."""
        return self.order_max or self.order


class MvimPlanner(Planner[MvimParams]):
    """Modified variational iteration: see `mvim`.

    Rows of the plan are states, costates and controls; columns the coefficients of powers of s = (t - start)/horizon,
    in each stage of its own length. Orders below `order_max` leave the last columns 0.
    """

    @classmethod
    def shape(cls, params: Any) -> tuple[int, int]:
        """Return one column per power."""
        return params.stages, params.last + 1

    @staticmethod
    def solve(request: Request, work: Work) -> Planned:
        """Solve one problem."""
        p: MvimParams = request.p
        problem = p.statement().changed(x0=request.x, horizon=request.horizon)
        solution = solve(
            problem,
            p.order,
            p.last,
            eps=p.eps,
            eps_res=p.eps_res,
            stages=p.stages,
            alpha_mode=p.alpha_mode,
            frozen_order=p.frozen_order,
            frozen_alpha=p.frozen_alpha,
        )
        values = np.zeros((p.stages, solution.coefficients.shape[1], p.last + 1))
        values[:, :, : solution.order + 1] = solution.coefficients
        # a frozen alpha is a published claim: its plan is published to be judged
        accurate = solution.accurate or p.alpha_mode == "frozen"
        reason = solution.reason
        missed = not solution.accurate or solution.residual[-1] >= p.eps_res
        if missed and p.alpha_mode == "own" and request.horizon == p.statement().horizon:
            stages = enough_stages(problem, p.last, p.eps_res)
            reason += f"; stages: {stages} do" if stages else "; nor do 16 stages"
        if solution.roots:
            reason += f"; {several(solution)}"
        return Planned(
            tuple(values.ravel().tolist()),
            solution.order,
            solution.J[-1],
            solution.residual[-1],
            solution.end_error,
            accurate,
            solution.converged,
            reason,
            _details(solution, reason),
        )


def _details(solution: Solution, reason: str) -> dict[str, str]:
    def row(values: Any) -> str:
        return " ".join(f"{v:.10g}" for v in values)

    return {
        "order": str(solution.order),
        "alpha": row(solution.alpha),
        "J per order": row(solution.J),
        "ratio per order": row(solution.ratio),
        "residual": f"{solution.residual[-1]:.3g}",
        "end error": f"{solution.end_error:.3g}",
        "converged": str(solution.converged),
        "order of the paper's rule": str(solution.seed_order),
        "reason": reason,
    }
