"""Model reference adaptive speed controller."""

from __future__ import annotations

import math
from typing import NamedTuple

from softrig_core import Values, param
from softrig_core.kit.dense import total

from .machine import Mechanics
from .ports import FORCE_CMD, REFERENCE, SPEED, THETA
from .speed_control import SpeedControl, SpeedControlParams

Triple = tuple[float, float, float]


class LsrmMracParams(Mechanics, SpeedControlParams):
    """Riccati weights, adaptation gains, start and bounds of theta = (mass, damping, friction)."""

    q: float = param(4e4, "weight of the speed error in the Riccati equation", gt=0.0, le=1e9, live=True)
    r: float = param(1.0, "weight of the force in the Riccati equation", gt=0.0, le=1e9, live=True)
    gains: Triple = param((200.0, 2000.0, 2000.0), "adaptation gains Gamma of mass, damping, friction", live=True)
    theta_0: Triple = param((3.0, 10.0, 0.0), "initial mass (kg), damping (N s/m), friction (N)")
    theta_min: Triple = param((1.0, 0.0, -20.0), "lower bounds of theta (kg, N s/m, N)", live=True)
    theta_max: Triple = param((20.0, 60.0, 20.0), "upper bounds of theta (kg, N s/m, N)", live=True)

    def _check(self) -> None:
        for low, first, high in zip(self.theta_min, self.theta_0, self.theta_max, strict=True):
            if not low <= first <= high:
                raise ValueError(f"theta_0 {self.theta_0} is not between {self.theta_min} and {self.theta_max}")
        if min(self.gains) < 0.0:
            raise ValueError(f"gains {self.gains}: expected none negative")


class State(NamedTuple):
    """Estimates of mass (kg), damping (N s/m), friction (N)."""

    theta: tuple[float, ...]


class LsrmMrac(SpeedControl[LsrmMracParams]):
    """Adaptive control of M v' = F - b v - f with the reference speed as the model's.

    ::

        eps = v - v_ref
        k   = sqrt(a^2 + b^2 q/r),  a = -(C + k_p)/M,  b = 1/M       scalar Riccati equation
        phi = (a_ref - k eps, v, 1)
        theta <- theta - Gamma phi eps Ts, within its bounds
        F*  = theta phi, within plus and minus F_max

    Changed weights, rates and bounds leave theta as it is, within the bounds; the force then jumps by the effect of the
    new k. The model for which k is solved, (M, C, k_p), is fixed at the start, and theta_0 is the initial theta.

    Lyapunov: V' = -M k eps^2. Chosen; the paper's own baseline (Rahideh, Ketabi, Halvaei Niasar 2020) is not available.
    """

    INPUTS = (SPEED, REFERENCE)
    OUTPUTS = (FORCE_CMD, THETA)

    def setup(self) -> None:
        """Solve the Riccati equation."""
        p = self.p
        a, b = -(p.C + p.k_p) / p.M, 1.0 / p.M
        self.k = math.sqrt(a * a + b * b * p.q / p.r)
        self._rates = tuple(gain * p.period for gain in p.gains)

    def first(self) -> State:
        """Begin with theta_0."""
        return State(self.p.theta_0)

    def update(
        self, x: State, t: int, *, joint_states: tuple[float, ...], reference: tuple[float, ...]
    ) -> tuple[State, Values]:
        """Adapt, then return the force command."""
        p, v = self.p, joint_states[0]
        error = v - reference[1]
        phi = (reference[2] - self.k * error, v, 1.0)
        theta = tuple(
            min(max(theta - rate * phi_i * error, low), high)
            for theta, rate, phi_i, low, high in zip(x.theta, self._rates, phi, p.theta_min, p.theta_max, strict=True)
        )
        force = total(theta * phi_i for theta, phi_i in zip(theta, phi, strict=True))
        return State(theta), {"force_cmd": (self.clip(force),), "theta": theta}
