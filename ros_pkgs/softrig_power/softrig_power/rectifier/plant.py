"""The rectifier between grid and load, in three models."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from softrig_core import BlockParams, Level, Plant, Port, Values, check_steps, param, to_ns

from . import ports
from .circuit import INJECTION, SPWM, Circuit, Period, grid, phases
from .measured import AVERAGED, BRIDGE, SWITCHED, How, Sums
from .parameters import RectifierConstants
from .quality import CYCLES, FIGURES


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
    i_start: float | None = param(
        None, "current i_d at the start (peak), i_q is 0; that of the operating point when absent", "A", ge=-1e4, le=1e4
    )
    v_least: float = param(1.0, "DC voltage at which the converter is shut down", "V", gt=0.0, le=1e3, live=True)
    waveform: bool = param(False, "send the waveforms of each period")

    def _check(self) -> None:
        check_steps(self.period, self.substep, "substep")
        if self.carrier_hz < 10.0 * self.f:
            raise ValueError(f"carrier_hz = {self.carrier_hz:g} Hz: expected at least ten times f = {self.f:g} Hz")
        # A load beyond what the grid can carry has no operating point, so it is refused before the run.
        _ = self.i_first

    @property
    def i_first(self) -> float:
        """Current at the start: `i_start`, or that of the operating point of these constants."""
        return self.current if self.i_start is None else self.i_start

    @property
    def steps(self) -> int:
        """Internal steps in one period."""
        return max(1, math.ceil(self.period / self.substep - 1e-9))


@dataclass(frozen=True)
class Record:
    """Measurements that do not act on the plant, so they are excluded from its linearisation.

    Attributes
    ----------
    sums : Sums
        Of the window under way.
    figures : tuple
        As `FIGURES`.
    trace : tuple
        Waveforms of the newest period; empty unless requested.
    """

    sums: Sums
    figures: tuple[float, ...]
    trace: tuple[float, ...]


@dataclass(frozen=True)
class Events:
    """Held inputs: load (ohm), grid amplitude and its fifth harmonic (V). Not part of a linear view."""

    load: float
    amplitude: float
    fifth: float


class StateDq(NamedTuple):
    """Currents in the frame of the grid voltage (A, peak), DC voltage (V).

    `applied`: the reference of the period before (A), empty where the command is no reference. `end`: of the period
    before, ns. `collapsed`: whether the switches are off for the rest of the run.
    """

    i_d: float
    i_q: float
    v: float
    applied: tuple[float, ...]
    events: Events
    end: int
    collapsed: bool
    record: Record

    @property
    def moving(self) -> tuple[float, ...]:
        """Return the integrated state of a period."""
        return self.i_d, self.i_q, self.v


class StateAbc(NamedTuple):
    """Phase currents (A), DC voltage (V); further fields as in `StateDq`."""

    i_a: float
    i_b: float
    i_c: float
    v: float
    applied: tuple[float, ...]
    events: Events
    end: int
    collapsed: bool
    record: Record

    @property
    def moving(self) -> tuple[float, ...]:
        """Return the integrated state of a period."""
        return self.i_a, self.i_b, self.i_c, self.v


State = StateDq | StateAbc


class RectifierPlant(Plant[RectifierPlantParams]):
    """Three-phase six-switch rectifier with its modulator.

    The equations are in `averaged` and `switched`, the modulator's in `circuit`. The command of t_k acts from t_k on
    for one period. Events (load resistance, grid amplitude, amplitude of the fifth harmonic) take effect with the
    command: the first period that begins at or after an event has the new value; the parameters give the initial
    values.

    In realtime a command older than 5 periods is held with a warning; one older than 20 is replaced by V' = 0.

    A command of exactly 0 means that the switches are off (a trip, lost commands). The diodes parallel to them form a
    bridge, which feeds the load and keeps the link at the peak between two phases, less the voltage that the load
    current causes across L.

    ``power_quality`` has the figures of the last whole six grid cycles (zeros before the first are over).

    The limits of the input stop a command that is not finite or beyond 10,000. An impossible value of an event is
    refused, and the last valid one stays in force. When the DC voltage falls below `v_least`, the switches stay off for
    the rest of the run, and only the diodes conduct.
    """

    DRAWN_BY = "softrig_power.rectifier.drawing:Rectifier"
    TRIPS = frozenset({"collapse"})
    # In real time a command older than this is replaced by 0, so that a dead controller does not drive the converter.
    STALE_PERIODS = 20
    # A command older than this is held with a warning.
    LATE_PERIODS = 5

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
        self._circuit = Circuit.of(p.omega, p.L, p.R, p.C, p.phi)
        self._reach = INJECTION if p.injection else SPWM
        self._forward = 1.0 if p.feedforward == "instantaneous" else 0.0
        self._window = CYCLES / p.f
        self._period = to_ns(p.period)  # ns
        self._late = self.LATE_PERIODS * self._period
        kind = SWITCHED if p.model == "switched" else AVERAGED
        self._on = How(kind, p.steps, self._window, p.carrier_hz, p.injection)
        self._off = self._on._replace(kind=BRIDGE)
        self._dq = p.model == "averaged_dq"

    def first(self) -> State:
        """Begin at the given voltage and current, on the nominal grid and load."""
        p = self.p
        abc = phases(p.i_first, 0.0, 0.0)
        trace = (*abc, 0.0, p.v_start) * p.steps if p.waveform else ()
        record = Record(Sums.first(), (0.0,) * len(FIGURES), trace)
        applied = (p.i_first,) if p.structure == "decoupled" else ()
        events = Events(p.R_L, p.V_g, 0.0)
        if self._dq:
            return StateDq(p.i_first, 0.0, p.v_start, applied, events, 0, False, record)
        return StateAbc(*abc, p.v_start, applied, events, 0, False, record)

    def outputs(self, x: State, t: int) -> Values:
        """Return DC link, currents and voltages of the phases, power quality at t."""
        seconds = t / 1e9
        now = self._period_at(x, x.events, seconds, 0.0)
        link, voltage = (x.v, x.v / x.events.load), grid(seconds, self._circuit, now)
        current = phases(x[0], x[1], self._circuit.omega * seconds) if self._dq else (x[0], x[1], x[2])
        quality = x.record.figures
        if self.p.waveform:
            return {"dc_link": link, "grid_current": current, "grid_voltage": voltage, "power_quality": quality,
                    "waveform": x.record.trace}  # fmt: skip
        return {"dc_link": link, "grid_current": current, "grid_voltage": voltage, "power_quality": quality}

    def _period_at(self, x: State, events: Events, start: float, command: float) -> Period:
        p = self.p
        decoupled = p.structure == "decoupled"
        before = x.applied[0] if decoupled else 0.0
        return Period(
            start,
            p.period,
            events.amplitude,
            events.fifth,
            events.load,
            self._reach,
            self._forward,
            decoupled,
            before,
            command,
        )

    def advance(self, x: State, t: int, *, command: tuple[float, ...], events: tuple[float, ...] | None) -> State:
        """Hold the command over one period."""
        p, collapsed = self.p, x.collapsed
        held = x.events if events is None else self._accepted(events, x.events)
        if (self.age("command") or 0) > self._late:
            self.report(Level.WARN, "late", f"command older than {self.LATE_PERIODS} periods is held")
        wanted = 0.0 if collapsed else command[0]
        if wanted == 0.0:
            self.report(Level.WARN, "off", "switches off: the diodes carry the current")
        row, record = self._move(x, held, t, wanted)
        v = row[-1]
        if not collapsed and not p.v_least < v < math.inf:
            collapsed = True
            self.report(Level.ERROR, "collapse", f"DC voltage {v:g} V, below {p.v_least:g} V: converter shut down")
            v = p.v_least
        applied = (command[0],) if x.applied else ()
        end = t + self._period
        # A converter that has just been given up begins without current.
        flows = 0.0 if v != row[-1] else 1.0
        if self._dq:
            return StateDq(flows * row[0], flows * row[1], v, applied, held, end, collapsed, record)
        return StateAbc(flows * row[0], flows * row[1], flows * row[2], v, applied, held, end, collapsed, record)

    def _move(self, x: State, events: Events, t: int, command: float) -> tuple[tuple[float, ...], Record]:
        """Return currents and voltage a period after t (ns), and the sums measured in between."""
        record, start = x.record, t / 1e9
        sums = record.sums
        # After a pause of the host in real time the periods are not consecutive, so the sums start again.
        if 2 * abs(t - x.end) > self._period:
            sums = sums.begun(float(math.floor(start / self._window + 1e-9)))
        now, how = self._period_at(x, events, start, command), self._off if command == 0.0 else self._on
        row = x.moving
        if self.p.waveform:
            rows = self._rows()
            row, sums, figures, trace = sums.traced(row, how, self._circuit, now, record.figures, rows)
            return row, Record(sums, figures, trace)
        row, sums, figures = sums.moved(row, how, self._circuit, now, record.figures)
        return row, Record(sums, figures, ())

    def _rows(self) -> Any:
        import numpy as np

        return np.empty((self.p.steps, len(ports.WAVEFORM_CHANNELS)))

    def _accepted(self, events: tuple[float, ...], before: Events) -> Events:
        load, amplitude, fifth = events
        if load > 0.0 and amplitude > 0.0:
            return Events(load, amplitude, fifth)
        self.report(
            Level.ERROR,
            "bad_event",
            f"load {load:g} ohm, grid {amplitude:g} V: expected both positive; the last good ones hold",
        )
        return before
