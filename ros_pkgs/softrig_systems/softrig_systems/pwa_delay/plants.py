"""The plants: a piecewise affine system, the water tank with its pipe, the pendulum."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
from softrig_core import BlockParams, Level, Plant, Port, Values, check_steps, param, state_type
from softrig_core.kit.dde import Track, trajectory
from typing_extensions import TypeVar

from .motion import (
    FREE,
    SWITCHES,
    PendulumConstants,
    TankConstants,
    constants,
    pendulum_cell,
    pwa_cell,
    run_pendulum,
    run_pwa,
    run_tank,
    tank_cell,
)
from .params import DelayParams, SystemParams, law_of_the_tank
from .ports import INFLOW, LEVEL, PENDULUM, TORQUE, mode, state
from .profiles import Delay, Profile, delay_at
from .system import TANK_C


class DelayPlantParams(DelayParams, BlockParams):
    """Delay, step and period."""

    period: float = param(0.001, "sampling period", "s", gt=0.0, le=100.0)
    step: float = param(
        1e-4, "largest integration step; rounded to a whole fraction of the period", "s", gt=0.0, le=100.0
    )

    def _check(self) -> None:
        check_steps(self.period, self.step, "step")


P = TypeVar("P", bound=DelayPlantParams, default=DelayPlantParams)


class DelayPlant(Plant[P]):
    """A plant whose delay equation is stepped with located switches; a constant history is the start.

    A delay beyond `max_delay` is clamped and reported; a state beyond 1e6 exceeds the output limits and ends the run.
    """

    SHOWN = "state"  # the output that shows the state
    loop: Callable[..., int]
    cell_of: Callable[..., int]

    def setup(self) -> None:
        """Count the steps in a period, name the state, and make a past for a plant without a delay."""
        self._steps = max(1, math.ceil(self.p.period / self.p.step - 1e-9))
        self._rows = self._steps * (SWITCHES + 2)
        self._h = self.p.period / self._steps
        self._nothing = np.empty(0)
        begin = self.begin()
        self._size = len(self.names())
        self._state = state_type(("", (*self.names(), "k", "cell", "delay", "past")))
        self._unread = Track(trajectory(self._h, 2.0 * self._h, begin))

    def first(self) -> Any:
        """Return the state at rest, including its past.

        Beside the state of the paper: periods since the start, the cell in force (-1: not looked up yet), the delay
        over time, and the steps that lie within it (None without a delay).
        """
        profile, begin = self.p.bounded_profile(self), self.begin()
        reach = self.p.reach
        past = Track(trajectory(self._h, reach + 2.0 * self._h, begin, spare=64)) if profile.h > 0.0 else None
        return self._state(*begin[: self._size], 0, FREE, Delay(profile, self.constants(profile), reach), past)

    def go_on(self, x: Any, before: P) -> Any:
        """Keep the past, which is read at the new delay from now on: at most at twice that of the start."""
        profile = self.p.bounded_profile(self, x.delay.longest)
        return x._replace(delay=Delay(profile, self.constants(profile), x.delay.longest), cell=FREE)

    def outputs(self, x: Any, t: int) -> Values:
        """Return state, cell and delay at t."""
        now, past = x.k * self.p.period, self._unread if x.past is None else x.past
        cell = int(type(self).cell_of(now, np.array(x[: self._size]), past.open(), x.delay.constants))
        shown = {self.SHOWN: x[: self._size]}
        return {**shown, "mode": (float(cell), float(delay_at(x.delay.profile, now)))}

    def move(self, x: Any, *inputs: float) -> Any:
        """Advance over one period with the inputs held."""
        size, p = self._size, x.delay.constants
        past = (self._unread if x.past is None else x.past).open(self._rows)
        now = np.array((*x[:size], *inputs))
        p.cell[0] = x.cell
        type(self).loop(past, x.k * self.p.period, now, self._h, self._steps, p, self._nothing)
        after = None if x.past is None else x.past.after(past)
        return self._state(*now.tolist()[:size], x.k + 1, int(p.cell[0]), x.delay, after)

    def names(self) -> Sequence[str]:
        """Return the names of the state values, which come first in `begin`."""
        raise NotImplementedError

    def begin(self) -> tuple[float, ...]:
        """Return state and held inputs at and before the start."""
        raise NotImplementedError

    def constants(self, delay: Profile) -> Any:
        """Pack the data of the native loop."""
        raise NotImplementedError


class SwitchedDelayPlantParams(SystemParams, DelayPlantParams):
    """System, delay and start."""

    x0: tuple[float, ...] = param((-2.0, 0.0), "state at and before the start")

    def _check(self) -> None:
        if len(self.x0) != self.states:
            raise ValueError(f"x0 has {len(self.x0)} values, expected {self.states}")


class SwitchedDelayPlant(DelayPlant[SwitchedDelayPlantParams]):
    """x' = A_i x + Ad_i x(t - d) + a_i, any piecewise affine system whose cells are defined by lines."""

    DRAWN_BY = "softrig_core.drawing.state_plane:StatePlane"
    loop = run_pwa
    cell_of = pwa_cell

    @classmethod
    def agreed(cls, params: SwitchedDelayPlantParams) -> Mapping[str, Any]:
        """The system."""
        return params.agreed()

    @classmethod
    def ports(cls, params: SwitchedDelayPlantParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Declare as many states as the system has."""
        return (), (state(params.states), mode("pwa/mode"))

    def names(self) -> Sequence[str]:
        """x1, x2, ..."""
        return [f"x{k + 1}" for k in range(self.p.states)]

    def begin(self) -> tuple[float, ...]:
        """x0."""
        return self.p.x0

    def constants(self, delay: Profile) -> Any:
        """Matrices and lines."""
        return constants(self.p.build(), delay)

    def advance(self, x: Any, t: int) -> Any:
        """Move on by one period."""
        return self.move(x)


class TankPlantParams(DelayPlantParams):
    """Tank, pipe and start."""

    period: float = param(0.01, "sampling period", "s", gt=0.0, le=1.0)
    step: float = param(0.01, "largest integration step", "s", gt=0.0, le=1.0)
    delay: float = param(5.0, "largest delay h of the pipe", "s", ge=0.0, le=1000.0)
    x0: float = param(0.2, "level at and before the start, in the unit of the paper", ge=0.0, le=10.0)
    A: float = param(10.0, "area of the tank", "m^2", gt=0.0, le=1e4)
    phi: float = param(1000.0, "density", "kg/m^3", gt=0.0, le=1e5)
    c: float = param(TANK_C, "drain c of c sqrt(x): sqrt(phi g)/(A phi H), units mixed as in the paper", gt=0.0, le=1.0)
    model: Literal["pwa", "nonlinear"] = param("nonlinear", "drain of two slopes, or of the root")
    switch: float = param(
        0.5,
        "level at which the law changes its gain: for the cell, and what fills the pipe at the start",
        ge=0.0,
        le=10.0,
    )
    k_low: float = param(0.2, "gain below it, of the inflow in the pipe at the start", "1/s", ge=0.0, le=10.0)
    k_high: float = param(0.1, "gain above it, taken away", "1/s", ge=0.0, le=10.0)


class TankPlant(DelayPlant[TankPlantParams]):
    """x' = -c sqrt(x) + u(t - d)/(A phi): a tank at the end of a pipe; an empty one stays at 0 (DRY, an error).

    At the start the pipe contains the output of the law for x0. The values of tank, law and x0 in other nodes are
    compared with these.
    """

    DRAWN_BY = "softrig_systems.pwa_delay.drawing:Tank"
    INPUTS = (INFLOW,)
    OUTPUTS = (LEVEL, mode("tank/mode"))
    SHOWN = "level"
    loop = run_tank
    cell_of = tank_cell

    def names(self) -> Sequence[str]:
        """The level, in the unit of the paper."""
        return ("x",)

    def begin(self) -> tuple[float, ...]:
        """The level, and the output of the control law for it."""
        p, x = self.p, self.p.x0
        return x, x * (p.k_low if x < p.switch else -p.k_high)

    @classmethod
    def agreed(cls, params: TankPlantParams) -> Mapping[str, Any]:
        """Return the controller in the pipe, the effect of a command, and the quantities for the bound of the level."""
        law = law_of_the_tank(params.switch, params.k_low, params.k_high)
        worth = {"tank/A phi": params.A * params.phi}
        return {
            **law,
            **worth,
            "tank/c": params.c,
            "tank/x0": params.x0,
            "tank/model": params.model,
            "tank/delay": min(params.delay, params.max_delay),
        }

    def constants(self, delay: Profile) -> Any:
        """The tank with the inflow as a command."""
        p = self.p
        return TankConstants(p.c, p.switch, p.k_low, p.k_high, 0.0, float(p.model == "pwa"), np.array([FREE]), delay)

    def advance(self, x: Any, t: int, *, inflow: tuple[float, ...]) -> Any:
        """Hold the command for one period; it arrives a delay later."""
        x = self.move(x, inflow[0] / (self.p.A * self.p.phi))
        if x.x <= 0.0:
            self.report(Level.ERROR, "dry", "the tank is DRY: its level stays at 0")
        return x


class PendulumPlantParams(DelayPlantParams):
    """Pendulum and start; its delay is in the loop's delay_line, not here."""

    delay: float = param(0.0, "unused: the pendulum itself has no delay", "s", ge=0.0, le=0.0)
    step: float = param(0.001, "largest integration step", "s", gt=0.0, le=1.0)
    x0: tuple[float, ...] = param((1.0, 0.0), "angle and speed at the start", min_length=2, max_length=2)
    model: Literal["pwa", "nonlinear"] = param("pwa", "two slopes, or sin(theta)")


class PendulumPlant(DelayPlant[PendulumPlantParams]):
    """theta'' = a theta + u, a = -0.825 or -0.4875 by the sign of theta; or theta'' = -sin(theta) + u (per M L^2)."""

    DRAWN_BY = "softrig_systems.pwa_delay.drawing:Pendulum"
    INPUTS = (TORQUE,)
    OUTPUTS = (PENDULUM, mode("pendulum/mode"))
    AGREED = {"pendulum/model": "model"}
    loop = run_pendulum
    cell_of = pendulum_cell

    def names(self) -> Sequence[str]:
        """Angle (rad) and speed (rad/s)."""
        return "theta", "omega"

    def begin(self) -> tuple[float, ...]:
        """Angle, speed, no torque."""
        return (*self.p.x0, 0.0)

    def constants(self, delay: Profile) -> Any:
        """The pendulum with the torque as a command."""
        return PendulumConstants(float(self.p.model == "nonlinear"), 0.0, np.array([FREE]), delay)

    def advance(self, x: Any, t: int, *, torque: tuple[float, ...]) -> Any:
        """Hold the torque for one period."""
        return self.move(x, torque[0])
