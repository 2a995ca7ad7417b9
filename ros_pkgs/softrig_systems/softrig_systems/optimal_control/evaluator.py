"""Evaluation of a plan: the plant's cost, its final error, and whether the plan's own cost is possible."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from softrig_core import Level, Observer, Port, Values, param, scalars, to_s
from softrig_core.kit import dense

from .method.exact import least_cost
from .method.mvim import polynomials
from .parameters import ProblemParams
from .plants import step_function
from .ports import SUMMARY, control, plan, state, summary

MARGIN = 1e-6  # share of the least cost: a result below it by more is impossible


class Figures(NamedTuple):
    """Published results: costs, final errors, largest distance from the plan, residual, whether it is infeasible."""

    J_plant: float = 0.0
    J_exact: float = 0.0
    J_series: float = 0.0
    end_error: float = 0.0
    end_error_max: float = 0.0
    distance: float = 0.0
    residual: float = 0.0
    infeasible: float = 0.0


FIGURES = Figures._fields


@dataclass(frozen=True, eq=False)
class Plan:
    """Start and length (s) of the newest plan, its states, and its summary."""

    start: float = 0.0
    horizon: float = 0.0
    states: Any = None
    summary: tuple[float, ...] = ()


NO_PLAN = Plan()


class State(NamedTuple):
    """The figures so far, the arrival of the first sample (ns), and the newest plan."""

    figures: Figures
    begin: int | None = None
    plan: Plan = NO_PLAN


class EvaluatorParams(ProblemParams):
    """Form of the plan, and the largest allowed residual."""

    form: Literal["power", "time"] = param("power", "coefficients of polynomials, or samples")
    order: int = param(8, "power: highest order of the plan", ge=1, le=60)
    stages: int = param(1, "power: stages of the plan", ge=1, le=64)
    samples: int = param(101, "time: columns of the plan", ge=4, le=10_001)
    substeps: int = param(4, "Runge-Kutta steps in a period, for the running cost", ge=1, le=100)
    eps_res: float = param(1e-4, "largest residual of an optimum", gt=0.0, le=1e3)


class OcpEvaluator(Observer[EvaluatorParams]):
    """Cost J of the plant, error at the end, largest distance from the plan, and the least cost possible.

    J_plant integrates the running cost over each period from the measured state with the command held. A first plan
    whose own cost lies below the least cost by more than a millionth, or whose residual is too large, is no optimum:
    `infeasible` is 1 and a WARN reports it.
    """

    @classmethod
    def agreed(cls, params: EvaluatorParams) -> Mapping[str, Any]:
        """The plant, and the task that the plan is for."""
        return {**params.plant_agreed(), **params.task_agreed()}

    @classmethod
    def ports(cls, params: EvaluatorParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Channels of the problem; the plan may be missing."""
        problem = params.statement()
        columns = params.order + 1 if params.form == "power" else params.samples
        planned = (plan(problem, columns, stages=params.stages, label=params.form), summary())
        inputs = (state(problem), control(problem), *(replace(port, held=True) for port in planned))
        return inputs, (scalars("evaluation", "ocp/evaluation", dict.fromkeys(FIGURES, "")),)

    def setup(self) -> None:
        """Work out the least cost."""
        self._problem = self.p.statement()
        self._n = len(self._problem.states)
        self._step = step_function("ocp_cost", self._problem, self.p.substeps)
        self._exact = least_cost(self._problem)

    def warm_up(self) -> None:
        """Do nothing: no plan has arrived yet."""
        polynomials(np.zeros((1, 1, 1)), 0.0)

    def first(self) -> State:
        """Return the initial state: nothing seen."""
        return State(Figures(J_exact=self._exact))

    def update(
        self,
        x: State,
        t: int,
        *,
        state: tuple[float, ...],
        command: tuple[float, ...],
        plan: tuple[float, ...] | None,
        summary: tuple[float, ...] | None,
    ) -> tuple[State, Values]:
        """Process one sample."""
        now, point = to_s(t), np.array(state[: self._n])
        figures, begin, newest = x
        if begin is None:
            begin = t
            if tuple(point) != self._problem.x0:
                figures = figures._replace(J_exact=least_cost(self._problem.changed(x0=tuple(point))))
        together = self.age("plan") == self.age("summary")
        if plan is not None and summary is not None and together and summary != newest.summary:
            figures, newest = self._updated(figures, newest, plan, summary)
        J_plant, J_exact, J_series, end_error, end_error_max, distance, residual, infeasible = figures
        if newest.states is not None and now <= newest.start + newest.horizon + 1e-9:
            distance = max(distance, float(np.max(np.abs(point - self._planned(newest, now)))))
        left = self._problem.horizon - (now - to_s(begin))
        if left > -1e-9 and self._problem.x_end is not None:
            missed = point - np.array(self._problem.x_end)
            end_error, end_error_max = dense.norm(missed), float(np.max(np.abs(missed)))
        if left > 1e-9:
            *_, paid = self._step((*point, *command, min(self.p.period, left)))
            J_plant = J_plant + (paid if math.isfinite(paid) else 0.0)
        figures = Figures(J_plant, J_exact, J_series, end_error, end_error_max, distance, residual, infeasible)
        return State(figures, begin, newest), {"evaluation": tuple(figures)}

    def _updated(
        self, figures: Figures, before: Plan, plan: tuple[float, ...], summary: tuple[float, ...]
    ) -> tuple[Figures, Plan]:
        about = dict(zip(SUMMARY, summary, strict=True))
        states: Any
        if self.p.form == "power":
            states = np.reshape(plan, (self.p.stages, -1, self.p.order + 1))[:, : self._n]
        else:
            from scipy.interpolate import CubicSpline

            rows = np.reshape(plan, (-1, self.p.samples))[: self._n]
            states = CubicSpline(np.linspace(0.0, 1.0, self.p.samples), rows, axis=1)
        newest = Plan(about["start"], about["horizon"], states, summary)
        figures = figures._replace(residual=about["residual"])
        if before.states is not None:
            return figures, newest
        figures = figures._replace(J_series=about["J_series"])
        # Not for the remaining time after a late start.
        full_horizon = abs(newest.horizon - self._problem.horizon) < 1e-9
        below = full_horizon and figures.J_series < figures.J_exact - MARGIN * abs(figures.J_exact)
        if below or figures.residual >= self.p.eps_res:
            figures = figures._replace(infeasible=1.0)
            text = f"J = {figures.J_series:.10g}, least {figures.J_exact:.10g}, residual {figures.residual:.3g}"
            self.report(Level.WARN, "infeasible", f"infeasible: not an optimum: the plan states {text}")
        return figures, newest

    def _planned(self, plan: Plan, now: float) -> Any:
        s = min(max((now - plan.start) / plan.horizon, 0.0), 1.0)
        return polynomials(plan.states, s) if self.p.form == "power" else plan.states(s)

    def status(self, x: State) -> Mapping[str, tuple[float, str]]:
        """Return the figures so far."""
        return {name: (value, "") for name, value in x.figures._asdict().items()}
