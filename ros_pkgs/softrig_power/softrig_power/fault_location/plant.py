"""Node: the simulated line with a fault, as sample streams of both ends and as one record."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from pydantic import model_validator
from softrig_core import BlockParams, Level, Plant, Port, Values, button, param, vector3
from softrig_core.kit.draws import Draws
from softrig_core.kit.newest import Newest

from ..lines.modal import CLARKE
from .line.moving import Moving, Parts
from .line.parameters import RATES, RigParams
from .line.simulation import CHANNELS, FaultedLine
from .ports import record_port, streams
from .records.rows import Rows


class State(NamedTuple):
    """The line at a sample of a record."""

    line: Moving  # the network and the instruments
    k: int  # sample of the record
    number: int  # number of the record, from 0 on
    seed: int  # seed of its noise
    rows: Rows  # values measured at earlier samples, without their noise
    pressed: bool  # whether `run` was pressed


class LinePlantParams(RigParams, BlockParams):
    """The rig, and in which form its record is published."""

    period: float = param(5e-5, "sampling period; follows from measurement.profile", "s", gt=0.0, le=1.0)
    record: bool = param(True, "also publish the whole record once, when its last sample is there")

    @model_validator(mode="before")
    @classmethod
    def _profile_gives_period(cls, values: Any) -> Any:
        if isinstance(values, dict) and "period" not in values:
            measurement = values.get("measurement", {})
            profile = measurement.get("profile") if isinstance(measurement, dict) else measurement.profile
            if profile in RATES:
                return {**values, "period": 1.0 / RATES[profile]}
        return values

    def _check(self) -> None:
        rate = RATES[self.measurement.profile]
        if abs(self.period * rate - 1.0) > 1e-9:
            raise ValueError(
                f"period = {self.period:g} s, but {self.measurement.profile} samples every {1.0 / rate:g} s"
            )


class LinePlant(Plant[LinePlantParams]):
    """A 400 kV line with a fault between two sources; publishes the readings of the instruments at both ends.

    See `simulation.FaultedLine`. The samples at t_k are those of step k of the record; after `duration` the line runs
    on. Pressing `run` starts a new record with a new fault at the next sample.

    Notes
    -----
    H. Faramarzi, N. Ghaffarzadeh, A New Whale Optimization Algorithm-Based Fault Location Method; the network around
    the line is not from the paper.
    """

    DRAWN_BY = "softrig_power.fault_location.drawing:FaultedLine"
    # for the comparison: the true place of the fault, and the length of the line, km
    AGREED = {"fault_location/x_km": "fault.x_km", "fault_location/length": "line.length"}

    @classmethod
    def ports(cls, params: LinePlantParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """The four streams, the current of the fault itself, and the record with as many rows as it has samples."""
        outputs = (*streams(), vector3("fault_current", "line/fault_current", "abc", "A"))
        return (button("run", "line/run", held=True),), (*outputs, *((record_port(params.samples),) * params.record))

    def setup(self) -> None:
        """Prepare the network in its steady state, and its noise; compile the step before the first tick."""
        p = self.p
        line = FaultedLine(p)
        self._begin = Moving(Parts(line.net, line.chain, CLARKE), line.state)
        self._steps = p.decimation
        self._last, self._rate = p.samples - 1, RATES[p.measurement.profile]
        self._begin.moved(0, 1)
        self._level = line.noise_level().tolist()
        # by the numbers that seed it: nothing else decides it
        self._noise: Newest[int, Draws] = Newest(lambda seed: Draws((p.measurement.seed, seed), "standard_normal"))

    def first(self) -> State:
        """Begin a record in the steady state."""
        return self._new(0, pressed=False)

    def go_on(self, x: State, before: LinePlantParams) -> State:
        """Keep the state of the line; changed parameters act from the next step on."""
        return x._replace(line=Moving(self._begin.parts, x.line.state))

    def _new(self, number: int, *, pressed: bool) -> State:
        seed = int(self.generator().integers(2**32, size=number + 1)[-1])
        return State(self._begin, 0, number, seed, Rows(self.p.samples, CHANNELS), pressed)

    def _row(self, k: int, seed: int, measured: Sequence[float]) -> tuple[float, ...]:
        """Return the instrument readings of a sample: its time, and the values with noise."""
        messages = tuple([u + 0.0 for u in measured])
        if self.p.measurement.noise_snr_db is not None:
            normal, offset = self._noise(seed), CHANNELS * k
            messages = tuple(
                [u + s * normal(offset + c) for c, (u, s) in enumerate(zip(messages, self._level, strict=True))]
            )
        return (k / self._rate, *messages)

    def outputs(self, x: State, t: int) -> Values:
        """Return the samples; with the last one of a record the record."""
        row, fault = self._row(x.k, x.seed, x.line.measured()), x.line.fault_current()
        if self.p.record and x.k == self._last:
            return {"u_s": row[1:4], "i_s": row[4:7], "u_r": row[7:10], "i_r": row[10:13], "fault_current": fault,
                    "record": self._record(x, row)}  # fmt: skip
        return {"u_s": row[1:4], "i_s": row[4:7], "u_r": row[7:10], "i_r": row[10:13], "fault_current": fault}

    def _record(self, x: State, row: tuple[float, ...]) -> tuple[float, ...]:
        before = (self._row(k, x.seed, measured) for k, measured in enumerate(x.rows.newest()))
        return tuple(value for sample in (*before, row) for value in sample)

    def advance(self, x: State, t: int, *, run: tuple[float, ...] | None) -> State:
        """Move by one sampling period, or start again."""
        pressed = run is not None and run[0] != 0.0
        if pressed and not x.pressed:
            self.report(Level.OK, "run", "a new record begins")
            return self._new(x.number + 1, pressed=True)
        # until the record is full, the measurements of the instruments are stored
        rows = x.rows.put(x.line.measured()) if x.k < self._last else x.rows
        line = x.line.moved(x.k * self._steps, self._steps)
        return State(line, x.k + 1, x.number, x.seed, rows, pressed)
