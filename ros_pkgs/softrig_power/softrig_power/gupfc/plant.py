"""The line with the GUPFC: lines, sources, converters and DC link."""

from __future__ import annotations

import cmath
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray
from softrig_core import SECOND, Level, Plant, Port, Values, array, param
from softrig_core.kit import dense

from .circuit import BUS1, BUS2, BUS4, I12, I34, I_SH, Rows, State as Network, Turning, circuit, moved
from .measurement import Weights
from .operating_point import DeviceParams, conduction, operating_point
from .ports import DC_LINK, SERIES, SHUNT, STATUS, TRACE, measured

CONVERTERS = ("shunt", "series_1", "series_2")
VECTORS = ("u1", "u2", "u4", "i_sh", "i12", "i34")
# In pu. A larger series command is impossible and is rejected.
MAGNITUDE_LIMIT = 1.2
FREQUENCY_LIMIT = (0.5, 1.5)  # multiples of the nominal frequency that a command may have
TRIP = (0.5, 1.3)  # pu, of the DC voltage


@dataclass(frozen=True)
class Command:
    """Input of a converter: conduction angle, angle (rad), its speed (rad/s), and the number of bad commands."""

    sigma: float
    angle: float
    omega: float
    bad: int = 0


@dataclass(frozen=True, eq=False)
class Window:
    """The newest period at every step, whose means are the outputs, and its power. It is read-only."""

    rows: Rows
    power: NDArray[np.float64]


class State(NamedTuple):
    """Waves, voltages and currents (never written in place); commands; number of steps; whether the DC link tripped."""

    network: Network
    commands: tuple[Command, Command, Command]
    seen: Window
    steps: int = 0
    tripped: bool = False


class GupfcPlantParams(DeviceParams):
    """Network, waveform, steps, and the published outputs."""

    trace: bool = param(False, "publish gupfc/trace, waveforms at every step of the circuit")


class GupfcPlant(Plant[GupfcPlantParams]):
    """Double-circuit line with a shunt and two series converters on one DC link; see `circuit` for the equations.

    Source 2, bus A, 200 km, bus 1, series converter 1, bus 2, 200 km, bus B, source 1; circuit 2 likewise over buses 3
    and 4; the shunt converter at bus 1. The voltages of bus 1, 2, 4 and the converters' currents are published as
    means over the control period, see `measurement`.

    A command holds the amplitude (shunt: conduction angle sigma, series: magnitude, turned into sigma with the DC
    voltage of the tick) and the angle, which turns on with omega. An invalid command is replaced by the last valid one
    for one period. Then its converter is blocked until a valid command arrives: a series converter is bypassed, the
    shunt converter keeps sigma and follows bus 1. A DC voltage outside 0.5 to 1.3 pu trips the device for the rest of
    the run: the shunt converter is disconnected, the series converters are bypassed, and the DC link is frozen.

    Notes
    -----
    M. Abasi, M. Joorabian, A. Saffarian, S. G. Seifossadat, A Novel Complete Dynamic and Static Model of 48-Pulse
    VSC-based GUPFC for Parallel Transmission Lines, 2020.
    """

    DRAWN_BY = "softrig_power.gupfc.drawing:Gupfc"
    STALE_PERIODS: ClassVar[int] = 3
    AWAITS_COMMAND: ClassVar[bool] = True

    @classmethod
    def agreed(cls, params: GupfcPlantParams) -> Mapping[str, Any]:
        """The steady state in which all start."""
        return params.agreed()

    @classmethod
    def ports(cls, params: GupfcPlantParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Declare three commands; six vectors, DC link, status, and the trace on request."""
        trace = array("trace", "gupfc/trace", {"step": params.substeps, "part": 2 * len(TRACE)}, "pu")
        outputs = (*(measured(name) for name in VECTORS), DC_LINK, STATUS)
        return (SHUNT, SERIES[1], SERIES[2]), (*outputs, trace) if params.trace else outputs

    def setup(self) -> None:
        """Constants of the steps, and the operating point."""
        p = self.p
        self._circuit, self._lines = circuit(p.network, p.step)
        self._weights = Weights(p.network.omega, p.step, p.substeps)
        self._point = point = operating_point(p)
        begin, rows = point.start, slice(-p.substeps - 1, None)
        window = Rows(*(row[rows].copy() for row in (begin.bus, begin.current, begin.converter)))
        between = 0.5 * (window.current[1:] + window.current[:-1])[:, [I_SH, I12, I34]]
        power = dense.times(window.converter[1:], between.conj()).real.mean(axis=0)
        sigmas = (p.network.shunt_sigma, *(self._conduction(v, point.v_dc) for v in (point.v12, point.v34)))
        omega = p.network.omega
        shunt, series_1, series_2 = (
            Command(sigma, cmath.phase(v) - p.period * omega, omega)
            for sigma, v in zip(sigmas, (point.v_sh, point.v12, point.v34), strict=True)
        )
        self._begin = State(begin.state, (shunt, series_1, series_2), Window(window, power))

    def first(self) -> State:
        """Return the steady state at the references of the parameters, as if its last command had always acted."""
        return self._begin

    def _conduction(self, v: complex, v_dc: float) -> float:
        return conduction(abs(v), v_dc, self.p.network.series_limit)

    def outputs(self, x: State, t: int) -> Values:
        """Return the measured vectors, the DC voltage and the status at t."""
        window = x.seen
        rows = window.rows
        buses, branches = self._weights(rows.bus), self._weights(rows.current)
        u1, u2, u4 = complex(buses[BUS1]), complex(buses[BUS2]), complex(buses[BUS4])
        i_sh, i12, i34 = complex(branches[I_SH]), complex(branches[I12]), complex(branches[I34])
        v_dc = float(x.network.v_dc[0])
        s1, s2 = u2 * i12.conjugate(), u4 * i34.conjugate()
        limit = self.p.network.series_limit * v_dc
        v12, v34 = (0.0 if x.tripped else limit * math.sin(0.5 * c.sigma) for c in x.commands[1:])
        messages: dict[str, tuple[float, ...]] = {
            "u1": (u1.real, u1.imag, 0.0),
            "u2": (u2.real, u2.imag, 0.0),
            "u4": (u4.real, u4.imag, 0.0),
            "i_sh": (i_sh.real, i_sh.imag, 0.0),
            "i12": (i12.real, i12.imag, 0.0),
            "i34": (i34.real, i34.imag, 0.0),
            "dc_link": (v_dc * self.p.network.dc_voltage,),
            "status": (s1.real, s1.imag, s2.real, s2.imag, abs(u1), v_dc, *window.power.tolist(), v12, v34),
        }
        if self.p.trace:
            shown = (rows.converter[1:, 0], rows.converter[1:, 1], rows.bus[1:, BUS1], rows.current[1:, I_SH])
            components = np.column_stack([component for row in shown for component in (row.real, row.imag)])
            messages["trace"] = tuple(components.ravel().tolist())
        return messages

    def advance(
        self, x: State, t: int, *, shunt: tuple[float, ...], series_1: tuple[float, ...], series_2: tuple[float, ...]
    ) -> State:
        """Move by one control period."""
        p, tripped = self.p, x.tripped
        commands = (
            self._accepted(x, 0, shunt, self.age("shunt")),
            self._accepted(x, 1, series_1, self.age("series_1")),
            self._accepted(x, 2, series_2, self.age("series_2")),
        )
        a, b, c = commands
        turning = Turning(
            np.array((a.sigma, b.sigma, c.sigma)),
            np.array((a.angle, b.angle, c.angle)),
            np.array((a.omega, b.omega, c.omega)),
        )
        network, rows, power = moved(
            self._circuit, self._lines, x.network, x.seen.rows, x.steps, turning, p.pulse, tripped
        )
        v_dc = float(network.v_dc[0])
        if not tripped and not TRIP[0] <= v_dc <= TRIP[1]:
            tripped = True
            text = f"DC voltage {v_dc:.4g} pu, outside {TRIP[0]:g} to {TRIP[1]:g} pu: tripped"
            self.report(Level.ERROR, "trip", text)
            network.i[I_SH] = 0.0
        return State(network, commands, Window(rows, power), x.steps + p.substeps, tripped)

    def _accepted(self, x: State, k: int, command: tuple[float, ...], age: int | None) -> Command:
        """Return the command of converter k, which is `age` ns old, or its replacement."""
        p, last = self.p, x.commands[k]
        amplitude, angle, omega = command
        # In real time no command may have arrived since the start.
        if age is None:
            return Command(last.sigma, math.remainder(last.angle + p.period * last.omega, math.tau), last.omega)
        # In real time a command may be of an earlier tick, and its angle is that of its own tick.
        if age > 0:
            angle = math.remainder(angle + omega * (age / SECOND), math.tau)
        nominal = p.network.omega
        highest = math.pi * (1.0 + 1e-12) if k == 0 else MAGNITUDE_LIMIT
        if 0.0 <= amplitude <= highest and FREQUENCY_LIMIT[0] * nominal <= omega <= FREQUENCY_LIMIT[1] * nominal:
            v_dc = float(x.network.v_dc[0])
            return Command(amplitude if k == 0 else self._conduction(amplitude, max(v_dc, TRIP[0])), angle, omega)
        bad = last.bad + 1
        angle = math.remainder(last.angle + p.period * last.omega, math.tau)
        text = f"{CONVERTERS[k]}: command {tuple(command)} is implausible"
        if bad == 1:
            self.report(Level.WARN, f"{CONVERTERS[k]}_held", f"{text}: the last one holds for a period")
            return Command(last.sigma, angle, last.omega, bad)
        self.report(Level.ERROR, f"{CONVERTERS[k]}_blocked", f"{text}, twice in a row: converter blocked")
        if k == 0:
            return Command(last.sigma, cmath.phase(self._weights(x.seen.rows.bus)[BUS1]), nominal, bad)
        return Command(0.0, angle, last.omega, bad)
