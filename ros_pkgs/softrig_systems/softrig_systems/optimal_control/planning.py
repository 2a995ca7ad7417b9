"""The common part of planner nodes: when they plan, their requests and outputs; subclasses do the mathematics."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from softrig_core import Jobs, Level, Port, Result, Solver, SolverParams, Values, button, param, to_s
from typing_extensions import TypeVar

from .parameters import ProblemParams
from .ports import plan, state, summary

LEAST = 2  # periods: with less time left the old plan stays


class PlannerParams(SolverParams, ProblemParams):
    """Parameters of a planner: the times of planning, and the requirements on a plan."""

    period: float = param(1.0, "sampling period", "s", gt=0.0, le=100.0)
    k_replan: int = param(
        0, "number of periods after which it plans again from the measured state; 0: only once", ge=0, le=1_000_000
    )
    eps_res: float = param(
        1e-4, "largest residual, T |dz/dt - F| relative to the largest state or costate", gt=0.0, le=1e3
    )


class Request(NamedTuple):
    """Input of the worker process."""

    p: Any
    x: tuple[float, ...]
    horizon: float
    before: Any
    """The last plan, for a warm start; None at first."""


class Planned(NamedTuple):
    """The result of planning."""

    values: tuple[float, ...]
    """The plan as on its topic."""

    order: int
    J: float
    residual: float
    end_error: float
    accurate: bool
    converged: bool
    reason: str
    details: Mapping[str, str]
    """For the diagnostics."""

    memory: Any = None
    """For the next request."""


P = TypeVar("P", bound=PlannerParams, default=PlannerParams)


class State(NamedTuple):
    """State from tick to tick."""

    begin: int | None = None
    """When the first state came, ns."""

    ticks: int = 0
    """Since then."""

    pressed: bool = False
    """Whether `replan` is."""

    last: Planned | None = None
    jobs: Jobs = Jobs()


class Planner(Solver[P]):
    """Plans from the first measured state to the end of the horizon, and again from later states for the rest of it.

    A press on `replan`, or each `k_replan` periods, requests a new plan, unless less than two periods are left. If the
    state is refused, no plan is requested, and the last one stays. A plan that misses the end conditions by more than
    1e-8 of the state is not published (ERROR); one with too large a residual is, as not converged (WARN).
    """

    LABEL = "power"
    STATE = State

    @classmethod
    def shape(cls, params: Any) -> tuple[int, int]:
        """Return (stages, columns) of a plan."""
        raise NotImplementedError

    @classmethod
    def agreed(cls, params: Any) -> Mapping[str, Any]:
        """The task; its idea of the plant is its own."""
        return params.task_agreed()

    @classmethod
    def ports(cls, params: Any) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Channels of the problem."""
        problem = params.statement()
        stages, columns = cls.shape(params)
        inputs = (state(problem), button("replan", "ocp/replan", held=True))
        return inputs, (plan(problem, columns, stages=stages, label=cls.LABEL, output=True), summary(output=True))

    def setup(self) -> None:
        """Size and horizon of the problem."""
        self._n = len(self.p.statement().states)
        self._T = self.p.statement().horizon

    def request(
        self, x: State, t: int, *, state: tuple[float, ...], replan: Any = None
    ) -> tuple[State, Request | None]:
        """Ask at the first state, at a press, and each `k_replan` periods."""
        down = replan == (1.0,)
        pressed = down and not x.pressed
        first = x.begin is None
        begin, ticks = (t, 0) if x.begin is None else (x.begin, x.ticks + 1)
        x = State(begin, ticks, down, x.last, x.jobs)
        again = self.p.k_replan > 0 and ticks % self.p.k_replan == 0
        if not (first or again or pressed):
            return x, None
        left = self._T - to_s(t - begin)
        if not first and left < LEAST * self.p.period * (1.0 - 1e-9):
            return x, None
        return x, Request(self.p, state[: self._n], left, x.last.memory if x.last else None)

    def answer(self, x: State, t: int, result: Result | None, new: bool) -> tuple[State, Values]:
        """Return a new plan once."""
        if not new or result is None:
            return x, {}
        answer: Planned | None = result.answer
        if answer is None:
            self.report(Level.ERROR, "limit", "no plan in time: the last one stays")
            return x, {}
        if not answer.accurate or not np.all(np.isfinite(answer.values)):
            self.report(Level.ERROR, "no_plan", f"no plan: {answer.reason}")
            return x, {}
        if not answer.converged:
            self.report(Level.WARN, "not_converged", f"not converged: {answer.reason}")
        trusted = float(answer.residual < self.p.eps_res)
        return x._replace(last=answer), {
            "plan": answer.values,
            "summary": (
                to_s(result.stamp),
                result.request.horizon,
                float(answer.order),
                answer.J,
                answer.residual,
                answer.end_error,
                float(answer.converged),
                trusted,
            ),
        }

    def health(self, x: State) -> Mapping[str, str]:
        """Add the known facts about the present plan."""
        last = x.last
        return {**super().health(x), **(last.details if last else {})}
