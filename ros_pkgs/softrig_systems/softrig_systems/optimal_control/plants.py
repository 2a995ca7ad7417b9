"""Plants of the problems: the statement's own equations under a held command."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar

from softrig_core import Compiled, Level, Marker, Plant, Port, Values, param, rk4, state_type
from typing_extensions import TypeVar

from .parameters import ProblemParams
from .ports import control, state
from .problem import Problem


class OcpPlantParams(ProblemParams):
    """Problem, disturbance and steps."""

    substeps: int = param(4, "Runge-Kutta steps in a period", ge=1, le=100)
    bias: tuple[float, ...] = param((), "added to each command, in its unit; nothing when empty", live=True)
    torque_limit: float | None = param(
        None, "largest absolute command; without limit when absent", gt=0.0, le=1e9, live=True
    )

    def _check(self) -> None:
        controls = self.statement().controls
        if self.bias and (len(self.bias) != len(controls) or not all(map(math.isfinite, self.bias))):
            raise ValueError(f"bias = {self.bias}: expected {len(controls)} finite numbers")


def step_function(name: str, problem: Problem, substeps: int) -> Compiled:
    """Compile (x, u, h) to (x after h s, the increase of L), by a number of Runge-Kutta steps of order 4."""
    import casadi as ca

    x, u, dx, L = problem.expressions()
    h = ca.SX.sym("h")
    rate = ca.Function("rate", [x, u], [ca.vertcat(dx, L)])
    n = x.numel()
    end = rk4(lambda y: rate(y[:n], u), ca.vertcat(x, 0), h / substeps, substeps)
    return Compiled(ca.Function(name, [x, u, h], [end[:n], end[n]]))


P = TypeVar("P", bound=OcpPlantParams, default=OcpPlantParams)


class OcpPlant(Plant[P]):
    """Any problem's equations, integrated by Runge-Kutta steps of order 4 with the command held.

    The scalar and the two-state problem can escape in finite time: a state beyond 1000 exceeds the output limits and
    ends the run. The state has the problem's variables by name; with velocities it also has the command `applied` until
    now.
    """

    DRAWN_BY = "softrig_systems.optimal_control.drawing:OptimalControl"
    AWAITS_COMMAND: ClassVar[bool] = True

    @classmethod
    def agreed(cls, params: OcpPlantParams) -> Mapping[str, Any]:
        """The problem."""
        return params.plant_agreed()

    @classmethod
    def ports(cls, params: OcpPlantParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Channels of the problem."""
        problem = params.statement()
        return (control(problem),), (state(problem),)

    def setup(self) -> None:
        """Compile the step once: it does not depend on live parameters."""
        problem = self.p.statement()
        cached = self.__dict__.get("_step")
        self._step = step_function("ocp_step", problem, self.p.substeps) if cached is None else cached
        self._n, self._zero_control, self._x0 = len(problem.states), (0.0,) * len(problem.controls), problem.x0
        self._reports_applied = problem.carrier == "velocity"
        self._state = state_type(("", (*problem.states, *(("applied",) if self._reports_applied else ()))))
        self._bias = self.p.bias or self._zero_control
        self._limit = math.inf if self.p.torque_limit is None else self.p.torque_limit

    def first(self) -> Any:
        """The problem's start."""
        return self._state(*self._x0, *((self._zero_control,) if self._reports_applied else ()))

    def outputs(self, x: Any, t: int) -> Values:
        """Return the state; with velocities the command that was applied until now."""
        return {"state": (*x[: self._n], *x.applied) if self._reports_applied else tuple(x)}

    def advance(self, x: Any, t: int, **inputs: Any) -> Any:
        """Move on by a period."""
        u = inputs["command"]
        if max(map(abs, u)) > self._limit:
            self.report(Level.WARN, "limited", f"command beyond {self._limit:g}: limited")
            u = tuple(min(max(v, -self._limit), self._limit) for v in u)
        *now, _ = self._step((*x[: self._n], *(v + b for v, b in zip(u, self._bias, strict=True)), self.p.period))
        return self._state(*now, tuple(u)) if self._reports_applied else self._state(*now)


class ScalarPlantParams(OcpPlantParams):
    """The scalar problem."""

    period: float = param(0.01, "sampling period", "s", gt=0.0, le=1.0)
    problem: str = param("scalar", "the problem")


class TwoStatePlantParams(OcpPlantParams):
    """The two-state problem."""

    period: float = param(0.01, "sampling period", "s", gt=0.0, le=1.0)
    problem: str = param("two_state", "the problem")


class ScalarPlant(OcpPlant[ScalarPlantParams]):
    r"""The scalar problem.

    :math:`\dot x = x^2 \sin(x)/2 + u`.
    """


class SpacecraftPlant(OcpPlant):
    r"""Rates of a rigid spacecraft about its principal axes.

    :math:`I_1 \dot w_1 = (I_2 - I_3) w_2 w_3 + u_1`, cyclic.
    """

    DRAWN_BY = "softrig_systems.optimal_control.drawing:Spacecraft"

    def markers(self, x: Any) -> tuple[Marker, ...]:
        """Draw the momentum vector I w in axes of the body, 1 m for 1 kg m^2/s, and a ball at its tip."""
        h1, h2, h3 = (moment * w for moment, w in zip(self.p.inertia, x[: self._n], strict=True))
        tip = (h1, h2, h3)
        return (
            Marker("body", "momentum", "line_strip", ((0.0, 0.0, 0.0), tip), 0.02),
            Marker("body", "tip", "sphere_list", (tip,), 0.05, (0.9, 0.4, 0.1, 1.0)),
        )


class TwoStatePlant(OcpPlant[TwoStatePlantParams]):
    r"""The problem of two states.

    :math:`\dot x_1 = x_2 + x_1 x_2`, :math:`\dot x_2 = -x_1 + x_2 + x_2^2 + u`.
    """
