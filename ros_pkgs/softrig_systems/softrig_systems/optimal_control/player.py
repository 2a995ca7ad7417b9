"""The player: a plan in, a held command out."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from softrig_core import Block, Level, Port, executable, param, scalars, to_s

from .mvim import polynomials
from .parameters import ProblemParams
from .ports import SUMMARY, control, plan, state, summary

OTHER = 1e-6  # of the size of the state: a plan that begins further off is another one's


class PlayerParams(ProblemParams):
    """Form of the plan and how it is sampled."""

    form: Literal["power", "time"] = param("power", "coefficients of polynomials, or samples")
    order: int = param(8, "power: highest order of the plan, the planner's order_max", ge=1, le=60)
    stages: int = param(1, "power: stages of the plan", ge=1, le=64)
    samples: int = param(101, "time: columns of the plan", ge=4, le=10_001)
    sampling: Literal["middle", "start"] = param(
        "middle", "where in the period the control is taken; middle: 2nd order", live=True
    )
    allow_unconverged: bool = param(False, "also play plans whose residual is too large", live=True)

    @property
    def columns(self) -> int:
        """Columns of the plan."""
        return self.order + 1 if self.form == "power" else self.samples


class OcpPlayer(Block[PlayerParams]):
    """Holds u(t_k + dt/2) of the newest plan for a period; zero before the first plan and after the horizon.

    A plan that is not to be trusted, that is over before it comes, or that does not begin at the measured state is
    refused with ERROR: the plan before goes on. A state that is refused changes nothing: the plan goes on.
    """

    @classmethod
    def ports(cls, params: PlayerParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Channels of the problem."""
        problem = params.statement()
        given = plan(problem, params.columns, stages=params.stages, label=params.form)
        progress = scalars("progress", "ocp/progress", {"elapsed": "s", "remaining": "s"})
        return (state(problem), given, summary()), (control(problem), progress)

    def setup(self) -> None:
        """Sizes."""
        problem = self.p.statement()
        self._n, self._m = len(problem.states), len(problem.controls)

    def warm_up(self) -> None:
        """A plan comes later."""
        polynomials(np.zeros((1, 1, 1)), 0.0)

    def start(self) -> None:
        """No plan."""
        self._plan: Any = None
        self._start = self._horizon = 0.0
        self._begin: float | None = None
        self._seen: tuple[float, ...] = ()

    def update(
        self, t: int, *, state: tuple[float, ...], plan: tuple[float, ...], summary: tuple[float, ...]
    ) -> Mapping[str, tuple[float, ...]]:
        """Give the command of a period."""
        age = self.age("summary")
        # in real time a plan may come ticks after its stamp; its two messages belong together when they are of one age
        if age is not None and age == self.age("plan") and summary != self._seen:
            self._seen = summary
            self._take(t, state, plan, dict(zip(SUMMARY, summary, strict=True)))
        return self._play(t)

    def refused(self, t: int) -> Mapping[str, tuple[float, ...]]:
        """Go on with the plan."""
        return self._play(t)

    def _take(self, t: int, state: tuple[float, ...], values: tuple[float, ...], about: Mapping[str, float]) -> None:
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
            return
        if self._begin is None:
            self._begin = start
        self._start, self._horizon = start, horizon
        if self.p.form == "power":
            self._plan = table[:, 2 * self._n :, :]
        else:
            from scipy.interpolate import CubicSpline

            self._plan = CubicSpline(np.linspace(0.0, 1.0, self.p.columns), table[2 * self._n :], axis=1)

    def _play(self, t: int) -> Mapping[str, tuple[float, ...]]:
        now = to_s(t)
        elapsed = now - self._begin if self._begin is not None else 0.0
        remaining = max(self._start + self._horizon - now, 0.0) if self._plan is not None else 0.0
        progress = (elapsed, remaining)
        if self._plan is None or remaining <= 1e-9:
            return {"command": (0.0,) * self._m, "progress": progress}
        within = now - self._start + (0.5 * self.p.period if self.p.sampling == "middle" else 0.0)
        s = min(within / self._horizon, 1.0)
        u = polynomials(self._plan, s) if self.p.form == "power" else self._plan(s)
        return {"command": tuple(map(float, u)), "progress": progress}


main = executable(OcpPlayer)
