"""Three-phase machines as plants: inverter, machine and mechanical load in one."""

from __future__ import annotations

import math
from abc import abstractmethod
from itertools import pairwise
from typing import Any, ClassVar, NamedTuple

import numpy as np
from softrig_control.profile import StepProfile
from softrig_core import Array, Level, Plant, Port, Values, param, resolving_step, to_ns
from typing_extensions import TypeVar

from . import synchronous
from .inverter import NEVER, InverterParams
from .mechanics import Mechanics
from .ports import APPLIED, CURRENTS, DC_LINK, DUTY, JOINT_STATES, LOAD_SHAFT, LOAD_TORQUE
from .step import SQRT3, Vector, stepper
from .synchronous import SynchronousConstants

Nine = tuple[float, float, float, float, float, float, float, float, float]
Three = tuple[float, float, float]
ROUNDING = 1e-9  # allowed rounding of a duty ratio from a controller


class MachineParams(Mechanics, InverterParams):
    """Inverter, mechanics, and the steps of the integration."""

    substeps: int = param(2, "Runge-Kutta steps in one period, at least", ge=1, le=1000)
    w_0: float = param(0.0, "speed at the begin", "rad/s", ge=-1e6, le=1e6)
    theta_0: float = param(0.0, "initial angle", "rad", ge=-1e6, le=1e6)

    def rates(self, L: float = math.inf) -> list[tuple[float, str]]:
        """Return bounds of the rates, 1/s, with their parameters, for `resolving_step`.

        Parameters
        ----------
        L : float
            Least inductance, H.
        """
        if not self.C_dc:
            return self.mechanical_rates()
        # a tenth: the link's voltage stays close to its source, and only its small difference from that is inexact
        link = (0.1 / (self.R_dc * self.C_dc), f"R_dc = {self.R_dc:g} ohm, C_dc = {self.C_dc:g} F")
        swing = (math.sqrt(1.5 / (L * self.C_dc)), f"L = {L:g} H, C_dc = {self.C_dc:g} F")
        return [*self.mechanical_rates(), link, swing]

    def step(self) -> float:
        """Return the largest step of the integration at a low speed, s."""
        return resolving_step(self.period, self.substeps, *self.rates())

    def _check(self) -> None:
        if any(b - a < self.period for a, b in pairwise(self.load_times)):
            raise ValueError(f"load_times: expected at least a period, {self.period:g} s, between two changes")

    def inverter_numbers(self) -> Array:
        """Return the constants of the inverter in the order of `step.stepper`."""
        per_C = 1.0 / self.C_dc if self.C_dc else 0.0
        switched = float(self.inverter == "switched")
        return np.array([
            self.period, self.U_dc, self.R_dc, per_C, float(self.one_way), switched, float(self.updates),
            self.dead_time, self.v_switch, self.v_diode, self.step(),
        ])  # fmt: skip


P = TypeVar("P", bound=MachineParams, default=MachineParams)


class MachinePlant(Plant[P]):
    """Base of the plants: a machine on a two-level inverter.

    The duty ratios that arrive at t_k act `delay` periods later and are held for one. The currents are those at t_k,
    where the carrier is at a peak and the ripple is zero. A phase current or a DC voltage beyond its trip is a fault:
    the lower switches stay on for good, which brakes a machine with magnets.

    Load torques add up: `load_torque` by its topic, `load_times` and `load_torques`, and `load_square` w |w|.
    """

    DRAWN_BY = "softrig_drives.machines.drawing:MachineDrawing"
    TRIPS: ClassVar[frozenset[str]] = frozenset({"overcurrent", "overvoltage"})
    INPUTS = (DUTY, LOAD_TORQUE)
    MACHINE: ClassVar[Any] = synchronous  # the module with the equations
    AGREED = {"machines/pole_pairs": "pole_pairs", "machines/period": "period"}

    @classmethod
    def ports(cls, params: MachineParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """The second mass is an output where there is one."""
        load = (LOAD_SHAFT,) if params.J_load else ()
        return cls.INPUTS, (JOINT_STATES, CURRENTS, DC_LINK, APPLIED, *load)

    @abstractmethod
    def constants(self) -> Array:
        """Return the numbers of the machine."""

    @abstractmethod
    def nine(self, x: Any) -> Nine:
        """Return the nine states that `step.stepper` advances."""

    def setup(self) -> None:
        """Arrange the constants for the compiled step."""
        p = self.p
        self._m = self.constants()
        self._inverter, self._mechanics = p.inverter_numbers(), np.array(p.mechanics_numbers())
        self._seen = self.MACHINE.outputs_of
        self._move = stepper(self.MACHINE.rates, self.MACHINE.outputs_of)
        self._profile = StepProfile(p.load_times, p.load_torques)
        self._period = to_ns(p.period)
        self._two_masses = p.J_load > 0.0
        self._capacitor = p.C_dc > 0.0

    def outputs(self, x: Any, t: int) -> Values:
        """Return shaft, phase currents, DC voltage and the duty ratios of the period before."""
        now = self.nine(x)
        i_alpha, i_beta, torque = self._seen(now[0], now[1], now[2], now[3], now[5], self._m)
        i_b = -0.5 * i_alpha + 0.5 * SQRT3 * i_beta
        shaft, currents = (now[5], now[4], torque), (i_alpha, i_b, 0.0 - i_alpha - i_b)
        if self._two_masses:
            p = self.p
            twist = p.K_shaft * (now[5] - now[7]) + p.C_shaft * (now[4] - now[6])
            return {
                "joint_states": shaft,
                "currents": currents,
                "dc_link": (now[8],),
                "applied": x.applied,
                "load_shaft": (now[7], now[6], twist),
            }
        return {"joint_states": shaft, "currents": currents, "dc_link": (now[8],), "applied": x.applied}

    def moved(
        self, x: Any, t: int, duty: tuple[float, ...], load_torque: tuple[float, ...] | None
    ) -> tuple[Vector, Three, Three, bool]:
        """Return the nine states after one period, the duty ratios that wait and that were applied, and the fault."""
        p = self.p
        a, b, c = duty
        if min(a, b, c) < -ROUNDING or max(a, b, c) > 1.0 + ROUNDING:
            self.report(Level.WARN, "clipped", f"duty ratios {duty}, expected 0 to 1: clipped")
        new = (min(max(a, 0.0), 1.0), min(max(b, 0.0), 1.0), min(max(c, 0.0), 1.0))
        applied = x.waiting if p.delay else new
        added = 0.0 if load_torque is None else load_torque[0]
        change = self._profile.next_change(t)
        within = (change - t) * 1e-9 if change - t < self._period else NEVER
        load = (self._profile.at(t) + added, self._profile.at(t + self._period) + added)
        result = self._move(
            self.nine(x), applied, x.rising, x.fault, load, within, self._m, self._inverter, self._mechanics
        )
        return result, new, applied, x.fault or self._trips(result)

    def _trips(self, vector: Vector) -> bool:
        """Report values beyond a trip level; return whether there are any."""
        p = self.p
        i_alpha, i_beta, _ = self._seen(vector[0], vector[1], vector[2], vector[3], vector[5], self._m)
        i_b = -0.5 * i_alpha + 0.5 * SQRT3 * i_beta
        largest = max(abs(i_alpha), abs(i_b), abs(i_alpha + i_b))
        if largest > p.trip_current:
            self.report(
                Level.ERROR,
                "overcurrent",
                f"a phase current of {largest:.3g} A is beyond {p.trip_current:g} A: zero voltage for good",
            )
            return True
        if vector[8] > p.trip_voltage:
            self.report(
                Level.ERROR,
                "overvoltage",
                f"the DC voltage of {vector[8]:.4g} V is beyond {p.trip_voltage:g} V: zero voltage for good",
            )
            return True
        return False


class PmsmPlantParams(SynchronousConstants, MachineParams):
    """Machine, inverter, mechanics."""

    def _check(self) -> None:
        self.step()

    def rates(self, L: float = math.inf) -> list[tuple[float, str]]:
        """Add those of the currents, and of their swing with the rotor."""
        R, L, psi, p = self.R_s + self.r_on, self.least(), abs(self.at_rest()), self.pole_pairs
        swing = math.sqrt(1.5 / (L * self.J)) * p * psi
        return [
            *super().rates(L),
            (R / L, f"R_s = {self.R_s:g} ohm, L = {L:g} H"),
            (swing, f"psi_f = {psi:g} Wb, pole_pairs = {p}, L = {L:g} H, J = {self.J:g} kg m^2"),
            (p * abs(self.w_0), f"w_0 = {self.w_0:g} rad/s, pole_pairs = {p}"),
        ]


class State(NamedTuple):
    """Currents in rotor coordinates (A), speed (rad/s) and angle (rad) of both masses, DC voltage (V).

    Inverter: duty ratios that wait for the next period, those of the previous period, whether the carrier falls from
    its upper peak, and whether it has tripped.
    """

    i_d: float = 0.0
    i_q: float = 0.0
    omega: float = 0.0
    theta: float = 0.0
    omega_load: float = 0.0
    theta_load: float = 0.0
    u_dc: float = 0.0
    waiting: Three = (0.5, 0.5, 0.5)
    applied: Three = (0.5, 0.5, 0.5)
    rising: bool = True
    fault: bool = False


class PmsmPlant(MachinePlant[PmsmPlantParams]):
    """Synchronous machine with surface or interior magnets, or none (reluctance); see `synchronous.rates`."""

    def constants(self) -> Array:
        """Return constants or flux tables."""
        return self.p.numbers(self.p.r_on)

    def setup(self) -> None:
        """Arrange the constants, and the edges of the flux tables."""
        super().setup()
        self._edges = self.p.edges()

    def first(self) -> State:
        """Begin without current, at the speed and angle of the parameters."""
        p = self.p
        return State(0.0, 0.0, p.w_0, p.theta_0, p.w_0 if p.J_load else 0.0, p.theta_0 if p.J_load else 0.0, p.U_dc)

    def nine(self, x: State) -> Nine:
        """Return currents, mechanics, DC voltage, which is that of the source without a capacitor."""
        u_dc = x.u_dc if self._capacitor else self.p.U_dc
        return (x.i_d, x.i_q, 0.0, 0.0, x.omega, x.theta, x.omega_load, x.theta_load, u_dc)

    def advance(self, x: State, t: int, *, duty: tuple[float, ...], load_torque: tuple[float, ...] | None) -> State:
        """Move by one period."""
        result, waiting, applied, fault = self.moved(x, t, duty, load_torque)
        i_d, i_q, _, _, omega, theta, omega_load, theta_load, u_dc = result
        least_d, most_d, least_q, most_q = self._edges
        if i_d < least_d or i_d > most_d or i_q < least_q or i_q > most_q:
            self.report(
                Level.WARN,
                "beyond_tables",
                f"i_d = {i_d:.4g} A, i_q = {i_q:.4g} A: beyond the flux tables, whose last cell is extended",
            )
        rising = not x.rising if self.p.updates == 2 else True
        return State(i_d, i_q, omega, theta, omega_load, theta_load, u_dc, waiting, applied, rising, fault)
