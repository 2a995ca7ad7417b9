"""The collocation planner: the same topics as the series planner, rows sampled over time instead of coefficients."""

from __future__ import annotations

from typing import Any

from softrig_core import Work, param

from .method.collocation import sampled, solve
from .method.mvim import END
from .planning import Planned, Planner, PlannerParams, Request


class CollocationParams(PlannerParams):
    """Grid of the collocation."""

    intervals: int = param(20, "intervals of equal length", ge=1, le=1000)
    degree: int = param(3, "Legendre points in each", ge=1, le=9)
    samples: int = param(101, "columns of the plan, equidistant in time", ge=4, le=10_001)
    warm_start: bool = param(True, "begin with the remaining part of the last plan")


class CollocationPlanner(Planner[CollocationParams]):
    """Direct collocation by casadi and ipopt: see `collocation`."""

    LABEL = "time"

    @classmethod
    def shape(cls, params: Any) -> tuple[int, int]:
        """Return one column per sample."""
        return 1, params.samples

    @staticmethod
    def solve(request: Request, work: Work) -> Planned:
        """Solve one problem."""
        p: CollocationParams = request.p
        problem = p.statement().changed(x0=request.x, horizon=request.horizon)
        guess = None
        if p.warm_start and request.before is not None:
            rows, horizon = request.before
            guess = sampled(rows, horizon, request.horizon, len(problem.states))
        solution = solve(problem, intervals=p.intervals, degree=p.degree, samples=p.samples, guess=guess)
        scale = max(map(abs, (*problem.x0, *(problem.x_end or ())))) or 1.0
        details = {
            "J": f"{solution.J:.12g}",
            "iterations": str(solution.iterations),
            "ipopt": solution.reason,
            "residual": f"{solution.residual:.3g}",
            "alpha": " ".join(map(str, solution.alpha)),
        }
        return Planned(
            tuple(solution.rows.ravel().tolist()),
            p.degree,
            solution.J,
            solution.residual,
            solution.end_error,
            solution.success and solution.end_error <= END * scale,
            solution.success and solution.residual < p.eps_res,
            solution.reason,
            details,
            (solution.rows, request.horizon),
        )
