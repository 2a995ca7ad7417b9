"""Photovoltaic string, buck-boost converter and load."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal, NamedTuple

from softrig_core import BlockParams, Level, Plant, Port, Values, check_steps, command, param, scalars
from softrig_core.kit.dense import total

from .array import ArrayParams, possible, split
from .converter import Circuit, Converter, ConverterParams, steady_state
from .ports import array_port, environment

PHASE_STEPS = 8  # Runge-Kutta steps in each of the two circuits of a switching period


class PvPlantParams(ArrayParams, BlockParams):
    """String, converter, load, and how they are integrated."""

    period: float = param(0.001, "sampling period of the voltage and current sensors", "s", gt=0.0, le=100.0)
    converter: ConverterParams = ConverterParams()
    d_min: float = param(0.1, "lower limit of the duty; the state starts steady there", gt=0.0, lt=1.0)
    d_max: float = param(0.9, "upper limit of the duty", gt=0.0, lt=1.0, live=True)
    model: Literal["averaged", "switched"] = param("averaged", "averaged over a switching period, or switch by switch")
    step: float = param(2e-5, "averaged: step of the integration", "s", gt=0.0)
    noise: float = param(0.0, "standard deviation of the measured voltage and current, relative", ge=0.0, live=True)

    def _check(self) -> None:
        if self.d_min >= self.d_max:
            raise ValueError(f"d_min = {self.d_min:g} is not below d_max = {self.d_max:g}")
        inner, name = (self.step, "step") if self.model == "averaged" else (1.0 / self.converter.f_sw, "1/f_sw")
        check_steps(self.period, inner, name)
        if abs(self.period / inner - round(self.period / inner)) > 1e-6 or self.period < 0.5 * inner:
            raise ValueError(f"period = {self.period:g} s is not a multiple of {name} = {inner:g} s")


class State(NamedTuple):
    """State from tick to tick."""

    v: float
    """Voltage of the input capacitor, V."""

    i_L: float  # noqa: N815
    """Inductor current, A."""

    v_o: float
    """Magnitude of the output voltage, V."""

    conditions: tuple[float, ...]
    """Irradiance (W/m^2) and temperature (deg C) of each module."""

    k: int = 0
    """Random numbers drawn."""


class PvPlant(Plant[PvPlantParams]):
    """Modules in series, each with a bypass diode, feed a resistive load through a buck-boost converter.

    See `module.cell`, `string.characteristic` and `converter.Converter` for the equations. ``pv/port`` has the sensor
    readings (the current is positive when the string generates) and the mean cell temperature. ``converter/state`` has
    the true state and the string's power. The initial state is steady at the duty `d_min`.

    Notes
    -----
    Four MSX-60 modules of J. Farzaneh, A. Karsaz (2020).
    """

    DRAWN_BY = "softrig_power.pv.drawing:PvString"
    # 0.2 s, which is five periods of a tracker at 25 Hz; the plant's own period is that of the sensors.
    STALE_PERIODS: ClassVar[int] = 200

    @classmethod
    def agreed(cls, params: PvPlantParams) -> Mapping[str, Any]:
        """The string."""
        return params.agreed()

    @classmethod
    def ports(cls, params: PvPlantParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Declare one irradiance and one temperature per module; near open circuit without a valid command."""
        duty = command("duty", "converter/duty", ("duty",), "1", safe=(params.d_min,))
        state = scalars("converter", "converter/state", {"v_in": "V", "i_L": "A", "v_out": "V", "p_in": "W"})
        return (duty, environment(len(params.irradiance), held=True)), (array_port("port"), state)

    def setup(self) -> None:
        """Steps of a period."""
        p = self.p
        self._source = p.sources()
        self._converter = Converter(p.converter)
        self._switching = 1.0 / p.converter.f_sw
        self._steps = round(p.period / (p.step if p.model == "averaged" else self._switching))

    def first(self) -> State:
        """Steady state at d_min under the conditions of the parameters."""
        p = self.p
        conditions = p.irradiance + p.temperature
        return State(*steady_state(p.converter, self._source(conditions), p.d_min), conditions)

    def outputs(self, x: State, t: int) -> Values:
        """Return the sensors and the true converter state."""
        v, i = x.v, self._source(x.conditions).current(x.v)
        state = (v, x.i_L, x.v_o, v * i)
        if self.p.noise:
            noise, normal = self.p.noise, self.standard_normal
            v, i = v * (1.0 + noise * normal(x.k)), i * (1.0 + noise * normal(x.k + 1))
        temperature = split(x.conditions)[1]
        return {"port": (v, i, total(temperature) / len(temperature)), "converter": state}

    def advance(self, x: State, t: int, *, duty: tuple[float], environment: tuple[float, ...] | None) -> State:
        """Move by one period under the duty, in the newest conditions."""
        p, conditions = self.p, x.conditions
        if environment is not None and environment != conditions and possible(self, environment):
            conditions = environment
        d = min(max(duty[0], p.d_min), p.d_max)
        if d != duty[0]:
            self.report(Level.WARN, "duty", f"the duty {duty[0]:g} is outside [{p.d_min:g}, {p.d_max:g}]: clipped")
        source, move = self._source(conditions), self._converter.step
        circuit = Circuit(x.v, x.i_L, x.v_o)
        if p.model == "averaged":
            circuit = move(circuit, source, d, p.step, self._steps)
        else:  # the two circuits of a switching period in turn
            on, off = d * self._switching / PHASE_STEPS, (1.0 - d) * self._switching / PHASE_STEPS
            for _ in range(self._steps):
                circuit = move(move(circuit, source, 1.0, on, PHASE_STEPS), source, 0.0, off, PHASE_STEPS)
        return State(*circuit, conditions, x.k + 2 if p.noise else x.k)
