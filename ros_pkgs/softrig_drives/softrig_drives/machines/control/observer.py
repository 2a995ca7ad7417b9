"""Flux observer of synchronous machines, and the position that follows from it: control without a shaft sensor."""

from __future__ import annotations

import math
from typing import NamedTuple

from softrig_core import Block, BlockParams, Values, joint_state, param, vector3

from ..ports import APPLIED, CURRENTS, DC_LINK, SHAFT
from .modulation import SQRT3

ESTIMATE = joint_state("estimate", "shaft_estimate", SHAFT, position="rad", velocity="rad/s")
FLUX = vector3("flux", "flux_estimate", "alpha_beta", "Wb")


class FluxObserverParams(BlockParams):
    """The machine as the observer assumes it, and its gains."""

    period: float = param(1e-4, "sampling period T_s", "s", gt=0.0, le=0.1)
    R_s: float = param(3.6, "stator resistance of the observer", "ohm", gt=0.0, live=True)
    L_d: float = param(0.036, "inductance L_d of the observer", "H", gt=0.0, live=True)
    L_q: float = param(0.051, "inductance L_q of the observer", "H", gt=0.0, live=True)
    psi_f: float = param(0.545, "flux linkage psi_f of the observer", "Wb", ge=0.0, live=True)
    pole_pairs: int = param(3, "pole pairs p", ge=1, le=1000)
    gain: float = param(40.0, "gain g of the correction by the current model", "rad/s", gt=0.0, live=True)
    bandwidth: float = param(250.0, "bandwidth alpha_o of the loop that tracks the angle", "rad/s", gt=0.0, live=True)
    theta_0: float = param(0.0, "initial angle", "rad", ge=-1e6, le=1e6)


class State(NamedTuple):
    """Stator flux linkage (Wb) and current (A) in stator coordinates, electrical angle (rad) and speed (rad/s)."""

    psi_alpha: float
    psi_beta: float
    i_alpha: float = 0.0
    i_beta: float = 0.0
    angle: float = 0.0
    speed: float = 0.0


class FluxObserver(Block[FluxObserverParams]):
    """Voltage model, corrected by the current model; the angle is that of the active flux.

    ::

        psi'   = u - R_s i + g (psi_i - psi),   psi_i = exp(j angle) (L_d i_d + psi_f + j L_q i_q)
        psi_a  = psi - L_q i                                           on the direct axis of the rotor
        e      = psi_a x exp(j angle), over |psi_a|
        speed' = alpha_o^2 e,  angle' = speed + 2 alpha_o e

    The angle is observed from the induced voltage. At standstill there is none, so begin at a known angle.

    References
    ----------
    I. Boldea, M. C. Paicu, G.-D. Andreescu, Active flux concept for motion-sensorless unified AC drives, IEEE
    Transactions on Power Electronics 23(5), 2008.
    """

    INPUTS = (CURRENTS, APPLIED, DC_LINK)
    OUTPUTS = (ESTIMATE, FLUX)
    AGREED = {"machines/pole_pairs": "pole_pairs", "machines/period": "period"}

    def first(self) -> State:
        """Begin with the magnet's flux at the known angle."""
        p = self.p
        angle = p.pole_pairs * p.theta_0
        return State(p.psi_f * math.cos(angle), p.psi_f * math.sin(angle), angle=angle)

    def update(
        self, x: State, t: int, *, currents: tuple[float, ...], applied: tuple[float, ...], dc_link: tuple[float, ...]
    ) -> tuple[State, Values]:
        """Integrate over the period before, follow the angle."""
        p, T = self.p, self.p.period
        a, b, c = currents
        i_alpha, i_beta = (2.0 * a - b - c) / 3.0, (b - c) / SQRT3
        d_a, d_b, d_c = applied
        u_alpha, u_beta = (2.0 * d_a - d_b - d_c) / 3.0 * dc_link[0], (d_b - d_c) / SQRT3 * dc_link[0]
        begun = t > 0
        psi_alpha, psi_beta, angle, speed = x.psi_alpha, x.psi_beta, x.angle, x.speed
        if begun:
            cos, sin = math.cos(angle), math.sin(angle)
            i_d, i_q = cos * x.i_alpha + sin * x.i_beta, cos * x.i_beta - sin * x.i_alpha
            model_d, model_q = p.L_d * i_d + p.psi_f, p.L_q * i_q
            off_alpha, off_beta = cos * model_d - sin * model_q - psi_alpha, sin * model_d + cos * model_q - psi_beta
            psi_alpha += T * (u_alpha - 0.5 * p.R_s * (i_alpha + x.i_alpha) + p.gain * off_alpha)
            psi_beta += T * (u_beta - 0.5 * p.R_s * (i_beta + x.i_beta) + p.gain * off_beta)
            angle += T * speed
        active_alpha, active_beta = psi_alpha - p.L_q * i_alpha, psi_beta - p.L_q * i_beta
        size = math.sqrt(active_alpha * active_alpha + active_beta * active_beta)
        cos, sin = math.cos(angle), math.sin(angle)
        error = (active_beta * cos - active_alpha * sin) / max(size, 1e-9)
        angle += 2.0 * p.bandwidth * T * error
        speed += p.bandwidth * p.bandwidth * T * error
        answer = {"estimate": (angle / p.pole_pairs, speed / p.pole_pairs), "flux": (psi_alpha, psi_beta, 0.0)}
        return State(psi_alpha, psi_beta, i_alpha, i_beta, angle, speed), answer

    def refused(self, x: State, t: int) -> tuple[State, Values]:
        """Hold the estimate."""
        answer = {"estimate": (x.angle / self.p.pole_pairs, x.speed / self.p.pole_pairs)}
        return x, {**answer, "flux": (x.psi_alpha, x.psi_beta, 0.0)}
