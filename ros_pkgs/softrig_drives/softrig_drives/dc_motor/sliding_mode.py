"""Sliding mode speed controller, the paper's law."""

from __future__ import annotations

import math
from typing import Any, Literal, NamedTuple

from softrig_control.sliding_mode import switching
from softrig_core import Port, Values, param
from typing_extensions import TypeVar

from .model import MotorConstants
from .ports import COMMAND, REFERENCE, SENSORS, SPEED, SURFACE
from .speed_control import SpeedControl, SpeedControlParams


class SurfaceParams(MotorConstants, SpeedControlParams):
    """Surface, switching gain and the law's model of the motor, as printed or of its constants R to Ke.

    c and K/r are solved from rise and settling time of the paper's Table II.
    """

    c: float = param(5.0320416, "slope c of the surface s = c e + e'", "1/s", gt=0.0, live=True)
    k: float | None = param(
        None, "switching gain K; absent: k_per_ref times the size of the reference", "rad/s^3", gt=0.0, live=True
    )
    k_per_ref: float = param(9.71170883, "switching gain per reference K/|r|", "1/s^2", gt=0.0, live=True)
    delta: float = param(0.0, "softening of K s/(|s| + delta); 0 is K sgn(s)", "rad/s^2", ge=0.0, live=True)
    model: Literal["printed", "motor"] = param(
        "printed", "controller's model: the coefficients as printed, or computed from R, L, J, b, Kt and Ke", live=True
    )
    model_gain: float = param(13.89, "gain of the model w'' = gain u - a1 w' - a0 w, eq. (16)", gt=0.0, live=True)
    model_a1: float = param(5.648, "coefficient a1 of that model", "1/s", live=True)
    model_a0: float = param(1.509, "coefficient a0 of that model", "1/s^2", live=True)
    publish_surface: bool = param(False, "also publish s on motor/surface")

    def coefficients(self) -> tuple[float, float, float]:
        """Return gain, a1 and a0 of the model w'' = gain u - a1 w' - a0 w, eq. (14) where they are not printed."""
        if self.model == "printed":
            return self.model_gain, self.model_a1, self.model_a0
        inertia = self.J * self.L
        return (
            self.Kt / inertia,
            (self.R * self.J + self.L * self.b) / inertia,
            (self.R * self.b + self.Kt * self.Ke) / inertia,
        )


P = TypeVar("P", bound=SurfaceParams, default=SurfaceParams)


class SurfaceControl(SpeedControl[P]):
    """The sliding mode controller for a speed and its derivative from any source.

    ::

        e = wd - w,  s = c e + e'
        u = (a0 w + a1 w' + wd'' + c e' + K sgn(s))/gain               paper eq. (33)
        u = (a0 w + a1 w' + wd'' + c e' + K s/(|s| + delta))/gain      paper eq. (36)

    with wd' = wd'' = 0, because the reference is a constant that may step. On the ideal motor s' = -K sgn(s). If K
    follows the reference, a reference of zero keeps the previous K; otherwise nothing would brake the motor.

    The law has no integral: changed gains act from the next tick on, and the voltage of a switching law may jump at
    every tick.
    """

    OUTPUTS = (COMMAND,)

    @classmethod
    def ports(cls, params: SurfaceParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Declare the surface as an output on request."""
        return cls.INPUTS, (COMMAND, SURFACE) if params.publish_surface else cls.OUTPUTS

    def setup(self) -> None:
        """Divide the law by the gain of its model."""
        p = self.p
        self._gain, a1, a0 = p.coefficients()
        self._w_gain = a0 / self._gain
        self._wd_gain = (a1 - p.c) / self._gain
        self._c, self._delta, self._surface = p.c, p.delta, p.publish_surface
        self._k, self._k_per_ref = p.k, p.k_per_ref

    def go_on(self, x: Any, before: P) -> Any:
        """Continue with other gains; another set point scales K."""
        x = super().go_on(x, before)
        return x._replace(size=abs(x.r) or x.size)

    def law(self, size: float, r: float, w: float, wd: float) -> Values:
        """Compute the command for the reference r, the size of it that scales K, the speed w and its derivative wd."""
        s = self._c * (r - w) - wd
        k_gain = (self._k_per_ref * size if self._k is None else self._k) / self._gain
        u = self._w_gain * w + self._wd_gain * wd + k_gain * switching(s, self._delta)
        return {"command": (u,), "surface": (s,)} if self._surface else {"command": (u,)}


class DcMotorSmcParams(SurfaceParams):
    """The law of the paper and its source of w'."""

    wd_source: Literal["current", "diff"] = param(
        "current", "w' from the measured current, w' = wd_i i - wd_w w, or from the difference of speeds"
    )
    wd_lp: float = param(
        0.0, "time constant of a first-order low-pass on w' of the difference; 0 is none", "s", ge=0.0, live=True
    )
    wd_w: float = param(5.5, "printed model: b/J in w' of the current", "1/s", live=True)
    wd_i: float = param(37.5, "printed model: Kt/J in w' of the current", "rad/s^2/A", live=True)


class State(NamedTuple):
    """State of the control law.

    Reference (rad/s) and the magnitude that scales K, 0 until a reference other than zero arrives; for the derivative,
    the speed of the previous tick (rad/s, None before the first) and w' (rad/s^2).
    """

    r: float
    size: float
    w: float | None = None
    wd: float = 0.0


class DcMotorSmc(SurfaceControl[DcMotorSmcParams]):
    """Sliding mode on the measured speed and current; see `SurfaceControl` for the law."""

    INPUTS = (SPEED, SENSORS, REFERENCE)

    def setup(self) -> None:
        """Prepare law and filter."""
        super().setup()
        p = self.p
        self._current = p.wd_source == "current"
        self._wd_w, self._wd_i = (p.wd_w, p.wd_i) if p.model == "printed" else (p.b / p.J, p.Kt / p.J)
        self._rate = 1.0 / p.period
        self._blend = -math.expm1(-p.period / p.wd_lp) if p.wd_lp else 1.0

    def first(self) -> State:
        """Begin with the set point and its switching gain; a motor at rest."""
        return State(self.p.set_point, abs(self.p.set_point))

    def update(
        self,
        x: State,
        t: int,
        *,
        state: tuple[float, ...],
        sensors: tuple[float, ...],
        reference: tuple[float, ...] | None,
    ) -> tuple[State, Values]:
        """Return the voltage."""
        w = state[0]
        r = self.reference(x.r, reference)
        size = abs(r) or x.size
        if self._current:
            if r != x.r:
                x = State(r, size)
            return x, self.law(size, r, w, self._wd_i * sensors[1] - self._wd_w * w)
        wd = x.wd if x.w is None else x.wd + self._blend * ((w - x.w) * self._rate - x.wd)
        return State(r, size, w, wd), self.law(size, r, w, wd)
