"""The induction machine as a plant."""

from __future__ import annotations

import math
from typing import Any, ClassVar, NamedTuple

from softrig_core import Array

from . import induction
from .induction import InductionConstants
from .plant import MachineParams, MachinePlant, Nine, Three


class InductionPlantParams(InductionConstants, MachineParams):
    """Machine, inverter, mechanics."""

    def _check(self) -> None:
        self.step()

    def rates(self, L: float = math.inf) -> list[tuple[float, str]]:
        """Add those of the currents."""
        R, p = self.R_s + self.R_R + self.r_on, self.pole_pairs
        return [
            *super().rates(self.L_sigma),
            (R / self.L_sigma, f"R_s = {self.R_s:g}, R_R = {self.R_R:g} ohm, L_sigma = {self.L_sigma:g} H"),
            (p * abs(self.w_0), f"w_0 = {self.w_0:g} rad/s, pole_pairs = {p}"),
        ]


class State(NamedTuple):
    """Flux linkages of stator and rotor in stator coordinates (Wb); further fields as in `plant.State`."""

    psi_s_alpha: float = 0.0
    psi_s_beta: float = 0.0
    psi_R_alpha: float = 0.0  # noqa: N815
    psi_R_beta: float = 0.0  # noqa: N815
    omega: float = 0.0
    theta: float = 0.0
    omega_load: float = 0.0
    theta_load: float = 0.0
    u_dc: float = 0.0
    waiting: Three = (0.5, 0.5, 0.5)
    applied: Three = (0.5, 0.5, 0.5)
    rising: bool = True
    fault: bool = False


class InductionPlant(MachinePlant[InductionPlantParams]):
    """Induction machine with a cage rotor; see `induction.rates`."""

    MACHINE: ClassVar[Any] = induction

    def constants(self) -> Array:
        """Return the constants of the inverse-Gamma circuit."""
        return self.p.numbers(self.p.r_on)

    def first(self) -> State:
        """Begin without flux, at the speed and angle of the parameters."""
        p = self.p
        w_load, theta_load = (p.w_0, p.theta_0) if p.J_load else (0.0, 0.0)
        return State(0.0, 0.0, 0.0, 0.0, p.w_0, p.theta_0, w_load, theta_load, p.U_dc)

    def nine(self, x: State) -> Nine:
        """Return fluxes, mechanics, DC voltage, which is that of the source without a capacitor."""
        u_dc = x.u_dc if self._capacitor else self.p.U_dc
        return (
            x.psi_s_alpha, x.psi_s_beta, x.psi_R_alpha, x.psi_R_beta, x.omega, x.theta, x.omega_load, x.theta_load, u_dc
        )  # fmt: skip

    def advance(self, x: State, t: int, *, duty: tuple[float, ...], load_torque: tuple[float, ...] | None) -> State:
        """Move by one period."""
        result, waiting, applied, fault = self.moved(x, t, duty, load_torque)
        a, b, c, d, omega, theta, omega_load, theta_load, u_dc = result
        rising = not x.rising if self.p.updates == 2 else True
        return State(a, b, c, d, omega, theta, omega_load, theta_load, u_dc, waiting, applied, rising, fault)
