"""What a plan is worth: what the plant paid, where it ended, and whether what the plan says of itself is possible."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from softrig_core import Level, Observer, Port, executable, param, scalars, to_s
from softrig_core.kit import dense

from .exact import least_cost
from .mvim import polynomials
from .parameters import ProblemParams
from .plants import step_function
from .ports import SUMMARY, control, plan, state, summary

MARGIN = 1e-6  # of the least cost: a claim below it by more is impossible
FIGURES = ("J_plant", "J_exact", "J_series", "end_error", "end_error_max", "distance", "residual", "infeasible")


class EvaluatorParams(ProblemParams):
    """Form of the plan, and what residual is too large."""

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
    `infeasible` is 1 and a WARN says so.
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
        seen = (plan(problem, columns, stages=params.stages, label=params.form), summary())
        inputs = (state(problem), control(problem), *(replace(port, held=True) for port in seen))
        return inputs, (scalars("evaluation", "ocp/evaluation", dict.fromkeys(FIGURES, "")),)

    def setup(self) -> None:
        """Work out the least cost."""
        self._problem = self.p.statement()
        self._n = len(self._problem.states)
        self._step = step_function("ocp_cost", self._problem, self.p.substeps)
        self._exact = least_cost(self._problem)

    def warm_up(self) -> None:
        """A plan comes later."""
        polynomials(np.zeros((1, 1, 1)), 0.0)

    def start(self) -> None:
        """Nothing seen."""
        self._begin: float | None = None
        self._table: Any = None
        self._start = self._horizon = 0.0
        self._first = True
        self._seen: tuple[float, ...] = ()
        self._found = dict.fromkeys(FIGURES, 0.0) | {"J_exact": self._exact}

    def update(
        self, t: int, *, state: tuple[float, ...], command: tuple[float, ...], plan: tuple[float, ...] | None,
        summary: tuple[float, ...] | None,
    ) -> Mapping[str, tuple[float, ...]]:  # fmt: skip
        """Take one sample in."""
        now, x, found = to_s(t), np.array(state[: self._n]), self._found
        if self._begin is None:
            self._begin = now
            if tuple(x) != self._problem.x0:
                found["J_exact"] = least_cost(self._problem.changed(x0=tuple(x)))
        together = self.age("plan") == self.age("summary")
        if plan is not None and summary is not None and together and summary != self._seen:
            self._seen = summary
            self._take(plan, dict(zip(SUMMARY, summary, strict=True)))
        if self._table is not None and now <= self._start + self._horizon + 1e-9:
            found["distance"] = max(found["distance"], float(np.max(np.abs(x - self._planned(now)))))
        left = self._problem.horizon - (now - self._begin)
        if left > -1e-9 and self._problem.x_end is not None:
            missed = x - np.array(self._problem.x_end)
            found["end_error"], found["end_error_max"] = dense.norm(missed), float(np.max(np.abs(missed)))
        if left > 1e-9:
            *_, paid = self._step((*x, *command, min(self.p.period, left)))
            found["J_plant"] += paid if math.isfinite(paid) else 0.0
        return {"evaluation": tuple(found[name] for name in FIGURES)}

    def _take(self, plan: tuple[float, ...], about: Mapping[str, float]) -> None:
        self._start, self._horizon = about["start"], about["horizon"]
        if self.p.form == "power":
            self._table = np.reshape(plan, (self.p.stages, -1, self.p.order + 1))[:, : self._n]
        else:
            from scipy.interpolate import CubicSpline

            rows = np.reshape(plan, (-1, self.p.samples))[: self._n]
            self._table = CubicSpline(np.linspace(0.0, 1.0, self.p.samples), rows, axis=1)
        self._found["residual"] = about["residual"]
        if not self._first:
            return
        self._first = False
        self._found["J_series"] = about["J_series"]
        whole = abs(self._horizon - self._problem.horizon) < 1e-9  # not of what is left after a late start
        below = whole and about["J_series"] < self._found["J_exact"] - MARGIN * abs(self._found["J_exact"])
        if below or about["residual"] >= self.p.eps_res:
            self._found["infeasible"] = 1.0
            said = (
                f"J = {about['J_series']:.10g}, least {self._found['J_exact']:.10g}, residual {about['residual']:.3g}"
            )
            self.report(Level.WARN, "infeasible", f"infeasible: not an optimum: the plan says {said}")

    def _planned(self, now: float) -> Any:
        s = min(max((now - self._start) / self._horizon, 0.0), 1.0)
        return polynomials(self._table, s) if self.p.form == "power" else self._table(s)

    def status(self) -> Mapping[str, tuple[float, str]]:
        """Give the figures so far."""
        return {name: (value, "") for name, value in self._found.items()}


main = executable(OcpEvaluator)
