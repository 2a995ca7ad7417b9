"""The motor, its inverter and the current converters in front of the controller."""

from __future__ import annotations

from functools import lru_cache
from typing import ClassVar, NamedTuple

from softrig_core import BlockParams, Compiled, Level, Plant, Values, param

from .adc import AdcParams, Converter, draw
from .machine import STATES, MachineConstants, measured, numbers, step_function
from .ports import CURRENTS_MEAS, CURRENTS_TRUE, DC_LINK, FLUX_TRUE, JOINT_STATES, LOAD_TORQUE, SWITCHES
from .switching import VECTORS, voltage

NUMBERS: dict[tuple[float, ...], int] = {v: n for n, v in enumerate(VECTORS)}
SATURATED_SAMPLES = 10
SWITCH_TOLERANCE = 1e-9


@lru_cache(maxsize=16)
def _step(substeps: int) -> Compiled:
    return Compiled(step_function(substeps))


class ImPlantParams(AdcParams, MachineConstants, BlockParams):
    """Machine, inverter and converters."""

    period: float = param(5e-5, "control and sampling period T_s", "s", gt=0.0, le=100.0)
    substeps: int = param(1, "Runge-Kutta steps in one period; one is exact to 2e-10 Wb", ge=1, le=100)
    U_dc: float = param(540.0, "DC-link voltage", "V", gt=0.0, live=True)
    trip_current: float = param(
        28.0, "phase current at which the inverter trips, 4 times the rated peak", "A", gt=0.0, live=True
    )


class State(NamedTuple):
    """Stator and rotor flux linkage in the stator frame (Wb), speed (rad/s), angle (rad).

    Inverter: number of its vector, whether the previous command was refused, and whether it is off for the rest of the
    run. Converters: number of successive samples beyond the range, and number of the sample.
    """

    psi_s_alpha: float = 0.0
    psi_s_beta: float = 0.0
    psi_R_alpha: float = 0.0  # noqa: N815
    psi_R_beta: float = 0.0  # noqa: N815
    omega: float = 0.0
    theta: float = 0.0
    vector: int = 0
    refused: bool = False
    fault: bool = False
    clipped_a: int = 0
    clipped_b: int = 0
    k: int = 0


class ImPlant(Plant[ImPlantParams]):
    """Induction machine on an ideal two-level inverter; see `machine.step_function` for the equations.

    A controller gets only ``currents_meas``, the two converted phase currents y_a, y_b and y_c = -y_a - y_b; the true
    currents and fluxes are on topics of their own.

    The switches act at once and are held for one period. A command with a switch that is neither 0 nor 1 is refused
    and the previous state held for one period; a second one in a row, or a phase current beyond `trip_current`, is a
    fault: the inverter goes to V0 for good.

    The DC-link voltage and the trip may change while it runs; the load is set by its topic.
    """

    DRAWN_BY = "softrig_drives.induction_dtc.drawing:InductionMotor"
    TRIPS: ClassVar[frozenset[str]] = frozenset({"overcurrent", "switch_fault"})
    INPUTS = (SWITCHES, LOAD_TORQUE)
    OUTPUTS = (JOINT_STATES, CURRENTS_TRUE, CURRENTS_MEAS, FLUX_TRUE, DC_LINK)
    STATE = State
    # the unit of errors of the converters, and the pole pairs
    AGREED = {"induction_dtc/lsb": "lsb", "induction_dtc/pole_pairs": "pole_pairs"}

    def setup(self) -> None:
        """Compile the equations, scale the voltages."""
        p = self.p
        self._step = _step(p.substeps)
        self._constants = numbers(p, p.period / p.substeps)
        self._inv_L_sigma = 1.0 / p.L_sigma
        self._voltages = [(u.real, u.imag) for u in (voltage(v) * p.U_dc for v in VECTORS)]
        self._convert = Converter(p)
        self._dc_link = (p.U_dc,)

    def outputs(self, x: State, t: int) -> Values:
        """Return speed, fluxes and currents, and these as they are converted."""
        i_a, i_b, i_c, T_e = measured(x, self._inv_L_sigma, self.p.pole_pairs)
        convert, k = self._convert, x.k
        if self.p.dithered:
            y_a, y_b = convert(i_a, self.uniform(draw(k, 0))), convert(i_b, self.uniform(draw(k, 1)))
        else:
            y_a, y_b = convert(i_a), convert(i_b)
        return {
            "joint_states": (x.theta, x.omega, T_e),
            "currents_true": (i_a, i_b, i_c),
            "currents_meas": (y_a, y_b, -y_a - y_b),
            "flux_true": (x.psi_s_alpha, x.psi_s_beta, 0.0),
            "dc_link": self._dc_link,
        }

    def advance(self, x: State, t: int, *, switches: tuple[float, ...], load_torque: tuple[float, ...] | None) -> State:
        """Hold switches and load torque for one period; without a load torque the shaft is free."""
        vector, refused, fault = (0, False, True) if x.fault else self._inverter(x, switches)
        load = 0.0 if load_torque is None else load_torque[0]
        u = self._voltages[0 if fault else vector]
        result = self._step((*x[:STATES], *u, load, *self._constants))
        psi_s_alpha, psi_s_beta, psi_R_alpha, psi_R_beta, omega, theta, i_a, i_b, i_c, _ = result
        beyond, limit = self._convert.beyond, self.p.trip_current
        clipped_a, clipped_b = x.clipped_a + 1 if beyond(i_a) else 0, x.clipped_b + 1 if beyond(i_b) else 0
        if clipped_a > SATURATED_SAMPLES or clipped_b > SATURATED_SAMPLES:
            self.report(
                Level.WARN,
                "adc_saturated",
                f"ADC saturated: currents {i_a:.3g} A, {i_b:.3g} A are beyond "
                f"{self.p.full_scale:g} A for more than {SATURATED_SAMPLES} samples",
            )
        if not (fault or (-limit <= i_a <= limit and -limit <= i_b <= limit and -limit <= i_c <= limit)):
            fault = True
            self.report(
                Level.ERROR,
                "overcurrent",
                f"phase currents {i_a:.3g}, {i_b:.3g}, {i_c:.3g} A beyond {limit:g} A: inverter tripped to V0 for good",
            )
        return State(psi_s_alpha, psi_s_beta, psi_R_alpha, psi_R_beta, omega, theta, vector, refused, fault, clipped_a,
                     clipped_b, x.k + 1)  # fmt: skip

    def _inverter(self, x: State, switches: tuple[float, ...]) -> tuple[int, bool, bool]:
        """Return the number of the vector, whether the switches were refused, whether that is a fault."""
        vector = NUMBERS.get(switches)
        if vector is None:
            vector = NUMBERS.get(tuple(map(_snap, switches)))
        if vector is not None:
            return vector, False, False
        text = f"switches {switches}, expected 0 or 1 each"
        if x.refused:
            self.report(Level.ERROR, "switch_fault", f"{text}, twice in a row: inverter off for good")
            return 0, False, True
        self.report(Level.ERROR, "bad_switches", f"{text}: command refused, the previous one held")
        return x.vector, True, False


def _snap(switch: float) -> float:
    """Round a switch value that is 0 or 1 within the tolerance."""
    if not abs(switch) < 2.0:
        return switch  # no switch position, and maybe too large for an integer of native code
    rounded = round(switch)
    return float(rounded) if abs(switch - rounded) <= SWITCH_TOLERANCE else switch
