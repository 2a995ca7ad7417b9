"""Passive range-of-motion exercise: sigmoids from the lower to the upper end of the range and back, equation (26)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import exp, radians
from typing import Any

from softrig_core import Block, BlockParams, param, reference, to_ns, to_s
from softrig_core.motion import Goal, Path

from ..joints import PerJoint, require_positive, spread
from .model import JOINTS, LOWER, UPPER


class PromReferenceParams(BlockParams):
    """Published exercise; the centres of the sigmoids and the cycle are not printed in the paper."""

    period: float = param(0.001, "sampling period", "s", gt=0.0, le=100.0)
    lower: PerJoint = param(LOWER, "lower ends of the range of motion", "rad", live=True)
    upper: PerJoint = param(UPPER, "upper ends of the range of motion", "rad", live=True)
    speed: PerJoint = param((radians(30.0),), "largest speed; fixes the width a = range/(4 speed)", "rad/s", live=True)
    cycle: float = param(30.0, "duration of one repetition T_prd", "s", gt=0.0, live=True)
    eta1: float = param(8.0, "time at the centre of the upward motion", "s", gt=0.0, live=True)
    eta2: float = param(22.0, "time at the centre of the downward motion", "s", gt=0.0, live=True)
    goal: Goal = Goal()

    def _check(self) -> None:
        n = len(JOINTS)
        self.goal.require(n)
        for low, high in zip(spread("lower", self.lower, n), spread("upper", self.upper, n), strict=True):
            if low >= high:
                raise ValueError(f"lower = {list(self.lower)} and upper = {list(self.upper)}: expected lower < upper")
        require_positive("speed", spread("speed", self.speed, n))
        if not self.eta1 < self.eta2 < self.cycle:
            raise ValueError(
                f"eta1 = {self.eta1:g} s, eta2 = {self.eta2:g} s, cycle = {self.cycle:g} s: expected "
                "eta1 < eta2 < cycle"
            )


class PromReference(Block[PromReferenceParams]):
    """Publishes positions, velocities and accelerations at every tick: the exercise, or the motion to a goal."""

    OUTPUTS = (reference("reference", "reference", JOINTS, position="rad", velocity="rad/s", acceleration="rad/s^2"),)

    def setup(self) -> None:
        """Derive range and width of each joint, and the motion to a goal."""
        n = len(JOINTS)
        self._low = spread("lower", self.p.lower, n)
        self._range = [high - low for low, high in zip(self._low, spread("upper", self.p.upper, n), strict=True)]
        self._width = [r / (4.0 * v) for r, v in zip(self._range, spread("speed", self.p.speed, n), strict=True)]
        self._cycle = to_ns(self.p.cycle)
        self._path = Path(self.p.goal, n) if self.p.goal.times else None

    def update(self, x: Any, t: int, **inputs: Any) -> tuple[Any, Mapping[str, tuple[float, ...]]]:
        """Return the reference at t."""
        if self._path is not None:
            return x, {"reference": self._path.at(t)}
        eta = to_s(t % self._cycle)
        q, v, a = [], [], []
        for low, span, width in zip(self._low, self._range, self._width, strict=True):
            y, yd, ydd = _bump(eta, self.p.eta1, self.p.eta2, width)
            q.append(span * y + low)
            v.append(span * yd)
            a.append(span * ydd)
        return x, {"reference": (*q, *v, *a)}


def _bump(eta: float, eta1: float, eta2: float, width: float) -> Sequence[float]:
    """y(eta, eta1) - y(eta, eta2) and its first two derivatives, y = 1/(1 + exp(-(eta - eta_i)/width))."""
    up = 1.0 / (1.0 + exp(-(eta - eta1) / width))
    down = 1.0 / (1.0 + exp(-(eta - eta2) / width))
    up_rate, down_rate = up * (1.0 - up) / width, down * (1.0 - down) / width
    return (
        up - down,
        up_rate - down_rate,
        (up_rate * (1.0 - 2.0 * up) - down_rate * (1.0 - 2.0 * down)) / width,
    )
