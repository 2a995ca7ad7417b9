"""Controller of the shunt converter: voltage of bus 1 through the angle of the converter voltage."""

from __future__ import annotations

import cmath
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from softrig_control.filters import Filtered, SecondOrderFilter
from softrig_control.phase_locked_loop import Locked, PhaseLockedLoop, PllParams
from softrig_control.pid import Pid, PidParams, PidState
from softrig_core import Block, Level, Values, param

from .operating_point import DeviceParams, operating_point
from .ports import SHUNT, SHUNT_REFERENCE, measured


class State(NamedTuple):
    """Loop on u1; filters of its magnitude and of the reactive current (pu); both regulators; newest command."""

    locked: Locked
    magnitude: Filtered[float]
    reactive: Filtered[float]
    voltage: PidState
    current: PidState
    command: tuple[float, float, float]


class ShuntControllerParams(DeviceParams):
    """Gains of Table 1."""

    pll: PllParams = PllParams()
    filter_frequency: float = param(100.0, "natural frequency f_n of the filters", "Hz", ge=1.0, le=500.0, live=True)
    damping: float = param(0.7, "damping of the filters", ge=0.1, le=2.0, live=True)
    voltage_kp: float = param(12.0, "voltage regulator, pu of current a pu of voltage", ge=0.0, le=1e3, live=True)
    voltage_ki: float = param(150.0, "voltage regulator, integral", "1/s", ge=0.0, le=1e5, live=True)
    current_kp: float = param(5.0, "current regulator, deg a pu of current", "deg", ge=0.0, le=1e3, live=True)
    current_ki: float = param(1.0, "current regulator, integral", "deg/s", ge=0.0, le=1e5, live=True)
    current_limit: float = param(2.0, "limit of the reactive current", "pu", gt=0.0, le=100.0, live=True)
    angle_limit: float = param(30.0, "limit of alpha", "deg", gt=0.0, le=90.0, live=True)


class ShuntController(Block[ShuntControllerParams]):
    r"""Two cascaded regulators: the reactive current that the voltage needs, the angle that the current needs.

    .. math::
        i_{q,ref} &= PI(v_{ref} - |u_1|), & i_q &= -\Im(i_{sh} e^{-j\theta}) \\
        \alpha &= -PI(i_{q,ref} - i_q), & \angle v_{sh} &= \theta + \alpha

    An angle that lags draws active power and charges the DC link, which raises the converter voltage in proportion;
    sigma stays. Magnitude and current are filtered, theta is that of a phase-locked loop on u1. The integrators start
    at the operating point of the parameters, which cannot change while it runs. A change of gains causes no jump, see
    `softrig_control.pid.Pid.go_on`.
    """

    INPUTS = (measured("u1"), measured("i_sh"), SHUNT_REFERENCE)
    OUTPUTS = (SHUNT,)

    @classmethod
    def agreed(cls, params: ShuntControllerParams) -> Mapping[str, Any]:
        """The steady state in which all start."""
        return params.agreed()

    def setup(self) -> None:
        """Solve the power flow of the start."""
        p = self.p
        self._point = operating_point(p)
        self._voltage = Pid(PidParams(kp=p.voltage_kp, ki=p.voltage_ki, u_max=p.current_limit), p.period)
        self._current = Pid(PidParams(kp=p.current_kp, ki=p.current_ki, u_max=p.angle_limit), p.period)
        self._pll = PhaseLockedLoop(p.pll, p.network.omega, p.period)
        self._filter = SecondOrderFilter(2.0 * math.pi * p.filter_frequency, p.damping, p.period)

    def go_on(self, x: State, before: ShuntControllerParams) -> State:
        """Continue with other gains without a jump; filters and loop keep their states."""
        return x._replace(
            voltage=self._voltage.after_kp(x.voltage, before.voltage_kp),
            current=self._current.after_kp(x.current, before.current_kp),
        )

    def first(self) -> State:
        """Integrators, filters and loop as in the steady state."""
        p = self.p
        u1, alpha = self._point.u1, math.degrees(cmath.phase(self._point.v_sh / self._point.u1))
        i_q = -(self._point.i_sh * u1.conjugate()).imag / abs(u1)
        locked = self._pll.first(cmath.phase(u1))
        magnitude, reactive = self._filter.first(abs(u1)), self._filter.first(i_q)
        for u, i in self._point.past("u1", "i_sh"):
            locked, theta = self._pll(locked, u)
            magnitude, _ = self._filter(magnitude, abs(u))
            reactive, _ = self._filter(reactive, -(i * cmath.rect(1.0, -theta)).imag)
        command = (p.network.shunt_sigma, cmath.phase(self._point.v_sh), p.network.omega)
        return State(locked, magnitude, reactive, PidState(i_q), PidState(-alpha), command)

    def update(
        self, x: State, t: int, *, u1: tuple[float, ...], i_sh: tuple[float, ...], reference: tuple[float, ...] | None
    ) -> tuple[State, Values]:
        """Answer one tick; v_ref is that of the parameters until a reference arrives."""
        p = self.p
        v_ref = p.initial.v if reference is None else reference[0]
        u = complex(u1[0], u1[1])
        locked, theta = self._pll(x.locked, u, self.unanswered)
        magnitude, v = self._filter(x.magnitude, abs(u))
        q = -(complex(i_sh[0], i_sh[1]) * cmath.rect(1.0, -theta)).imag
        reactive, i_q = self._filter(x.reactive, q)
        voltage, i_q_ref = self._voltage(x.voltage, v_ref - v)
        if abs(i_q_ref) > p.current_limit:
            wanted = f"{v_ref:g} pu is asked of a voltage of {v:.4g} pu"
            i_q_ref = self._limited(i_q_ref, p.current_limit, "reactive_current", "pu", wanted)
        current, alpha = self._current(x.current, i_q_ref - i_q)
        if abs(alpha) > p.angle_limit:
            wanted = f"{i_q_ref:.4g} pu is asked of a reactive current of {i_q:.4g} pu"
            alpha = self._limited(alpha, p.angle_limit, "angle", "deg", wanted)
        angle = math.remainder(theta + math.radians(-alpha), math.tau)
        command = (p.network.shunt_sigma, angle, locked.omega)
        return State(locked, magnitude, reactive, voltage, current, command), {"shunt": command}

    def _limited(self, x: float, limit: float, quantity: str, unit: str, wanted: str) -> float:
        text = f"{quantity.replace('_', ' ')} at its limit of {limit:g} {unit} while {wanted}"
        self.report(Level.WARN, f"{quantity}_limited", text)
        return math.copysign(limit, x)

    def refused(self, x: State, t: int) -> tuple[State, Values]:
        """Turn the last voltage on."""
        sigma, angle, omega = x.command
        command = (sigma, math.remainder(angle + self.p.period * omega, math.tau), omega)
        return x._replace(command=command), {"shunt": command}
