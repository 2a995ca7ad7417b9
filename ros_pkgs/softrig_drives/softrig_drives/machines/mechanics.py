"""Mechanics of a machine: one mass or two, friction, load."""

from __future__ import annotations

import math

from softrig_control.profile import StepProfile
from softrig_core import RESOLVED, Params, jit, param

FINEST = 1000.0  # into how many parts a step is divided at most: beyond all physical speeds it would never end


class Mechanics(Params):
    """Inertia, friction with Stribeck's curve, an elastic shaft with a second mass, and the load."""

    J: float = param(0.015, "inertia of the rotor", "kg m^2", gt=0.0, le=1e6)
    B: float = param(0.0, "viscous friction", "N m s/rad", ge=0.0, le=1e6)
    T_coulomb: float = param(0.0, "Coulomb friction T_c", "N m", ge=0.0, le=1e6)
    T_static: float = param(0.0, "breakaway torque T_s; 0: as T_c", "N m", ge=0.0, le=1e6)
    w_stribeck: float = param(1.0, "Stribeck speed w_s, over which friction falls from T_s to T_c", "rad/s", gt=0.0)
    w_stick: float = param(0.1, "speed w_0 below which friction is viscous in place of sticking", "rad/s", gt=0.0)
    J_load: float = param(0.0, "inertia of the second mass; 0: there is none", "kg m^2", ge=0.0, le=1e6)
    K_shaft: float = param(1000.0, "stiffness of the shaft to it", "N m/rad", gt=0.0, le=1e9)
    C_shaft: float = param(0.0, "damping of that shaft", "N m s/rad", ge=0.0, le=1e6)
    load_square: float = param(0.0, "load torque of a fan or a pump, over speed squared", "N m s^2", ge=0.0, live=True)
    load_times: tuple[float, ...] = param(
        (0.0,), "times at which the load torque changes, at least a period apart", "s", each=(0.0, 1e9), live=True
    )
    load_torques: tuple[float, ...] = param(
        (0.0,), "load torque from each of these times on", "N m", each=(-1e6, 1e6), live=True
    )

    def _check(self) -> None:
        try:
            StepProfile(self.load_times, self.load_torques)
        except ValueError as error:
            raise ValueError(f"load_times, load_torques: {error}") from None
        if 0.0 < self.T_static < self.T_coulomb:
            raise ValueError(f"T_static = {self.T_static:g} N m: expected 0 or at least T_coulomb = {self.T_coulomb:g}")

    def mechanical_rates(self) -> list[tuple[float, str]]:
        """Return bounds of the rates of the mechanics, 1/s, with their parameters, as `resolving_step` takes them."""
        friction = self.B + max(self.T_coulomb, self.T_static) / self.w_stick
        both = 1.0 / self.J + (1.0 / self.J_load if self.J_load else 0.0)
        shaft = max(math.sqrt(self.K_shaft * both), self.C_shaft * both) if self.J_load else 0.0
        return [(friction / self.J, "friction, w_stick and J"), (shaft, "K_shaft, C_shaft and the inertias")]

    def mechanics_numbers(self) -> list[float]:
        """Return the constants in the order of `accelerations`."""
        return [
            1.0 / self.J, self.B, self.T_coulomb, max(self.T_static, self.T_coulomb), self.w_stribeck, self.w_stick,
            1.0 / self.J_load if self.J_load else 0.0, self.K_shaft, self.C_shaft, self.load_square,
        ]  # fmt: skip


@jit
def finer(step: float, rate: float) -> float:
    """Return a step that resolves a rate (1/s), too, such as one that grows with the speed."""
    return step / min(max(1.0, rate * step / RESOLVED), FINEST)


@jit
def friction(omega: float, B: float, T_c: float, T_s: float, w_s: float, w_0: float) -> float:
    """Return the friction torque, N m: B w + (T_c + (T_s - T_c) exp(-(w/w_s)^2)) tanh(w/w_0)."""
    if T_s == 0.0:
        return B * omega
    ratio = omega / w_s
    return B * omega + (T_c + (T_s - T_c) * math.exp(-ratio * ratio)) * math.tanh(omega / w_0)
