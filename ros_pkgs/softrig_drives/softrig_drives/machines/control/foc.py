"""Field-oriented control of synchronous machines."""

from __future__ import annotations

from typing import Literal, NamedTuple

from softrig_core import Block, Port, Values, param, scalars, vector3

from ..ports import CURRENTS, DC_LINK, DUTY, SHAFT_MEAS, SPEED_REF, TORQUE_REF
from .current_control import CurrentControl, CurrentControlParams, Integrals, rotated
from .current_references import currents as least_currents
from .speed_control import Speed, SpeedControl, SpeedControlParams

CURRENT_REF = vector3("current_ref", "current_ref", "dq", "A", held=True)
FOC = scalars(
    "foc",
    "foc",
    {"i_d": "A", "i_q": "A", "i_d_ref": "A", "i_q_ref": "A", "u_d": "V", "u_q": "V", "torque_ref": "N m"},
)
SLOWEST = 1e-9  # rad/s, electrical: below it any flux is within the voltage


class FocControllerParams(SpeedControlParams, CurrentControlParams):
    """The machine as the controller assumes it, its limits, and its references."""

    mode: Literal["speed", "torque", "current"] = param(
        "speed", "follow a speed, a torque, or currents i_d and i_q (topics speed_ref, torque_ref, current_ref)"
    )
    R_s: float = param(3.6, "stator resistance R_s in the controller", "ohm", gt=0.0, live=True)
    L_d: float = param(0.036, "inductance L_d in the controller", "H", gt=0.0, live=True)
    L_q: float = param(0.051, "inductance L_q in the controller", "H", gt=0.0, live=True)
    psi_f: float = param(0.545, "flux linkage psi_f in the controller", "Wb", ge=0.0, live=True)
    pole_pairs: int = param(3, "pole pairs p", ge=1, le=1000)
    i_max: float = param(9.0, "largest current (peak)", "A", gt=0.0, live=True)
    voltage_use: float = param(
        0.9, "share of the voltage for which currents are chosen; the rest is for resistance and control", gt=0.0,
        le=1.0, live=True,
    )  # fmt: skip

    def _check(self) -> None:
        if self.psi_f == 0.0 and self.L_d == self.L_q and self.mode != "current":
            raise ValueError(
                f"psi_f = 0 and L_d = L_q = {self.L_d:g} H: such a machine makes no torque; give the flux linkage of "
                "the magnet or two inductances, or set mode to current"
            )


class State(NamedTuple):
    """Integral parts of the voltage (V), memory of the speed control."""

    u: Integrals = Integrals()
    speed: Speed = Speed()


class FocController(Block[FocControllerParams]):
    """Least currents for the torque, controlled in rotor coordinates.

    The torque comes from the speed control or from outside; `current_references.currents` turns it into currents with
    the flux psi_max = voltage_use u_max/|p omega|, `current_control.CurrentControl` these into a voltage. The motional
    voltage is j p omega (L i + psi_f).

    After an input that was refused the machine gets zero voltage for the period, and the state stays.
    """

    STATE = State
    AGREED = {"machines/pole_pairs": "pole_pairs", "machines/period": "period"}

    @classmethod
    def ports(cls, params: FocControllerParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """The reference is that of the mode."""
        reference = {"speed": SPEED_REF, "torque": TORQUE_REF, "current": CURRENT_REF}[params.mode]
        return (CURRENTS, SHAFT_MEAS, DC_LINK, reference), (DUTY, FOC)

    def setup(self) -> None:
        """Design both loops."""
        p = self.p
        self._control = CurrentControl(p, p.R_s, (p.L_d, p.L_q))
        self._speed = SpeedControl(p)
        self._k = 1.5 * p.pole_pairs
        self._mode = p.mode
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
        current_ref: tuple[float, ...] | None = None,
    ) -> tuple[State, Values]:
        """Compute the duty ratios; a reference that has not arrived counts as zero."""
        p = self.p
        omega = joint_states[1]
        angle, w = p.pole_pairs * joint_states[0], p.pole_pairs * omega
        i_d, i_q = rotated(currents, angle)
        speed, torque = x.speed, 0.0
        if self._mode == "current":
            ref_d, ref_q = (0.0, 0.0) if current_ref is None else (current_ref[0], current_ref[1])
            torque = self._k * (p.psi_f + (p.L_d - p.L_q) * ref_d) * ref_q
        else:
            if self._mode == "speed":
                speed, wanted, cut = self._speed.wanted(speed, 0.0 if speed_ref is None else speed_ref[0], omega)
            else:
                wanted = cut = 0.0 if torque_ref is None else min(max(torque_ref[0], -p.torque_max), p.torque_max)
            psi_max = self._reach * max(dc_link[0], 0.0) / max(abs(w), SLOWEST)
            ref_d, ref_q, torque = least_currents(cut, psi_max, p.i_max, self._k, p.L_d, p.L_q, p.psi_f)
            if self._mode == "speed":
                speed = self._speed.closed(speed, omega, wanted, torque)
        motional = (-w * p.L_q * i_q, w * (p.L_d * i_d + p.psi_f))
        u, voltage, duty = self._control(x.u, (ref_d - i_d, ref_q - i_q), motional, angle, w, dc_link[0])
        return State(u, speed), {"duty": duty, "foc": (i_d, i_q, ref_d, ref_q, voltage[0], voltage[1], torque)}

    def refused(self, x: State, t: int) -> tuple[State, Values]:
        """Return zero voltage for this period."""
        return x, {"duty": (0.5, 0.5, 0.5), "foc": (0.0,) * FOC.size}
