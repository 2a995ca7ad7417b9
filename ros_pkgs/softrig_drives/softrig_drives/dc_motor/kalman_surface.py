"""Sliding mode on the estimates of a Kalman filter that models load torque and bridge."""

from __future__ import annotations

import math
from typing import NamedTuple

from softrig_control.discretise import zero_order_hold
from softrig_control.kalman import SteadyKalman
from softrig_core import Values, param

from .model import SensorConstants, state_space
from .ports import APPLIED, REFERENCE, SENSORS
from .sliding_mode import SurfaceControl, SurfaceParams


class DcMotorSmcKalmanParams(SensorConstants, SurfaceParams):
    """The law, the filter's model of motor and encoder, and its noise variances."""

    delta: float = param(5.0, "softening of K s/(|s| + delta); 0 is K sgn(s)", "rad/s^2", ge=0.0, live=True)
    var_current: float = param(6.4e-7, "variance of the measured current", "A^2", gt=0.0)
    var_w: float = param(1e-4, "variance of the speed's disturbance in one step", "rad^2/s^2", gt=0.0)
    var_i: float = param(1e-5, "variance of the current's disturbance in one step", "A^2", gt=0.0)
    var_theta: float = param(1e-10, "variance of the angle's disturbance in one step", "rad^2", gt=0.0)
    var_load: float = param(1e-8, "variance of the load torque's change in one step", "N^2 m^2", gt=0.0)


class State(NamedTuple):
    """Reference (rad/s), its size that scales K, and the estimate of speed, current, angle and load torque."""

    r: float
    size: float
    estimate: tuple[float, ...]


class DcMotorSmcKalman(SurfaceControl[DcMotorSmcKalmanParams]):
    """Sliding mode on a filtered speed and w' = (-b w + Kt i - TL)/J.

    The states are (w, i, theta, TL) with TL' = 0; measured are the current and the encoder's angle, taken in the middle
    of its count (variance count^2/12). The input is the voltage that the bridge really applied. Therefore this law,
    unlike the paper's, takes account of the bridge drop, and its surface stays correct under load.
    """

    INPUTS = (SENSORS, APPLIED, REFERENCE)

    def setup(self) -> None:
        """Find the steady gain."""
        super().setup()
        p = self.p
        self._rad_per_count = math.tau / p.counts_per_rev
        a, b = state_space(p)  # in the order theta, w, i; the load is an input there and a state here
        order = (1, 2, 0)
        augmented = [[*(a[i][j] for j in order), b[i][1]] for i in order] + [[0.0] * 4]
        sampled = zero_order_hold(augmented, [*([b[i][0]] for i in order), [0.0]], p.period)
        self._filter = SteadyKalman(
            *sampled,
            c=((0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0)),
            q=(p.var_w, p.var_i, p.var_theta, p.var_load),
            r=(p.var_current, self._rad_per_count**2 / 12.0),
        )
        self._acceleration = (-p.b / p.J, p.Kt / p.J, -1.0 / p.J)

    def first(self) -> State:
        """Begin with the set point and the estimate of a motor at rest."""
        return State(self.p.set_point, abs(self.p.set_point), self._filter.first())

    def update(
        self,
        x: State,
        t: int,
        *,
        sensors: tuple[float, ...],
        applied: tuple[float, ...],
        reference: tuple[float, ...] | None,
    ) -> tuple[State, Values]:
        """Return the voltage."""
        count, current = sensors
        r = self.reference(x.r, reference)
        size = abs(r) or x.size
        estimate = self._filter(x.estimate, applied, (current, (count + 0.5) * self._rad_per_count))
        w, i, _, load = estimate
        per_w, per_i, per_load = self._acceleration
        return State(r, size, estimate), self.law(size, r, w, per_w * w + per_i * i + per_load * load)
