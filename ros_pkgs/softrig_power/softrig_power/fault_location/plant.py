"""Node: the simulated line with a fault, as sample streams of both ends and as one record."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Self

import numpy as np
from pydantic import model_validator
from softrig_core import BlockParams, Level, Plant, Port, button, executable, param, state_type, vector3

from .parameters import RATES, RigParams
from .ports import record_port, streams
from .record import GROUPS
from .simulation import FaultedLine

ENDS = [f"{end}_{mode}" for end in "SR" for mode in ("0", "alpha", "beta")]
STATE = state_type(("i", ENDS), ("v", ENDS))  # of the sources, in modes: currents (A), voltages across impedances (V)


class LinePlantParams(RigParams, BlockParams):
    """The rig, and in which form its record is published."""

    period: float = param(5e-5, "sampling period; follows from measurement.profile", "s", gt=0.0, le=1.0)
    record: bool = param(True, "also publish the whole record once, when its last sample is there")

    @model_validator(mode="before")
    @classmethod
    def _profile_gives_period(cls, given: Any) -> Any:
        if isinstance(given, dict) and "period" not in given:
            measurement = given.get("measurement", {})
            profile = measurement.get("profile") if isinstance(measurement, dict) else measurement.profile
            if profile in RATES:
                return {**given, "period": 1.0 / RATES[profile]}
        return given

    @model_validator(mode="after")
    def _period_of_profile(self) -> Self:
        rate = RATES[self.measurement.profile]
        if abs(self.period * rate - 1.0) > 1e-9:
            raise ValueError(
                f"period = {self.period:g} s, but {self.measurement.profile} samples every {1.0 / rate:g} s"
            )
        return self


class LinePlant(Plant[LinePlantParams]):
    """Source, 400 kV line with a fault, source; what the instruments of both ends tell.

    See `simulation.FaultedLine`. The samples at t_k are those of step k of the record; after `duration` the line runs
    on. Pressing `run` starts a new record with a new fault at the next sample.

    Notes
    -----
    H. Faramarzi, N. Ghaffarzadeh, A New Whale Optimization Algorithm-Based Fault Location Method; the network around
    the line is ours.
    """

    @classmethod
    def drawing(cls) -> Any:
        """Give what draws it."""
        from .drawing import FaultedLine

        return FaultedLine

    @classmethod
    def agreed(cls, params: LinePlantParams) -> Mapping[str, Any]:
        """What it is told against: the true place of the fault, and the length of the line, km."""
        return {"fault_location/x_km": params.fault.x_km, "fault_location/length": params.line.length}

    @classmethod
    def ports(cls, params: LinePlantParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """The four streams, the current of the fault itself, and the record with as many rows as it has samples."""
        outputs = (*streams(), vector3("fault_current", "line/fault_current", "abc", "A"))
        return (button("run", "line/run", held=True),), (*outputs, *((record_port(params.samples),) * params.record))

    def setup(self) -> None:
        """Prepare the network; compile the step before the first tick."""
        self.line = FaultedLine(self.p)
        self.line.advance(1)

    def start(self) -> None:
        """Begin a record in the steady state."""
        self._pressed = False
        self._begin()

    def _begin(self) -> None:
        self.line.reset()
        self._noise = np.random.default_rng([self.p.measurement.seed, int(self.rng.integers(2**32))])
        self._rows: list[tuple[float, ...]] = []
        self._sample()

    def _sample(self) -> None:
        """Read the instruments; as long as the record is not full, keep what they say."""
        self._now = tuple((self.line.state.measured + self.line.noise(self._noise, 1)[0]).tolist())
        self._new = len(self._rows) < self.p.samples
        if self._new:
            self._rows.append((len(self._rows) / RATES[self.p.measurement.profile], *self._now))

    @property
    def state(self) -> Any:
        """Give the sources' currents and voltages of now; the waves on the line count as well."""
        now = self.line.state
        return STATE(*now.source_current.ravel().tolist(), *now.source_voltage.ravel().tolist())

    def outputs(self, t: int) -> Mapping[str, tuple[float, ...] | None]:
        """Give the samples; with the last one of a record the record."""
        found: dict[str, tuple[float, ...] | None] = {
            name: self._now[3 * k : 3 * k + 3] for k, name in enumerate(GROUPS)
        }
        found["fault_current"] = tuple(self.line.state.fault_current.tolist())
        if self._new and len(self._rows) == self.p.samples:
            found["record"] = tuple(x for row in self._rows for x in row)
        return found

    def advance(self, t: int, run: tuple[float, ...] | None) -> None:
        """Move by one sampling period, or begin anew."""
        pressed = run is not None and run[0] != 0.0
        if pressed and not self._pressed:
            self.report(Level.OK, "run", "a new record begins")
            self._begin()
        else:
            self.line.advance(self.p.decimation)
            self._sample()
        self._pressed = pressed


main = executable(LinePlant)
