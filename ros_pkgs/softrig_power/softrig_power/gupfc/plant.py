"""The line with the GUPFC: lines, sources, converters and DC link."""

from __future__ import annotations

import cmath
import math
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from softrig_core import Level, Plant, Port, array, executable, param, state_type
from softrig_core.kit import dense

from .circuit import BUS1, BUS2, BUS4, I12, I34, I_SH, State, advance, circuit
from .measurement import Weights
from .operating_point import DeviceParams, conduction, operating_point
from .ports import DC_LINK, SERIES, SHUNT, STATUS, TRACE, measured

CONVERTERS = ("shunt", "series_1", "series_2")
VECTORS = {"u1": BUS1, "u2": BUS2, "u4": BUS4, "i_sh": I_SH, "i12": I12, "i34": I34}
MAGNITUDE_LIMIT = 1.2  # pu, of a series command that can be meant
FREQUENCY_LIMIT = (0.5, 1.5)  # of nominal, of a command that can be meant
TRIP = (0.5, 1.3)  # pu, of the DC voltage


BRANCHES = ("A", "B", "12", "34", "sh")  # of circuit.State.i
STATE = state_type(("", ["v_dc"]), ("i", [f"{b}_{part}" for b in BRANCHES for part in ("alpha", "beta")]))


class GupfcPlantParams(DeviceParams):
    """Network, waveform, steps, and what is published."""

    trace: bool = param(False, "publish gupfc/trace, waveforms at every step of the circuit")


class GupfcPlant(Plant[GupfcPlantParams]):
    """Double-circuit line with a shunt and two series converters on one DC link; see `circuit` for the equations.

    Source 2, bus A, 200 km, bus 1, series converter 1, bus 2, 200 km, bus B, source 1; circuit 2 likewise over buses 3
    and 4; the shunt converter at bus 1. The voltages of bus 1, 2, 4 and the converters' currents are published as
    means over the control period, see `measurement`.

    A command holds the amplitude (shunt: conduction angle sigma, series: magnitude, turned into sigma with the DC
    voltage of the tick) and the angle, which turns on with omega. A command that cannot be meant is replaced by the
    last good one for one period, then its converter is blocked until a good one comes: a series converter is bypassed,
    the shunt converter keeps sigma and follows bus 1. A DC voltage outside 0.5 to 1.3 pu trips: the shunt converter is
    disconnected, the series converters are bypassed, the DC link is frozen, for good.

    Notes
    -----
    M. Abasi, M. Joorabian, A. Saffarian, S. G. Seifossadat, A Novel Complete Dynamic and Static Model of 48-Pulse
    VSC-based GUPFC for Parallel Transmission Lines, 2020.
    """

    STALE_PERIODS: ClassVar[int] = 3

    @classmethod
    def drawing(cls) -> Any:
        """Give what draws it."""
        from .drawing import Gupfc

        return Gupfc

    @classmethod
    def agreed(cls, params: GupfcPlantParams) -> Mapping[str, Any]:
        """The steady state in which all start."""
        return params.agreed()

    @classmethod
    def ports(cls, params: GupfcPlantParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Three commands; six vectors, DC link, status, and the trace if asked for."""
        trace = array("trace", "gupfc/trace", {"step": params.substeps, "part": 2 * len(TRACE)}, "pu")
        outputs = (*(measured(name) for name in VECTORS), DC_LINK, STATUS)
        return (SHUNT, SERIES[1], SERIES[2]), (*outputs, trace) if params.trace else outputs

    def setup(self) -> None:
        """Constants of the steps, and the operating point."""
        p = self.p
        self._circuit, self._lines = circuit(p.network, p.step)
        self._weights = Weights(p.network.omega, p.step, p.substeps)
        self._point = operating_point(p)

    def start(self) -> None:
        """Steady state at the references of the parameters, as if its last command had always held."""
        p = self.p
        point, begin = self._point, self._point.start
        self._sigma = np.array(
            [p.network.shunt_sigma, *(self._conduction(v, point.v_dc) for v in (point.v12, point.v34))]
        )
        self._omega = np.full(3, p.network.omega)
        self._angle = np.array([cmath.phase(v) for v in (point.v_sh, point.v12, point.v34)]) - p.period * self._omega
        self._bad = [0, 0, 0]
        self.tripped = False
        self._steps = 0
        self._state = State(*[x.copy() for x in begin.state])  # type: ignore[arg-type]
        rows = slice(-p.substeps - 1, None)
        self._bus, self._current, self._converter = (
            x[rows].copy() for x in (begin.bus, begin.current, begin.converter)
        )
        between = 0.5 * (self._current[1:] + self._current[:-1])[:, [I_SH, I12, I34]]
        self._power = dense.times(self._converter[1:], between.conj()).real.mean(axis=0)
        self._sense()

    def _conduction(self, v: complex, v_dc: float) -> float:
        return conduction(abs(v), v_dc, self.p.network.series_limit)

    @property
    def state(self) -> Any:
        """Give DC voltage and branch currents (pu) of now; the waves on the lines count as well."""
        parts = (part for i in self._state.i.tolist() for part in (i.real, i.imag))
        return STATE(float(self._state.v_dc[0]), *parts)

    def outputs(self, t: int) -> Mapping[str, tuple[float, ...]]:
        """Give the measured vectors, the DC voltage and the status at t."""
        return self._answer

    def advance(
        self, t: int, shunt: tuple[float, ...], series_1: tuple[float, ...], series_2: tuple[float, ...]
    ) -> None:
        """Move by one control period."""
        p = self.p
        for k, command in enumerate((shunt, series_1, series_2)):
            self._take(k, command)
        self._power = advance(
            self._circuit, self._lines, self._state, self._steps, self._sigma, self._angle, self._omega, p.pulse,
            self.tripped, self._bus, self._current, self._converter,
        )  # fmt: skip
        self._steps += p.substeps
        v_dc = float(self._state.v_dc[0])
        if not self.tripped and not TRIP[0] <= v_dc <= TRIP[1]:
            self.tripped = True
            text = f"DC voltage {v_dc:.4g} pu, outside {TRIP[0]:g} to {TRIP[1]:g} pu: tripped"
            self.report(Level.ERROR, "trip", text)
            self._state.i[I_SH] = 0.0
        self._sense()

    def _take(self, k: int, command: tuple[float, ...]) -> None:
        """Take the command of converter k over, or what stands in for it."""
        p = self.p
        amplitude, angle, omega = command
        nominal = p.network.omega
        highest = math.pi * (1.0 + 1e-12) if k == 0 else MAGNITUDE_LIMIT
        if (
            0.0 <= amplitude <= highest
            and FREQUENCY_LIMIT[0] * nominal <= omega <= FREQUENCY_LIMIT[1] * nominal
        ):  # fmt: skip
            self._bad[k] = 0
            v_dc = float(self._state.v_dc[0])
            self._sigma[k] = amplitude if k == 0 else self._conduction(amplitude, max(v_dc, TRIP[0]))
            self._angle[k], self._omega[k] = angle, omega
            return
        self._bad[k] += 1
        self._angle[k] = math.remainder(self._angle[k] + p.period * self._omega[k], math.tau)
        text = f"{CONVERTERS[k]}: command {tuple(command)} cannot be meant"
        if self._bad[k] == 1:
            self.report(Level.WARN, f"{CONVERTERS[k]}_held", f"{text}: the last one holds for a period")
            return
        self.report(Level.ERROR, f"{CONVERTERS[k]}_blocked", f"{text}, twice in a row: converter blocked")
        if k == 0:
            self._angle[0], self._omega[0] = cmath.phase(self._vectors["u1"]), nominal
        else:
            self._sigma[k] = 0.0

    def _sense(self) -> None:
        """Prepare the outputs."""
        bus, current = self._weights(self._bus), self._weights(self._current)
        vectors = {name: complex((bus if name[0] == "u" else current)[k]) for name, k in VECTORS.items()}
        self._vectors = vectors
        v_dc = float(self._state.v_dc[0])
        s1, s2 = vectors["u2"] * vectors["i12"].conjugate(), vectors["u4"] * vectors["i34"].conjugate()
        limit = self.p.network.series_limit * v_dc
        v12, v34 = (0.0 if self.tripped else limit * math.sin(0.5 * s) for s in self._sigma[1:].tolist())
        self._answer: dict[str, tuple[float, ...]] = {name: (v.real, v.imag, 0.0) for name, v in vectors.items()}
        self._answer["dc_link"] = (v_dc * self.p.network.dc_voltage,)
        self._answer["status"] = (s1.real, s1.imag, s2.real, s2.imag, abs(vectors["u1"]), v_dc, *self._power.tolist(),
                                  v12, v34)  # fmt: skip
        if self.p.trace:
            rows = (self._converter[1:, 0], self._converter[1:, 1], self._bus[1:, BUS1], self._current[1:, I_SH])
            parts = np.column_stack([part for row in rows for part in (row.real, row.imag)])
            self._answer["trace"] = tuple(parts.ravel().tolist())


main = executable(GupfcPlant)
