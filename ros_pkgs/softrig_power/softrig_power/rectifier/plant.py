"""The rectifier between grid and load, in three models."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple, Self

from pydantic import model_validator
from softrig_core import BlockParams, Level, Plant, Port, check_steps, executable, param, to_ns

from . import averaged, diodes, ports, switched
from .circuit import INJECTION, SPWM, Circuit, Period, grid, phases, turned
from .parameters import RectifierConstants
from .quality import CYCLES, FIGURES, PLAIN, TIME, WINDOWS, empty, figures


class RectifierPlantParams(RectifierConstants, BlockParams):
    """Model, structure and modulator, and where to begin."""

    period: float = param(0.00083, "control period T", "s", gt=0.0, le=0.1)
    model: Literal["averaged_dq", "averaged_abc", "switched"] = param(
        "averaged_dq", "averaged in the frame of the grid voltage or by phase, or with six switches"
    )
    structure: Literal["sensorless", "decoupled"] = param(
        "sensorless", "command is the drop V' (channel v_drop) or a current reference (channel i_ref)"
    )
    feedforward: Literal["fundamental", "instantaneous"] = param(
        "fundamental", "grid voltage that the modulator knows: the amplitude, or the measured fifth harmonic as well"
    )
    injection: bool = param(False, "min-max zero sequence: |v_r| up to 1.1547 v/2 instead of v/2")
    carrier_hz: float = param(1e4, "frequency of the triangular carrier", "Hz", ge=100.0, le=1e6)
    substep: float = param(1e-5, "longest internal step", "s", gt=0.0, le=1e-3)
    v_start: float = param(400.0, "DC voltage at the start", "V", gt=0.0, le=1e4)
    i_start: float | None = param(None, "current i_d at the start (peak), i_q is 0; that of the operating point when "
                                  "absent", "A", ge=-1e4, le=1e4)  # fmt: skip
    v_least: float = param(1.0, "DC voltage at which the converter is given up", "V", gt=0.0, le=1e3, live=True)
    waveform: bool = param(False, "send the waveforms of each period")

    @model_validator(mode="after")
    def _carrier(self) -> Self:
        check_steps(self.period, self.substep, "substep")
        if self.carrier_hz < 10.0 * self.f:
            raise ValueError(f"carrier_hz = {self.carrier_hz:g} Hz: expected at least ten times f = {self.f:g} Hz")
        _ = self.i_first  # a load that the grid cannot carry has no operating point to begin at
        return self

    @property
    def i_first(self) -> float:
        """Current at the start: `i_start`, or that of the operating point of these constants."""
        return self.current if self.i_start is None else self.i_start

    @property
    def steps(self) -> int:
        """Internal steps in one period."""
        return max(1, math.ceil(self.period / self.substep - 1e-9))


class StateDq(NamedTuple):
    """Currents in the frame of the grid voltage (A, peak), DC voltage (V)."""

    i_d: float
    i_q: float
    v: float


class StateAbc(NamedTuple):
    """Phase currents (A), DC voltage (V)."""

    i_a: float
    i_b: float
    i_c: float
    v: float


class RectifierPlant(Plant[RectifierPlantParams]):
    """Three-phase six-switch rectifier with its modulator.

    The equations are in `averaged` and `switched`, the modulator's in `circuit`. The command of t_k acts from t_k on
    for one period. Events (load resistance, grid amplitude, amplitude of the fifth harmonic) are taken with the
    command: the first period that begins at or after an event sees the new value; the parameters are the start.

    In realtime a command older than 5 periods is held with a warning; one older than 20 is replaced by V' = 0.

    A command of exactly 0 is the word for switches off (a trip, lost commands): the diodes beside them are a bridge,
    which feeds the load and holds the link at the peak between two phases, less what the load draws through L.

    ``power_quality`` has the figures of the last whole six grid cycles (zeros before the first are over).

    A command that is not finite or beyond 10,000 never gets here by a node; an event that is no possible value is
    refused and the last good one holds. When the DC voltage collapses below `v_least` the converter is given up: its
    switches stay off, the diodes carry on.
    """

    STALE_PERIODS = 20  # realtime: an older command is replaced by 0
    LATE_PERIODS = 5  # older than this it is held with a warning

    @classmethod
    def drawing(cls) -> Any:
        """Give what draws it."""
        from .drawing import Rectifier

        return Rectifier

    @classmethod
    def ports(cls, params: RectifierPlantParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """The command's channel depends on the structure."""
        command = ports.I_REF if params.structure == "decoupled" else ports.V_DROP
        outputs = [ports.DC_LINK, ports.GRID_CURRENT, ports.GRID_VOLTAGE, ports.POWER_QUALITY]
        if params.waveform:
            outputs.append(ports.waveform(params.steps))
        return (command, ports.events(params.R_L, params.V_g)), tuple(outputs)

    def setup(self) -> None:
        """Prepare the constants."""
        p = self.p
        self._circuit = Circuit(p.omega, p.L, p.R, p.C, p.phi)
        self._reach = INJECTION if p.injection else SPWM
        self._forward = 1.0 if p.feedforward == "instantaneous" else 0.0
        self._window = CYCLES / p.f
        self._late = self.LATE_PERIODS * to_ns(p.period)

    def start(self) -> None:
        """Begin at the given voltage and current, on the nominal grid and load."""
        import numpy as np

        p = self.p
        abc = phases(p.i_first, 0.0, 0.0)
        self._x = np.array((p.i_first, 0.0, p.v_start) if p.model == "averaged_dq" else (*abc, p.v_start))
        self._legs = np.zeros(3)
        self._sums, self._complete = empty(), empty()
        self._trace = np.zeros((p.steps if p.waveform else 0, len(ports.WAVEFORM_CHANNELS)))
        self._trace[:] = (*abc, 0.0, p.v_start)
        self._end = 0.0
        self._before = p.i_first
        self._load, self._amplitude, self._fifth = p.R_L, p.V_g, 0.0
        self._figures: tuple[float, ...] = (0.0,) * len(FIGURES)
        self.collapsed = False

    @property
    def state(self) -> Any:
        """Give currents and DC voltage."""
        return (StateDq if self.p.model == "averaged_dq" else StateAbc)(*self._x.tolist())

    def put(self, state: Sequence[float]) -> None:
        """Go on from another state."""
        self._x[:] = state

    def outputs(self, t: int) -> Mapping[str, tuple[float, ...]]:
        """Give DC link, currents and voltages of the phases, power quality at t."""
        seconds = t / 1e9
        v = float(self._x[-1])
        now = self._period_at(seconds, 0.0)
        found: dict[str, tuple[float, ...]] = {
            "dc_link": (v, v / self._load),
            "grid_current": averaged.read(seconds, self._x, self._circuit)[:3],
            "grid_voltage": grid(seconds, self._circuit, now),
            "power_quality": self._figures,
        }
        if self.p.waveform:
            found["waveform"] = tuple(self._trace.ravel().tolist())
        return found

    def _period_at(self, start: float, command: float) -> Period:
        p = self.p
        decoupled = p.structure == "decoupled"
        return Period(start, p.period, self._amplitude, self._fifth, self._load, self._reach, self._forward, decoupled,
                      self._before, command)  # fmt: skip

    def advance(self, t: int, *, command: tuple[float, ...], events: tuple[float, ...] | None) -> None:
        """Hold the command over one period."""
        p = self.p
        if events is not None:
            self._take(events)
        start = t / 1e9
        if (self.age("command") or 0) > self._late:
            self.report(Level.WARN, "late", f"command older than {self.LATE_PERIODS} periods is held")
        wanted = 0.0 if self.collapsed else command[0]
        if wanted == 0.0:
            self.report(Level.WARN, "off", "switches off: the diodes carry the current")
        v = self._move(start, wanted)
        self._before = command[0]
        complete = self._complete[PLAIN]
        if complete[WINDOWS] != self._figures[0] and complete[TIME] > 0.999 * self._window:
            self._figures = tuple(figures(self._complete).values())
        if not p.v_least < v < math.inf:
            self._collapse(v)

    def _move(self, start: float, command: float) -> float:
        """Move the state over the period from `start` (s); give the DC voltage."""
        p = self.p
        if abs(start - self._end) > 0.5 * p.period:
            self._skip(start)
        self._end = start + p.period
        both = (self._circuit, self._period_at(start, command))
        if command == 0.0:
            return self._rectify(start, both)
        if p.model == "switched":
            return switched.advance(self._x, self._legs, p.steps, self._window, both, p.carrier_hz, p.injection,
                                    self._sums, self._complete, self._trace)  # fmt: skip
        return averaged.advance(self._x, p.steps, self._window, both, self._sums, self._complete, self._trace)

    def _rectify(self, start: float, both: tuple[Circuit, Period]) -> float:
        """Move over the period with the switches off."""
        import numpy as np

        p = self.p
        x = np.array(averaged.read(start, self._x, self._circuit))
        v = diodes.advance(x, p.steps, self._window, both, self._sums, self._complete, self._trace)
        self._legs[:] = 0.0
        if self._x.size == len(x):
            self._x[:] = x
        else:
            self._x[:] = (*turned(x[0], x[1], x[2], self._circuit.omega * self._end), v)
        return v

    def _skip(self, start: float) -> None:
        """Begin with the sums anew: time does not go on where it was (realtime after a pause of the host)."""
        self._sums = empty()
        self._sums[PLAIN, WINDOWS] = math.floor(start / self._window + 1e-9)

    def _take(self, events: tuple[float, ...]) -> None:
        load, amplitude, fifth = events
        if load > 0.0 and amplitude > 0.0:
            self._load, self._amplitude, self._fifth = load, amplitude, fifth
        else:
            self.report(Level.ERROR, "bad_event", f"load {load:g} ohm, grid {amplitude:g} V: expected both positive; "
                        "the last good ones hold")  # fmt: skip

    def _collapse(self, v: float) -> None:
        if self.collapsed:
            return
        self.collapsed = True
        self.report(Level.ERROR, "collapse", f"DC voltage {v:g} V, below {self.p.v_least:g} V: converter given up")
        self._x[:] = 0.0
        self._x[-1] = self.p.v_least


main = executable(RectifierPlant)
