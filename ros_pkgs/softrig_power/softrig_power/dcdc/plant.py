"""Buck and boost converter as a plant."""

from __future__ import annotations

from typing import ClassVar, Literal, NamedTuple

import numpy as np
from softrig_control.profile import StepProfile
from softrig_core import BlockParams, Level, Plant, Values, command, param, resolving_step, scalars, to_ns

from .circuit import advance, output

CONVERTER = scalars("converter", "converter", {"v_out": "V", "i_L": "A", "i_mean": "A", "v_in": "V"})
DUTY = command("duty", "duty", ("switch",), "1")
LOAD = command("load_current", "load_current", ("load",), "A", held=True)


class DcdcPlantParams(BlockParams):
    """Circuit, source and load."""

    topology: Literal["buck", "boost"] = param("buck", "topology of the converter")
    period: float = param(1e-5, "switching and sampling period", "s", gt=0.0, le=0.1)
    substeps: int = param(8, "least number of Runge-Kutta steps in one period", ge=1, le=1000)
    delay: int = param(1, "periods between a measurement and the duty ratio that follows from it", ge=0, le=1)
    synchronous: bool = param(False, "a second switch in place of the diode: the current may be negative")
    U: float = param(28.0, "input voltage", "V", gt=0.0, le=1e5, live=True)
    L: float = param(50e-6, "inductance", "H", gt=0.0, le=10.0)
    L_sat: float = param(1e-5, "inductance in saturation; acts with i_sat > 0", "H", gt=0.0, le=10.0)
    i_sat: float = param(0.0, "current at which the inductance is half way to L_sat; 0: no saturation", "A", ge=0.0)
    C: float = param(500e-6, "capacitance", "F", gt=0.0, le=10.0)
    R_L: float = param(0.0, "resistance of the inductor", "ohm", ge=0.0, le=1e3)
    R_on: float = param(0.0, "resistance of the switch", "ohm", ge=0.0, le=1e3)
    v_diode: float = param(0.0, "forward voltage of the diode", "V", ge=0.0, le=100.0)
    R_C: float = param(0.0, "series resistance of the capacitor", "ohm", ge=0.0, le=1e3)
    R: float = param(3.0, "load resistance", "ohm", gt=0.0, le=1e9, live=True)
    v_0: float = param(0.0, "voltage of the capacitor at t = 0", "V", ge=0.0, le=1e5)
    load_times: tuple[float, ...] = param(
        (0.0,),
        "times at which the load current changes; it acts from the next period on",
        "s",
        each=(0.0, 1e9),
        live=True,
    )
    load_currents: tuple[float, ...] = param(
        (0.0,), "load current besides that of R, from each of these times on", "A", each=(-1e6, 1e6), live=True
    )

    def _check(self) -> None:
        try:
            StepProfile(self.load_times, self.load_currents)
        except ValueError as error:
            raise ValueError(f"load_times, load_currents: {error}") from None
        if self.i_sat and self.L_sat > self.L:
            raise ValueError(f"L_sat = {self.L_sat:g} H: expected at most L = {self.L:g} H")
        self.step()

    def step(self) -> float:
        """Return the largest step of the integration, s."""
        L = self.L_sat if self.i_sat else self.L
        return resolving_step(
            self.period,
            self.substeps,
            ((self.R_L + self.R_on + self.R_C) / L, f"R_L, R_on, R_C and L = {L:g} H"),
            (1.0 / (self.R * self.C), f"R = {self.R:g} ohm, C = {self.C:g} F"),
            (1.0 / (L * self.C) ** 0.5, f"L = {L:g} H, C = {self.C:g} F"),
        )


class State(NamedTuple):
    """Current (A), voltage of the capacitor (V), mean current of the period before (A), duty ratio that waits."""

    i: float = 0.0
    v: float = 0.0
    i_mean: float = 0.0
    duty: float = 0.0


class DcdcPlant(Plant[DcdcPlantParams]):
    """Switched converter with a diode, in continuous or discontinuous conduction; see `circuit.rates`.

    Each period begins with the switch on; the outputs are those of that instant, at the valley of the current. The
    duty ratio is held for one period. The default is the buck converter of Erickson and Maksimovic.
    """

    DRAWN_BY = "softrig_power.dcdc.drawing:Converter"
    TRIPS: ClassVar[frozenset[str]] = frozenset()
    INPUTS = (DUTY, LOAD)
    OUTPUTS = (CONVERTER,)

    def setup(self) -> None:
        """Arrange the constants."""
        p = self.p
        self._m = np.array([p.C, p.L, p.L_sat, p.i_sat, p.R_L, p.R_on, p.v_diode, p.R_C, 1.0 / p.R])
        self._boost = p.topology == "boost"
        self._largest = p.step()
        self._profile = StepProfile(p.load_times, p.load_currents)
        self._period = to_ns(p.period)

    def first(self) -> State:
        """Begin without current."""
        return State(v=self.p.v_0)

    def outputs(self, x: State, t: int) -> Values:
        """Return output voltage, current, mean current of the period before, input voltage."""
        v_out = output(x.i, x.v, 0.0 if self._boost else 1.0, self._profile.at(t), self._m)
        return {"converter": (v_out, x.i, x.i_mean, self.p.U)}

    def advance(self, x: State, t: int, *, duty: tuple[float, ...], load_current: tuple[float, ...] | None) -> State:
        """Move by one period."""
        p, new = self.p, duty[0]
        if not 0.0 <= new <= 1.0:
            self.report(Level.WARN, "clipped", f"duty ratio {new:g}, expected 0 to 1: clipped")
            new = min(max(new, 0.0), 1.0)
        applied = x.duty if p.delay else new
        load = self._profile.at(t) + (0.0 if load_current is None else load_current[0])
        i, v, mean = advance(x.i, x.v, applied, p.U, load, self._boost, p.synchronous, p.period, self._largest, self._m)
        return State(i, v, mean, new)
