"""The motor on its four asymmetric half bridges."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
from softrig_control.hardware import axis_urdf, hardware_tag
from softrig_core import Array, BlockParams, Level, Marker, Plant, Values, jit, param

from .machine import N_PHASES, STATES, Geometry, Mechanics, Vector, advance, distance, phase
from .markers import stator, translator
from .ports import FORCE_PHASES, JOINT_STATES, LOAD, PHASE_CURRENTS, PHASE_VOLTAGE, TRANSLATOR

Step = tuple[float, float, float, float, float, float, float, float, float, float, float]


@dataclass(frozen=True)
class Load:
    """Added mass (kg) and friction (N) of the newest good message: a held input, not part of a linear view."""

    values: tuple[float, float] = (0.0, 0.0)


class State(NamedTuple):
    """Flux linkages of the phases (Wb), position (m), speed (m/s); load; whether the half bridges have tripped."""

    psi_a: float = 0.0
    psi_b: float = 0.0
    psi_c: float = 0.0
    psi_d: float = 0.0
    x: float = 0.0
    v: float = 0.0
    load: Load = Load()
    fault: bool = False


class LsrmPlantParams(Geometry, Mechanics, BlockParams):
    """Motor, supply, supervision."""

    period: float = param(5e-5, "time between two outputs, the period of the current controller", "s", gt=0.0, le=0.01)
    substeps: int = param(5, "Runge-Kutta steps in one period (10 us each)", ge=1, le=1000)
    R: float = param(2.5, "phase resistance R", "ohm", gt=0.0, le=1e3)
    U_dc: float = param(
        150.0, "supply voltage; commands are clipped to plus and minus this", "V", gt=0.0, le=1e4, live=True
    )
    trip_current: float = param(12.0, "phase current at which the half bridges trip", "A", gt=0.0, le=1e3, live=True)
    x_0: float = param(0.0, "initial position; at 0 phase a is aligned", "m", ge=-100.0, le=100.0)
    locked: bool = param(False, "translator clamped at x_0, as in a test of the phase windings")


class LsrmPlant(Plant[LsrmPlantParams]):
    """Four-phase linear switched reluctance motor; see `machine.advance` for the equations.

    The load adds mass at unchanged speed and Coulomb friction. A negative mass or friction is refused, and the previous
    load stays in force. A phase current beyond `trip_current` is a fault: every phase gets -U_dc until its current is
    zero, then 0 V, for good.
    """

    DRAWN_BY = "softrig_drives.lsrm.drawing:ReluctanceMotor"
    TRIPS: ClassVar[frozenset[str]] = frozenset({"overcurrent"})
    INPUTS = (PHASE_VOLTAGE, LOAD)
    OUTPUTS = (JOINT_STATES, PHASE_CURRENTS, FORCE_PHASES)
    AGREED = {"lsrm/pitch": "tau"}  # over which its force repeats

    def latched(self) -> Mapping[str, str]:
        """Return the URDF for ros2_control: its command, a force, is that of the current controller."""
        tag = hardware_tag("lsrm", TRANSLATOR, "/joint_states", "/force_cmd")
        return {"robot_description": axis_urdf("lsrm", *TRANSLATOR, "prismatic", (1e4, 1e2), tag)}

    def setup(self) -> None:
        """Arrange the constants for the compiled step."""
        p = self.p
        self._geometry = p.numbers()
        self._constants = np.array([p.U_dc, p.R, p.M, p.C + p.k_p, p.period / p.substeps, p.substeps, float(p.locked)])
        self._sure = 0.999 * p.trip_current * p.L_u  # Wb: no less inductance, so no phase with less can be beyond it

    def first(self) -> State:
        """Rest without current."""
        return State(x=self.p.x_0)

    def outputs(self, x: State, t: int) -> Values:
        """Return motion, currents and forces at t."""
        result = sense(x[:STATES], self._geometry)
        return {"joint_states": result[:3], "phase_currents": result[3:7], "force_phases": result[7:]}

    def advance(self, x: State, t: int, *, phase_voltage: tuple[float, ...], load: tuple[float, ...] | None) -> State:
        """Hold the voltages and the load for one period."""
        p, on, fault = self.p, x.load, x.fault
        if load is not None and load != on.values:
            on = self._checked_load(load) or on
        if not fault and (max(phase_voltage) > p.U_dc or min(phase_voltage) < -p.U_dc):
            self.report(Level.WARN, "clipped", f"voltages {phase_voltage} V clipped to the supply, {p.U_dc:g} V")
        result = step(x[:STATES], phase_voltage, on.values, fault, self._geometry, self._constants)
        if not fault and max(result[:N_PHASES]) > self._sure:
            currents = sense(result, self._geometry)[3:7]
            if max(currents) > p.trip_current:
                fault = True
                self.report(
                    Level.ERROR,
                    "overcurrent",
                    f"phase currents {currents} A beyond {p.trip_current:g} A: half bridges tripped for good",
                )
        return State(*result, on, fault)

    def _checked_load(self, load: tuple[float, ...]) -> Load | None:
        added, friction = load
        if added >= 0.0 and friction >= 0.0:
            return Load((added, friction))
        self.report(
            Level.ERROR,
            "bad_load",
            f"added mass {added:g} kg, friction {friction:g} N: expected none negative; the load before it is kept",
        )
        return None

    def markers(self, x: State) -> tuple[Marker, ...]:
        """Draw the stator and the translator over it."""
        return stator(self.p), translator(self.p, x.x)


@jit
def sense(state: Vector, geometry: Array) -> Step:
    """Return position, speed, force, the four currents and the four forces."""
    psi_a, psi_b, psi_c, psi_d, x, v = state
    i_a, f_a = phase(psi_a, distance(x, 0, geometry), geometry)
    i_b, f_b = phase(psi_b, distance(x, 1, geometry), geometry)
    i_c, f_c = phase(psi_c, distance(x, 2, geometry), geometry)
    i_d, f_d = phase(psi_d, distance(x, 3, geometry), geometry)
    return x, v, f_a + f_b + f_c + f_d, i_a, i_b, i_c, i_d, f_a, f_b, f_c, f_d


@jit
def step(
    state: Vector, voltages: Vector, load: Vector, fault: bool, geometry: Array, constants: Array
) -> tuple[float, float, float, float, float, float]:
    """Hold four voltages for a period, within plus and minus U_dc; after a fault -U_dc on phases with current.

    Parameters
    ----------
    state : tuple (6,)
        Flux linkages (Wb), position (m), speed (m/s).
    voltages : tuple (4,)
        V.
    load : tuple (2,)
        Added mass (kg) and friction (N).
    geometry, constants : array
        As `LsrmPlant.setup` lays them out.

    Returns
    -------
    tuple (6,)
        The state after the period.
    """
    limit, R, M, damping, h, steps, locked = constants
    u = (
        half_bridge_voltage(voltages[0], state[0], limit, fault),
        half_bridge_voltage(voltages[1], state[1], limit, fault),
        half_bridge_voltage(voltages[2], state[2], limit, fault),
        half_bridge_voltage(voltages[3], state[3], limit, fault),
    )
    added, friction = load
    return advance(state, u, geometry, (R, M + added, damping), friction, locked > 0.0, h, int(steps))


@jit
def half_bridge_voltage(voltage: float, flux: float, limit: float, fault: bool) -> float:
    """Return the voltage that a half bridge applies to its phase, V."""
    if fault:
        return -limit if flux > 0.0 else 0.0
    return min(max(voltage, -limit), limit)
