"""What all nodes of a problem have in common: which problem, over which time, to which end."""

from __future__ import annotations

from typing import Any

from softrig_core import BlockParams, param

from .problem import Problem, ProblemError
from .problems import INERTIA, find, spacecraft


class ProblemParams(BlockParams):
    """Statement of the problem; omitted values are the problem's own."""

    period: float = param(1.0, "sampling period", "s", gt=0.0, le=100.0)
    problem: str = param("spacecraft", "scalar, spacecraft, two_state, reactor, or one that a package has registered")
    x0: tuple[float, ...] = param((), "start of the plant; the problem's own when empty")
    x_end: tuple[float, ...] = param((), "end state; the problem's own, or a free end, when empty")
    horizon: float | None = param(None, "T; the problem's own when absent", "s", gt=0.0, le=1e6)
    R: tuple[float, ...] = param((), "weight of the control, u'Ru/2, row by row; the problem's own when empty")
    inertia: tuple[float, ...] = param(INERTIA, "spacecraft: principal moments", "kg m^2")

    def _check(self) -> None:
        self.statement().extremal  # noqa: B018  (raises for a weight that is not definite)

    def plant_agreed(self) -> dict[str, Any]:
        """Return the quantities on which a plant and the nodes that judge it must agree."""
        problem = self.statement()
        quantities = {"ocp/problem": problem.name, "ocp/x0": tuple(problem.x0)}
        return quantities | ({"ocp/inertia": self.inertia} if problem.name == "spacecraft" else {})

    def task_agreed(self) -> dict[str, Any]:
        """Return the quantities on which the planner and the nodes that judge a plan must agree."""
        p = self.statement()
        return {"ocp/problem": p.name, "ocp/horizon": p.horizon, "ocp/x_end": p.x_end, "ocp/R": self.R}

    def statement(self) -> Problem:
        """Return the problem with these parameters.

        Raises
        ------
        ProblemError
            The parameters are not a valid problem.
        """
        problem = find(self.problem)
        if problem.name == "spacecraft":
            problem = spacecraft(self.inertia)
        if self.x_end and problem.x_end is None:
            raise ProblemError(f"x_end: the end of {problem.name} is free")
        return problem.changed(x0=self.x0 or None, horizon=self.horizon, x_end=self.x_end or None, R=self.R)
