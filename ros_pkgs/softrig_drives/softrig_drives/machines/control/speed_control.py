"""Speed control of a drive, designed by its bandwidth."""

from __future__ import annotations

from typing import NamedTuple

from softrig_core import BlockParams, param


class SpeedControlParams(BlockParams):
    """Bandwidth, inertia, ramp, and the largest torque."""

    period: float = param(1e-4, "sampling period T_s", "s", gt=0.0, le=0.1)
    speed_bandwidth: float = param(
        25.0, "bandwidth alpha_s of the speed loop: a step is followed as 1 - exp(-alpha_s t)", "rad/s", gt=0.0,
        live=True,
    )  # fmt: skip
    J: float = param(0.015, "inertia that the speed control assumes", "kg m^2", gt=0.0, le=1e6, live=True)
    slew: float = param(0.0, "slew rate of the speed reference; 0: none", "rad/s^2", ge=0.0, live=True)
    torque_max: float = param(1e6, "largest torque reference", "N m", gt=0.0, live=True)


class Speed(NamedTuple):
    """Integral (N m) and speed reference as slewed (rad/s)."""

    integral: float = 0.0
    reference: float = 0.0


class SpeedControl:
    """PI control with active damping, for an inner loop that makes the torque immediately.

    ::

        T_ref = k_p (w_ref - w) + I - k_p w,  k_p = alpha_s J
        I'    = alpha_s k_p (w_ref - w + (T - T_ref)/k_p)

    T is the part of T_ref that the machine can produce. With one mass and without friction the loop is alpha_s/(s +
    alpha_s).

    References
    ----------
    L. Harnefors, S. E. Saarakkala, M. Hinkkanen, Speed control of electrical drives using classical control methods,
    IEEE Transactions on Industry Applications 49(2), 2013.
    """

    def __init__(self, p: SpeedControlParams) -> None:
        self._gain = p.speed_bandwidth * p.J
        self._share = p.period * p.speed_bandwidth
        self._rise = p.slew * p.period
        self._most = p.torque_max

    def wanted(self, x: Speed, target: float, speed: float) -> tuple[Speed, float, float]:
        """Return the state with the slewed reference, the requested torque, and the same limited to the
        largest, N m.
        """
        reference = target
        if self._rise > 0.0:
            reference = x.reference + min(max(target - x.reference, -self._rise), self._rise)
        torque = self._gain * (reference - speed) + x.integral - self._gain * speed
        return Speed(x.integral, reference), torque, min(max(torque, -self._most), self._most)

    def closed(self, x: Speed, speed: float, wanted: float, achieved: float) -> Speed:
        """Return the state after the machine makes another torque than requested, N m."""
        step = self._share * (self._gain * (x.reference - speed) + achieved - wanted)
        return Speed(x.integral + step, x.reference)
