"""The player: a plan in, a held command out."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from softrig_core import Block, Level, Port, Values, param, scalars, to_s

from .method.mvim import polynomials
from .parameters import ProblemParams
from .ports import SUMMARY, control, plan, state, summary

OTHER = 1e-6  # share of the size of the state: a plan that begins further away belongs to another state


class PlayerParams(ProblemParams):
    """Form of the plan and how it is sampled."""

    form: Literal["power", "time"] = param("power", "coefficients of polynomials, or samples")
    order: int = param(8, "power: highest order of the plan, the planner's order_max", ge=1, le=60)
    stages: int = param(1, "power: stages of the plan", ge=1, le=64)
    samples: int = param(101, "time: columns of the plan", ge=4, le=10_001)
    sampling: Literal["middle", "start"] = param(
        "middle", "point of the period at which the control is evaluated; middle: 2nd order", live=True
    )
    allow_unconverged: bool = param(False, "also play plans whose residual is too large", live=True)

    @property
    def columns(self) -> int:
        """Columns of the plan."""
        return self.order + 1 if self.form == "power" else self.samples


@dataclass(frozen=True, eq=False)
class Plan:
    """Start and length (s) of the plan that is played, its controls, and the summary last seen, refused or not.

    `begin` (s) is the start of the first one.
    """

    start: float = 0.0
    horizon: float = 0.0
    controls: Any = None
    begin: float | None = None
    seen: tuple[float, ...] = ()


NO_PLAN = Plan()


class State(NamedTuple):
    """The plan; no numbers of a linear view."""

    plan: Plan = NO_PLAN


Answer = tuple[State, Values]


class OcpPlayer(Block[PlayerParams]):
    """Holds u(t_k + dt/2) of the newest plan for a period; zero before the first plan and after the horizon.

    A plan that has not converged, that ends before it arrives, or that does not begin at the measured state is rejected
    with ERROR, and the previous plan continues. A rejected state has no effect: the plan continues.
    """

    STATE = State

    @classmethod
    def ports(cls, params: PlayerParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Channels of the problem."""
        problem = params.statement()
        plan_port = plan(problem, params.columns, stages=params.stages, label=params.form)
        progress = scalars("progress", "ocp/progress", {"elapsed": "s", "remaining": "s"})
        return (state(problem), plan_port, summary()), (control(problem), progress)

    def setup(self) -> None:
        """Sizes."""
        problem = self.p.statement()
        self._n, self._m = len(problem.states), len(problem.controls)

    def warm_up(self) -> None:
        """Do nothing: no plan has arrived yet."""
        polynomials(np.zeros((1, 1, 1)), 0.0)

    def update(
        self, x: State, t: int, *, state: tuple[float, ...], plan: tuple[float, ...], summary: tuple[float, ...]
    ) -> Answer:
        """Return the command of a period."""
        age = self.age("summary")
        # in real time a plan may arrive ticks after its stamp; its two messages belong together if they have the same
        # age
        if age is not None and age == self.age("plan") and summary != x.plan.seen:
            x = State(self._with_plan(replace(x.plan, seen=summary), t, state, plan))
        return x, self._play(x.plan, t)

    def refused(self, x: State, t: int) -> Answer:
        """Continue with the plan."""
        return x, self._play(x.plan, t)

    def _with_plan(self, before: Plan, t: int, state: tuple[float, ...], values: tuple[float, ...]) -> Plan:
        about = dict(zip(SUMMARY, before.seen, strict=True))
        start, horizon = about["start"], about["horizon"]
        shape = (self.p.stages, -1, self.p.columns) if self.p.form == "power" else (-1, self.p.columns)
        table = np.reshape(values, shape)
        begins = table[0, : self._n, 0] if self.p.form == "power" else table[: self._n, 0]
        x = np.array(state[: self._n])
        why = ""
        if not (horizon > 0.0 and math.isfinite(horizon)) or to_s(t) >= start + horizon:
            why = f"the plan is over: it began at {start:g} s and lasts {horizon:g} s"
        elif abs(to_s(t) - start) < 1e-9 and not np.max(np.abs(begins - x)) <= OTHER * max(1e-3, np.max(np.abs(x))):
            why = f"the plan is another problem's: it begins at {begins.tolist()}, the state is {x.tolist()}"
        elif about["trusted"] < 0.5 and not self.p.allow_unconverged:
            why = f"the plan has not converged: residual {about['residual']:.3g}"
        if why:
            self.report(Level.ERROR, "plan_refused", why)
            return before
        controls: Any
        if self.p.form == "power":
            controls = table[:, 2 * self._n :, :]
        else:
            from scipy.interpolate import CubicSpline

            controls = CubicSpline(np.linspace(0.0, 1.0, self.p.columns), table[2 * self._n :], axis=1)
        return Plan(start, horizon, controls, start if before.begin is None else before.begin, before.seen)

    def _play(self, plan: Plan, t: int) -> Values:
        now = to_s(t)
        elapsed = now - plan.begin if plan.begin is not None else 0.0
        remaining = max(plan.start + plan.horizon - now, 0.0) if plan.controls is not None else 0.0
        progress = (elapsed, remaining)
        if plan.controls is None or remaining <= 1e-9:
            return {"command": (0.0,) * self._m, "progress": progress}
        within = now - plan.start + (0.5 * self.p.period if self.p.sampling == "middle" else 0.0)
        s = min(within / plan.horizon, 1.0)
        u = polynomials(plan.controls, s) if self.p.form == "power" else plan.controls(s)
        return {"command": tuple(map(float, u)), "progress": progress}
