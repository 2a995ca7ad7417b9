"""Controller of a series converter: active and reactive power of its circuit."""

from __future__ import annotations

import cmath
import math
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

from softrig_control.filters import Filtered, SecondOrderFilter
from softrig_control.phase_locked_loop import Locked, PhaseLockedLoop, PllParams
from softrig_core import Block, Level, Port, Values, param

from .operating_point import DeviceParams, operating_point
from .ports import SERIES, SERIES_REFERENCE, measured

# In pu. Below this the current reference is not computed from the voltage any more, for it would grow without bound.
LEAST_VOLTAGE = 0.1


class State(NamedTuple):
    """Integral and newest error, rotated to the requested voltage (pu); loop; filters of u and i; newest command."""

    integral: complex
    error: complex
    locked: Locked
    u: Filtered[complex]
    i: Filtered[complex]
    command: tuple[float, float, float]


class SeriesControllerParams(DeviceParams):
    """Law and gains."""

    circuit: Literal[1, 2] = param(1, "circuit 1 (u2, i12) or 2 (u4, i34)", ge=1, le=2)
    law: Literal["integral", "printed"] = param("integral", "quadrature integral law, or PI axis by axis as printed")
    kp: float = param(0.5, "proportional gain of the printed law", "pu/pu", ge=0.0, le=100.0, live=True)
    ki: float = param(15.0, "integral gain", "1/s", ge=0.0, le=1e4, live=True)
    filter_frequency: float = param(
        30.0, "natural frequency of the filters, integral law", "Hz", ge=1.0, le=500.0, live=True
    )
    damping: float = param(0.7, "damping of the filters", ge=0.1, le=2.0, live=True)
    pll: PllParams = PllParams()


class SeriesController(Block[SeriesControllerParams]):
    r"""Current regulator in the frame of a phase-locked loop on the voltage behind the converter.

    With the current reference :math:`i_{ref} = ((P_{ref} + jQ_{ref})/u)^*`:

    - ``integral``: :math:`v = j K_i \int (i_{ref} - i)\,dt`, u and i filtered. The path is inductive, so that the d
      error asks for q voltage and the q error for -d.
    - ``printed``: :math:`v = K_p (i_{ref} - i) + K_i \int (i_{ref} - i)\,dt`, axis by axis, u and i as measured. With
      the printed gains it excites the resonance of the half lines and ends in a limit cycle at the limiter.

    \|v\| is at most `network.series_limit`; the part beyond it is subtracted from the integrator.

    A change of gains causes no jump: the integral is kept in units of v and compensates the effect of the new Kp. The
    steady state of the start, which is the same in all nodes, cannot change.
    """

    @classmethod
    def agreed(cls, params: SeriesControllerParams) -> Mapping[str, Any]:
        """The steady state in which all start."""
        return params.agreed()

    @classmethod
    def ports(cls, params: SeriesControllerParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Return the ports of its circuit."""
        u, i = ("u2", "i12") if params.circuit == 1 else ("u4", "i34")
        return (measured(u), measured(i), SERIES_REFERENCE[params.circuit]), (SERIES[params.circuit],)

    def setup(self) -> None:
        """Solve the power flow of the start."""
        p = self.p
        point, first = operating_point(p), p.circuit == 1
        self._point = point
        self._u, self._i, self._v = (point.u2, point.i12, point.v12) if first else (point.u4, point.i34, point.v34)
        self._asked = complex(p.initial.p1, p.initial.q1) if first else complex(p.initial.p2, p.initial.q2)
        self._voltage, self._current, _ = (port.name for port in self.ports(p)[0])
        self._name = SERIES[p.circuit].name
        # the direction of the voltage that reduces an error of the current
        self._turn = 1j if p.law == "integral" else 1.0
        self._kp = self._gain(p)
        self._pll = PhaseLockedLoop(p.pll, p.network.omega, p.period)
        self._filter = SecondOrderFilter(2.0 * math.pi * p.filter_frequency, p.damping, p.period)

    @staticmethod
    def _gain(p: SeriesControllerParams) -> float:
        return p.kp if p.law == "printed" else 0.0

    def go_on(self, x: State, before: SeriesControllerParams) -> State:
        """Continue with other gains without a jump; filters and loop keep their states."""
        kp = self._gain(before)
        if self._kp != kp and self.p.ki:
            return x._replace(integral=x.integral + (kp - self._kp) * x.error)
        return x

    def first(self) -> State:
        """Integrator, filters and loop as in the steady state."""
        p = self.p
        theta = cmath.phase(self._u)
        back = cmath.rect(1.0, -theta)
        locked = self._pll.first(theta)
        u_x, i_x = self._filter.first(self._u * back), self._filter.first(self._i * back)
        for u, i in self._point.past(self._voltage, self._current):
            locked, angle = self._pll(locked, u)
            back = cmath.rect(1.0, -angle)
            u_x, _ = self._filter(u_x, u * back)
            i_x, _ = self._filter(i_x, i * back)
        integral = self._v * cmath.rect(1.0, -theta)
        return State(integral, 0j, locked, u_x, i_x, (abs(self._v), cmath.phase(self._v), p.network.omega))

    def update(self, x: State, t: int, *, reference: tuple[float, ...] | None, **inputs: Any) -> tuple[State, Values]:
        """Answer one tick; P and Q are those of the parameters until a reference arrives."""
        p = self.p
        asked = self._asked if reference is None else complex(reference[0], reference[1])
        u, i = (complex(s[0], s[1]) for s in (inputs[self._voltage], inputs[self._current]))
        locked, theta = self._pll(x.locked, u, self.unanswered)
        back = cmath.rect(1.0, -theta)
        u_x, i_x = x.u, x.i
        u, i = u * back, i * back
        if p.law == "integral":
            u_x, u = self._filter(u_x, u)
            i_x, i = self._filter(i_x, i)
        if abs(u) < LEAST_VOLTAGE:
            u = LEAST_VOLTAGE + 0j
        error = self._turn * ((asked / u).conjugate() - i)
        integral = x.integral + p.ki * p.period * error
        v = self._kp * error + integral
        limit = p.network.series_limit
        if abs(v) > limit:
            self.report(
                Level.WARN,
                "series_voltage_limited",
                f"series voltage at its limit of {limit:g} pu while "
                f"{asked:g} pu is asked for and {(u * i.conjugate()):.4g} pu flows",
            )
            cut = v * (limit / abs(v))
            integral += cut - v
            v = cut
        command = (abs(v), math.remainder(theta + cmath.phase(v), math.tau), locked.omega)
        return State(integral, error, locked, u_x, i_x, command), {self._name: command}

    def refused(self, x: State, t: int) -> tuple[State, Values]:
        """Turn the last voltage on."""
        magnitude, angle, omega = x.command
        command = (magnitude, math.remainder(angle + self.p.period * omega, math.tau), omega)
        return x._replace(command=command), {self._name: command}
