"""Sliding mode speed controller, the paper's law."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Literal

from softrig_control.sliding_mode import switching
from softrig_core import Port, executable, param
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
        "printed", "the law's model: the coefficients as printed, or computed from R, L, J, b, Kt and Ke", live=True
    )
    model_gain: float = param(13.89, "gain of the law's model w'' = gain u - a1 w' - a0 w, eq. (16)", gt=0.0,
                              live=True)  # fmt: skip
    model_a1: float = param(5.648, "coefficient a1 of that model", "1/s", live=True)
    model_a0: float = param(1.509, "coefficient a0 of that model", "1/s^2", live=True)
    publish_surface: bool = param(False, "also publish s on motor/surface")

    def coefficients(self) -> tuple[float, float, float]:
        """Give gain, a1 and a0 of the model w'' = gain u - a1 w' - a0 w, eq. (14) where they are not printed."""
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
    """The sliding mode law on a speed and its derivative, wherever they come from.

    ::

        e = wd - w,  s = c e + e'
        u = (a0 w + a1 w' + wd'' + c e' + K sgn(s))/gain               paper eq. (33)
        u = (a0 w + a1 w' + wd'' + c e' + K s/(|s| + delta))/gain      paper eq. (36)

    with wd' = wd'' = 0, because the reference is a constant that may step. On the ideal motor s' = -K sgn(s). Where K
    follows the reference, a reference of zero keeps the K of the one before, or nothing would brake the motor.

    The law has no integral: other gains act at the next tick, and the voltage of a switching law may jump at any.
    """

    OUTPUTS = (COMMAND,)

    @classmethod
    def ports(cls, params: SurfaceParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """The surface is an output when asked for."""
        return cls.INPUTS, (COMMAND, SURFACE) if params.publish_surface else cls.OUTPUTS

    def setup(self) -> None:
        """Divide the law by the gain of its model."""
        p = self.p
        self._gain, a1, a0 = p.coefficients()
        self._w_gain = a0 / self._gain
        self._wd_gain = (a1 - p.c) / self._gain
        self._c, self._delta, self._surface = p.c, p.delta, p.publish_surface

    def start(self) -> None:
        """Begin with the set point and its switching gain."""
        super().start()
        self._size = 0.0  # of the reference that scales K: 0 until there is one other than zero
        self._rescale(self._r)

    def change(self, params: P) -> None:
        """Take other gains, K for the reference that it was scaled to."""
        super().change(params)
        self._rescale(self._r)

    def _rescale(self, r: float) -> None:
        p = self.p
        self._scaled_to = r
        self._size = abs(r) or self._size
        self._k_gain = (p.k_per_ref * self._size if p.k is None else p.k) / self._gain

    def law(self, r: float, w: float, wd: float) -> Mapping[str, tuple[float, ...]]:
        """Answer for the reference r, the speed w and its derivative wd."""
        if r != self._scaled_to:
            self._rescale(r)
        s = self._c * (r - w) - wd
        u = self._w_gain * w + self._wd_gain * wd + self._k_gain * switching(s, self._delta)
        return {"command": (u,), "surface": (s,)} if self._surface else {"command": (u,)}


class DcMotorSmcParams(SurfaceParams):
    """The law of the paper and its source of w'."""

    wd_source: Literal["current", "diff"] = param(
        "current", "w' from the measured current, w' = wd_i i - wd_w w, or from the difference of speeds"
    )
    wd_lp: float = param(0.0, "time constant of a first-order low-pass on w' of the difference; 0 is none", "s", ge=0.0,
                         live=True)  # fmt: skip
    wd_w: float = param(5.5, "printed model: b/J in w' of the current", "1/s", live=True)
    wd_i: float = param(37.5, "printed model: Kt/J in w' of the current", "rad/s^2/A", live=True)


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

    def start(self) -> None:
        """No speed before the first; a motor at rest."""
        super().start()
        self._w: float | None = None
        self._wd = 0.0

    def update(
        self, t: int, *, state: tuple[float, ...], sensors: tuple[float, ...], reference: tuple[float, ...] | None
    ) -> Mapping[str, tuple[float, ...]]:
        """Give the voltage."""
        w = state[0]
        r = self.reference(reference)
        if self._current:
            return self.law(r, w, self._wd_i * sensors[1] - self._wd_w * w)
        if self._w is not None:
            self._wd += self._blend * ((w - self._w) * self._rate - self._wd)
        self._w = w
        return self.law(r, w, self._wd)


main = executable(DcMotorSmc)
