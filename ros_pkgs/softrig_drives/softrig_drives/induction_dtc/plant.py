"""The motor, its inverter and the current converters in front of the controller."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from softrig_core import BlockParams, Compiled, Level, Plant, executable, param

from .adc import AdcParams, Converter
from .machine import STATES, MachineConstants, State, measured, numbers, step_function
from .ports import CURRENTS_MEAS, CURRENTS_TRUE, DC_LINK, FLUX_TRUE, JOINT_STATES, LOAD_TORQUE, SWITCHES
from .switching import VECTORS, voltage

V0 = VECTORS[0]
SATURATED_SAMPLES = 10
SWITCH_TOLERANCE = 1e-9


class ImPlantParams(AdcParams, MachineConstants, BlockParams):
    """Machine, inverter and converters."""

    period: float = param(5e-5, "control and sampling period T_s", "s", gt=0.0, le=100.0)
    substeps: int = param(1, "Runge-Kutta steps in one period; one is exact to 2e-10 Wb", ge=1, le=100)
    U_dc: float = param(540.0, "DC-link voltage", "V", gt=0.0, live=True)
    trip_current: float = param(
        28.0, "phase current at which the inverter trips, 4 times the rated peak", "A", gt=0.0, live=True
    )


class ImPlant(Plant[ImPlantParams]):
    """Induction machine on an ideal two-level inverter; see `machine.step_function` for the equations.

    A controller gets only ``currents_meas``, the two converted phase currents y_a, y_b and y_c = -y_a - y_b; the true
    currents and fluxes are on topics of their own.

    The switches act at once and are held for one period. A command with a switch that is neither 0 nor 1 is refused
    and the previous state held for one period; a second one in a row, or a phase current beyond `trip_current`, is a
    fault: the inverter goes to V0 for good.

    The DC-link voltage and the trip may change while it runs; the load comes by its topic.
    """

    INPUTS = (SWITCHES, LOAD_TORQUE)
    OUTPUTS = (JOINT_STATES, CURRENTS_TRUE, CURRENTS_MEAS, FLUX_TRUE, DC_LINK)

    @classmethod
    def agreed(cls, params: ImPlantParams) -> Mapping[str, Any]:
        """What its converters resolve, in which their errors are counted, and what makes torque of flux and current."""
        return {"induction_dtc/lsb": params.lsb, "induction_dtc/pole_pairs": params.pole_pairs}

    @classmethod
    def drawing(cls) -> Any:
        """Give what draws it."""
        from .drawing import InductionMotor

        return InductionMotor

    def setup(self) -> None:
        """Compile the equations, scale the voltages."""
        p = self.p
        self._step = Compiled(step_function(p.substeps))
        self._constants = numbers(p, p.period / p.substeps)
        vectors = {v: voltage(v) * p.U_dc for v in VECTORS}
        self._voltages: dict[tuple[float, ...], tuple[float, float]] = {v: (u.real, u.imag) for v, u in vectors.items()}
        self._converters = Converter(p), Converter(p)
        self._dc_link = (p.U_dc,)

    def change(self, params: ImPlantParams) -> None:
        """Scale the voltages anew; the converters go on."""
        converters = self._converters
        super().change(params)
        self._converters = converters
        self._answer["dc_link"] = self._dc_link

    def start(self) -> None:
        """Rest without flux; the inverter in V0."""
        for converter in self._converters:
            converter.start(self.rng)
        self._u = self._voltages[V0]
        self._refused = False
        self.fault = False
        self._sense((0.0,) * STATES, 0.0, 0.0, 0.0, 0.0)

    @property
    def state(self) -> State:
        """Give fluxes, speed and angle."""
        return State(*self._x)

    def put(self, state: Sequence[float]) -> None:
        """Go on from another state."""
        x = State(*state)
        self._sense(x, *measured(x, 1.0 / self.p.L_sigma, self.p.pole_pairs))

    def outputs(self, t: int) -> Mapping[str, tuple[float, ...]]:
        """Give speed, currents and fluxes at t."""
        return self._answer

    def advance(self, t: int, *, switches: tuple[float, ...], load_torque: tuple[float, ...] | None) -> None:
        """Hold switches and load torque for one period; without a load torque the shaft is free."""
        u = self._inverter(switches)
        load = 0.0 if load_torque is None else load_torque[0]
        found = self._step((*self._x, *u, load, *self._constants))
        self._sense(found[:STATES], *found[STATES:])

    def _inverter(self, switches: tuple[float, ...]) -> tuple[float, float]:
        """Give u_alpha, u_beta (V)."""
        u = self._voltages.get(switches)
        if u is None:
            u = self._voltages.get(tuple(map(_snap, switches)))
        if self.fault:
            return self._voltages[V0]
        if u is not None:
            self._refused = False
            self._u = u
            return u
        text = f"switches {switches}, expected 0 or 1 each"
        if self._refused:
            self.fault = True
            self.report(Level.ERROR, "switch_fault", f"{text}, twice in a row: inverter off for good")
            return self._voltages[V0]
        self._refused = True
        self.report(Level.ERROR, "bad_switches", f"{text}: command refused, the previous one held")
        return self._u

    def _sense(self, x: tuple[float, ...], i_a: float, i_b: float, i_c: float, T_e: float) -> None:
        """Prepare the outputs, convert the currents, supervise them."""
        self._x = x
        psi_s_alpha, psi_s_beta, _, _, omega, theta = x
        convert_a, convert_b = self._converters
        y_a, y_b = convert_a(i_a), convert_b(i_b)
        self._answer = {
            "joint_states": (theta, omega, T_e),
            "currents_true": (i_a, i_b, i_c),
            "currents_meas": (y_a, y_b, -y_a - y_b),
            "flux_true": (psi_s_alpha, psi_s_beta, 0.0),
            "dc_link": self._dc_link,
        }
        if convert_a.clipped > SATURATED_SAMPLES or convert_b.clipped > SATURATED_SAMPLES:
            self.report(Level.WARN, "adc_saturated", f"ADC saturated: currents {i_a:.3g} A, {i_b:.3g} A are beyond "
                        f"{self.p.full_scale:g} A for more than {SATURATED_SAMPLES} samples")  # fmt: skip
        limit = self.p.trip_current
        if not (-limit <= i_a <= limit and -limit <= i_b <= limit and -limit <= i_c <= limit):
            if not self.fault:
                self.report(Level.ERROR, "overcurrent", f"phase currents {i_a:.3g}, {i_b:.3g}, {i_c:.3g} A beyond "
                            f"{limit:g} A: inverter tripped to V0 for good")  # fmt: skip
            self.fault = True


def _snap(switch: float) -> float:
    """Round a switch value that is 0 or 1 within the tolerance."""
    whole = round(switch)
    return float(whole) if abs(switch - whole) <= SWITCH_TOLERANCE else switch


main = executable(ImPlant)
