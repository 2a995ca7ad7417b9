"""The motor on its four asymmetric half bridges."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from softrig_control.hardware import axis_urdf, hardware_tag
from softrig_core import BlockParams, Level, Marker, Plant, executable, jit, param

from .machine import N_PHASES, STATES, Array, Geometry, Mechanics, V, X, advance, current, force
from .markers import stator, translator
from .ports import FORCE_PHASES, JOINT_STATES, LOAD, PHASE_CURRENTS, PHASE_VOLTAGE, TRANSLATOR

Step = tuple[float, float, float, float, float, float, float, float, float, float, float]


class State(NamedTuple):
    """Flux linkages of the phases (Wb), position (m), speed (m/s)."""

    psi_a: float
    psi_b: float
    psi_c: float
    psi_d: float
    x: float
    v: float


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
    """Four-phase linear switched reluctance motor; see `machine.derivative` for the equations.

    The load adds mass at unchanged speed and Coulomb friction. A negative mass or friction is refused, the load before
    it kept. A phase current beyond `trip_current` is a fault: every phase gets -U_dc until its current is zero, then
    0 V, for good.
    """

    INPUTS = (PHASE_VOLTAGE, LOAD)
    OUTPUTS = (JOINT_STATES, PHASE_CURRENTS, FORCE_PHASES)

    @classmethod
    def agreed(cls, params: LsrmPlantParams) -> Mapping[str, Any]:
        """The pole pitch, over which its force repeats."""
        return {"lsrm/pitch": params.tau}

    @classmethod
    def drawing(cls) -> Any:
        """Give what draws it."""
        from .drawing import ReluctanceMotor

        return ReluctanceMotor

    def latched(self) -> Mapping[str, str]:
        """Give the URDF for ros2_control: its command, a force, is that of the current controller."""
        tag = hardware_tag("lsrm", TRANSLATOR, "/joint_states", "/force_cmd")
        return {"robot_description": axis_urdf("lsrm", *TRANSLATOR, "prismatic", (1e4, 1e2), tag)}

    def setup(self) -> None:
        """Lay the constants out for the compiled step."""
        p = self.p
        self._geometry = p.numbers()
        self._h = p.period / p.substeps

    def start(self) -> None:
        """Rest without current."""
        self._x = np.zeros(STATES)
        self._x[X] = self.p.x_0
        self._work = np.zeros((5, STATES))
        self._u = np.zeros(N_PHASES)
        self._load = (0.0, 0.0)
        self.fault = False
        self._move(0.0, 0.0, 0.0, 0.0, steps=0)

    @property
    def state(self) -> State:
        """Give fluxes and motion."""
        return State(*self._x.tolist())

    def put(self, state: Sequence[float]) -> None:
        """Go on from another state."""
        self._x[:] = state
        self._move(0.0, 0.0, 0.0, 0.0, steps=0)

    def outputs(self, t: int) -> Mapping[str, tuple[float, ...]]:
        """Give motion, currents and forces at t."""
        return self._answer

    def advance(self, t: int, *, phase_voltage: tuple[float, ...], load: tuple[float, ...] | None) -> None:
        """Hold the voltages and the load for one period."""
        p = self.p
        if load is not None and load != self._load:
            self._take(load)
        if not self.fault and (max(phase_voltage) > p.U_dc or min(phase_voltage) < -p.U_dc):
            self.report(Level.WARN, "clipped", f"voltages {phase_voltage} V clipped to the supply, {p.U_dc:g} V")
        u_a, u_b, u_c, u_d = phase_voltage
        self._move(u_a, u_b, u_c, u_d, p.substeps)

    def _move(self, u_a: float, u_b: float, u_c: float, u_d: float, steps: int) -> None:
        p, (added, friction) = self.p, self._load
        self._tell(step(self._x, self._work, self._u, self._geometry, u_a, u_b, u_c, u_d, p.U_dc, self.fault, p.R,
                        p.M + added, p.C + p.k_p, friction, p.locked, self._h, steps))  # fmt: skip

    def _take(self, load: tuple[float, ...]) -> None:
        added, friction = load
        if added < 0.0 or friction < 0.0:
            self.report(Level.ERROR, "bad_load", f"added mass {added:g} kg, friction {friction:g} N: expected none "
                        "negative; the load before it is kept")  # fmt: skip
        else:
            self._load = (added, friction)

    def _tell(self, found: Step) -> None:
        """Prepare the outputs, supervise the currents."""
        currents = found[3:7]
        self._answer = {"joint_states": found[:3], "phase_currents": currents, "force_phases": found[7:]}
        if max(currents) > self.p.trip_current and not self.fault:
            self.fault = True
            self.report(Level.ERROR, "overcurrent", f"phase currents {currents} A beyond {self.p.trip_current:g} A: "
                        "half bridges tripped for good")  # fmt: skip

    def markers(self) -> tuple[Marker, ...]:
        """Draw the stator and the translator over it."""
        return stator(self.p), translator(self.p, float(self._x[X]))


@jit
def sense(state: Array, geometry: Array) -> Step:
    """Give position, speed, force, the four currents and the four forces."""
    x = state[X]
    i_a = current(state[0], x, 0, geometry)
    i_b = current(state[1], x, 1, geometry)
    i_c = current(state[2], x, 2, geometry)
    i_d = current(state[3], x, 3, geometry)
    f_a = force(i_a, x, 0, geometry)
    f_b = force(i_b, x, 1, geometry)
    f_c = force(i_c, x, 2, geometry)
    f_d = force(i_d, x, 3, geometry)
    return x, state[V], f_a + f_b + f_c + f_d, i_a, i_b, i_c, i_d, f_a, f_b, f_c, f_d


@jit
def step(state: Array, work: Array, u: Array, geometry: Array, u_a: float, u_b: float, u_c: float, u_d: float,
         limit: float, fault: bool, R: float, mass: float, damping: float, friction: float, locked: bool, h: float,
         steps: int) -> Step:  # fmt: skip
    """Apply four voltages within plus and minus `limit` (V), or after a fault -limit to phases with current."""
    u[0], u[1], u[2], u[3] = u_a, u_b, u_c, u_d
    for k in range(N_PHASES):
        u[k] = min(max(u[k], -limit), limit)
        if fault:
            u[k] = -limit if state[k] > 0.0 else 0.0
    advance(state, work, u, geometry, R, mass, damping, friction, locked, h, steps)
    return sense(state, geometry)


main = executable(LsrmPlant)
