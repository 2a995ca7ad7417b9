"""Field-oriented control of induction machines, and control by voltage over frequency."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Literal, NamedTuple

from softrig_core import Block, Port, Values, param, scalars

from ..ports import CURRENTS, DC_LINK, DUTY, SHAFT_MEAS, SPEED_REF, TORQUE_REF
from .current_control import CurrentControl, CurrentControlParams, Integrals, rotated
from .modulation import Modulation, duties, linear_range
from .speed_control import Speed, SpeedControl, SpeedControlParams

IM_FOC = scalars(
    "foc",
    "foc",
    {"i_d": "A", "i_q": "A", "i_d_ref": "A", "i_q_ref": "A", "flux": "Wb", "torque_ref": "N m"},
)
WEAK = 0.02  # share of the flux reference below which slip and torque are not divided by the flux


class ImFocParams(SpeedControlParams, CurrentControlParams):
    """The machine as the controller assumes it, flux, limits, and references."""

    mode: Literal["speed", "torque"] = param("speed", "follow a speed or a torque (topics speed_ref, torque_ref)")
    R_s: float = param(3.7, "stator resistance in the controller", "ohm", gt=0.0, live=True)
    R_R: float = param(2.1, "rotor resistance in the controller (inverse-Gamma)", "ohm", gt=0.0, live=True)
    L_sigma: float = param(0.021, "leakage inductance in the controller", "H", gt=0.0, live=True)
    L_M: float = param(0.224, "magnetising inductance in the controller", "H", gt=0.0, live=True)
    pole_pairs: int = param(2, "pole pairs p", ge=1, le=1000)
    flux: float = param(0.9, "rotor flux linkage", "Wb", gt=0.0, live=True)
    flux_bandwidth: float = param(50.0, "bandwidth of the flux control", "rad/s", gt=0.0, live=True)
    i_max: float = param(10.6, "largest current (peak)", "A", gt=0.0, live=True)
    voltage_use: float = param(0.85, "share of the voltage that the flux may need", gt=0.0, le=1.0, live=True)


class State(NamedTuple):
    """Flux estimate (Wb), its angle (rad), integral parts of the voltage (V), memory of the speed control."""

    psi: float = 0.0
    angle: float = 0.0
    u: Integrals = Integrals()
    speed: Speed = Speed()


class ImFocController(Block[ImFocParams]):
    """Currents controlled in coordinates of the rotor flux, which the current model estimates.

    ::

        psi'   = R_R i_d - (R_R/L_M) psi,  angle' = w_s = p omega + R_R i_q/psi        flux observer
        R_R i_d_ref = (R_R/L_M) psi + alpha_psi (psi_ref - psi),  i_q_ref = T_ref/(3/2 p psi)
        e      = j w_s L_sigma i + (j p omega - R_R/L_M) psi                           motional voltage

    Above the speed at which p omega psi needs more than `voltage_use` of the voltage, the flux reference falls as
    1/omega.
    """

    STATE = State
    AGREED = {"machines/pole_pairs": "pole_pairs", "machines/period": "period"}

    @classmethod
    def ports(cls, params: ImFocParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """The reference is that of the mode."""
        reference = SPEED_REF if params.mode == "speed" else TORQUE_REF
        return (CURRENTS, SHAFT_MEAS, DC_LINK, reference), (DUTY, IM_FOC)

    def setup(self) -> None:
        """Design the loops."""
        p = self.p
        self._control = CurrentControl(p, p.R_s + p.R_R, (p.L_sigma, p.L_sigma))
        self._speed = SpeedControl(p)
        self._k = 1.5 * p.pole_pairs
        self._speedy = p.mode == "speed"
        self._rate = p.R_R / p.L_M
        self._decay = math.exp(-self._rate * p.period)
        self._reach = p.voltage_use * self._control.reach

    def update(
        self,
        x: State,
        t: int,
        *,
        currents: tuple[float, ...],
        joint_states: tuple[float, ...],
        dc_link: tuple[float, ...],
        speed_ref: tuple[float, ...] | None = None,
        torque_ref: tuple[float, ...] | None = None,
    ) -> tuple[State, Values]:
        """Compute the duty ratios; a reference that has not arrived counts as zero."""
        p = self.p
        omega = joint_states[1]
        w = p.pole_pairs * omega
        i_d, i_q = rotated(currents, x.angle)
        psi_ref = min(p.flux, self._reach * max(dc_link[0], 0.0) / max(abs(w), 1e-9))
        least = max(x.psi, WEAK * p.flux)
        slip = p.R_R * i_q / least
        ref_d = (self._rate * x.psi + p.flux_bandwidth * (psi_ref - x.psi)) / p.R_R
        ref_d = min(max(ref_d, 0.0), 0.9 * p.i_max)
        most = self._k * x.psi * math.sqrt(p.i_max * p.i_max - ref_d * ref_d)
        speed = x.speed
        if self._speedy:
            speed, wanted, cut = self._speed.wanted(speed, 0.0 if speed_ref is None else speed_ref[0], omega)
        else:
            wanted = cut = 0.0 if torque_ref is None else min(max(torque_ref[0], -p.torque_max), p.torque_max)
        torque = min(max(cut, -most), most)
        if self._speedy:
            speed = self._speed.closed(speed, omega, wanted, torque)
        ref_q = torque / (self._k * least)
        motional = (-(w + slip) * p.L_sigma * i_q - self._rate * x.psi, (w + slip) * p.L_sigma * i_d + w * x.psi)
        u, _, duty = self._control(x.u, (ref_d - i_d, ref_q - i_q), motional, x.angle, w + slip, dc_link[0])
        psi = self._decay * x.psi + (1.0 - self._decay) * p.L_M * i_d
        angle = math.remainder(x.angle + (w + slip) * p.period, math.tau)
        return State(psi, angle, u, speed), {"duty": duty, "foc": (i_d, i_q, ref_d, ref_q, x.psi, torque)}

    def refused(self, x: State, t: int) -> tuple[State, Values]:
        """Return zero voltage for this period."""
        return x, {"duty": (0.5, 0.5, 0.5), "foc": (0.0,) * IM_FOC.size}


class VhzParams(CurrentControlParams):
    """Voltage over frequency, start voltage, ramp."""

    pole_pairs: int = param(2, "pole pairs p", ge=1, le=1000)
    flux: float = param(1.04, "stator flux linkage: rated peak voltage over rated frequency", "Wb", gt=0.0, live=True)
    boost: float = param(15.0, "voltage at zero frequency, for the resistance", "V", ge=0.0, live=True)
    slew: float = param(150.0, "slew rate of the speed", "rad/s^2", gt=0.0, live=True)
    modulation: Modulation = param("space_vector", "how voltages are converted to duty ratios", live=True)


class VhzState(NamedTuple):
    """Speed as slewed (rad/s), angle of the voltage (rad)."""

    speed: float = 0.0
    angle: float = 0.0


class VhzController(Block[VhzParams]):
    """Open-loop control: the voltage is flux times frequency plus a boost; only the DC link is measured.

    ::

        angle' = p w,  |u| = flux |p w| + boost
    """

    INPUTS = (DC_LINK, SPEED_REF)
    OUTPUTS = (DUTY,)
    STATE = VhzState

    def setup(self) -> None:
        """Prepare the ramp."""
        self._rise = self.p.slew * self.p.period
        self._reach = linear_range(self.p.modulation)

    def update(
        self, x: VhzState, t: int, *, dc_link: tuple[float, ...], speed_ref: tuple[float, ...] | None
    ) -> tuple[VhzState, Mapping[str, tuple[float, ...]]]:
        """Turn the voltage on."""
        p = self.p
        target = 0.0 if speed_ref is None else speed_ref[0]
        speed = x.speed + min(max(target - x.speed, -self._rise), self._rise)
        w = p.pole_pairs * speed
        angle = math.remainder(x.angle + w * p.period, math.tau)
        size = min(p.flux * abs(w) + p.boost, self._reach * max(dc_link[0], 0.0))
        if dc_link[0] <= 0.0:
            return VhzState(speed, angle), {"duty": (0.5, 0.5, 0.5)}
        return VhzState(speed, angle), {
            "duty": duties(size * math.cos(angle), size * math.sin(angle), dc_link[0], p.modulation)
        }
