"""Expected-model voltage controller of one joint: equations (11) and (15) of the paper."""

from __future__ import annotations

from typing import Any, NamedTuple

from softrig_core import param

from ..joints import JointGains, PerJoint, require_positive


class EmvcGains(JointGains):
    """Case 1, known motor: alpha_hat = K_b/r, resistance = R. Case 2: any other values."""

    alpha_hat: PerJoint = param((4.592,), "expected K_b/r", "V s/rad", live=True)
    lam: PerJoint = param((4.0,), "rate lambda at which the error decays", "1/s", live=True)
    resistance: PerJoint = param((4.0,), "expected armature resistance", "Ohm", live=True)

    def _check(self) -> None:
        require_positive("alpha_hat", self.alpha_hat)
        require_positive("lam", self.lam)


class EmvcState(NamedTuple):
    """The model's output for the applied voltage, psi (rad/s)."""

    psi: float = 0.0


class Emvc:
    r"""Voltage of one motor.

    .. math::
        \psi_k = (V_{k-1} - \hat R I_k)/\hat\alpha - \dot q_k, \qquad
        V_k = \mathrm{sat}[\hat R I_k + \hat\alpha (\dot q_r + \lambda e + \psi_k)]

    Parameters
    ----------
    g : of one joint
        Gains, see `EmvcGains.of_joint`.
    T : float
        Sampling period, s. The law does not use it.
    v_max : float
        Voltage limit, V.

    Notes
    -----
    The current cancels: :math:`V_k = V_{k-1} + \hat\alpha (\dot e_k + \lambda e_k)`. The law is an integrator, a PI
    controller of the position with gain :math:`\hat\alpha/T`. V_{k-1} must be the voltage applied to the motor: then
    nothing winds up when the voltage is limited, and a change of gains causes no jump.
    """

    UNITS = {"psi": "rad/s"}

    def __init__(self, g: Any, *, T: float, v_max: float) -> None:
        self._alpha, self._lam, self._R, self._v_max = g.alpha_hat, g.lam, g.resistance, v_max

    def first(self) -> EmvcState:
        """No voltage yet."""
        return EmvcState()

    def __call__(
        self, x: EmvcState, q: float, qd: float, current: float, ref: float, ref_d: float, ref_dd: float, V: float
    ) -> tuple[EmvcState, float]:
        """Return the voltage for joint state, current and reference; V is the voltage of the last period."""
        ri = self._R * current
        psi = (V - ri) / self._alpha - qd
        v = ri + self._alpha * (ref_d + self._lam * (ref - q) + psi)
        return EmvcState(psi), min(max(v, -self._v_max), self._v_max)
