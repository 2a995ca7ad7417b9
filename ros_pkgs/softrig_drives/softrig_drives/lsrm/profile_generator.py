"""Reference of position, speed and acceleration."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from math import inf
from typing import Any

from softrig_core import Block, BlockParams, Level, param, to_s

from .machine import Mechanics
from .ports import REFERENCE
from .profile import Kind, Profile, Quintic

SAMPLES = 400  # samples of each ramp at which the largest force is searched


class ProfileGeneratorParams(Mechanics, BlockParams):
    """Shape and times; mass, friction and F_max are only used to check whether the motor can follow."""

    period: float = param(1e-3, "sampling period", "s", gt=0.0, le=0.1)
    profile: Kind = param(
        "jerk", "jerk: jerk-minimal polynomial; trapezoid: constant acceleration; step: immediate", live=True
    )
    v_d: float = param(0.5, "cruise speed v_d", "m/s", ge=-10.0, le=10.0, live=True)
    t_d: float = param(0.4, "duration of the acceleration t_d", "s", ge=1e-6, le=100.0, live=True)
    x_d: float | None = param(
        None,
        "distance of the acceleration (jerk); the jerk-minimal v_d t_d/2 when absent",
        "m",
        ge=-100.0,
        le=100.0,
        live=True,
    )
    t_b: float | None = param(None, "start of the braking; absent: none", "s", ge=0.0, le=1e4, live=True)
    t_db: float = param(0.4, "duration of the braking", "s", ge=1e-6, le=100.0, live=True)
    F_max: float = param(40.0, "largest force of the motor", "N", gt=0.0, le=1e4, live=True)


class ProfileGenerator(Block[ProfileGeneratorParams]):
    """Publishes a speed profile with its position and acceleration; see `profile.Profile`.

    Warns when the motor cannot follow (M a + (C + k_p) v beyond F_max somewhere) and when a given distance makes the
    speed leave the range between 0 and v_d. After a change of parameters it continues as if the new profile had applied
    from the start: the reference jumps, unless only the future part differs.
    """

    OUTPUTS = (REFERENCE,)

    def setup(self) -> None:
        """Create the profile; compute its requirements."""
        p = self.p
        self.profile = Profile(p.profile, p.v_d, p.t_d, p.x_d, inf if p.t_b is None else p.t_b, p.t_db)
        self._largest = largest_force(self.profile, p.M, p.C + p.k_p)

    def first(self) -> tuple[()]:
        """Report errors of the profile; there is no state."""
        self._judge()
        return ()

    def go_on(self, x: tuple[()], before: ProfileGeneratorParams) -> tuple[()]:
        """Switch to another profile, and report its faults."""
        self._judge()
        return x

    def _judge(self) -> None:
        p = self.p
        need = self._largest
        if need > p.F_max:
            self.report(
                Level.WARN, "infeasible", f"reference infeasible: it needs {need:.3g} N, the motor gives {p.F_max:g} N"
            )
        if p.profile == "jerk" and p.x_d is not None:
            low, high = Quintic.between(0.0, 0.0, p.v_d, p.t_d, p.x_d).speed_range(p.t_d)
            margin = 1e-9 * abs(p.v_d)
            if low < min(0.0, p.v_d) - margin or high > max(0.0, p.v_d) + margin:
                self.report(
                    Level.WARN,
                    "distance",
                    f"x_d = {p.x_d:g} m: the speed runs from {low:.4g} to {high:.4g} m/s, outside 0 to {p.v_d:g} m/s",
                )

    def update(self, x: tuple[()], t: int, **inputs: Any) -> tuple[tuple[()], Mapping[str, tuple[float, ...]]]:
        """Return the reference at t."""
        return x, {"reference": self.profile.at(to_s(t))}


@lru_cache(maxsize=64)
def largest_force(profile: Profile, M: float, damping: float) -> float:
    """Return the largest force (N) that moves a mass M (kg) with damping (N s/m) through the ramps of a profile."""
    times = [profile.t_d * n / SAMPLES for n in range(SAMPLES + 1)]
    if profile.t_b < inf:
        times += [profile.t_b + profile.t_db * n / SAMPLES for n in range(SAMPLES + 1)]
    return max(abs(M * a + damping * v) for _, v, a in map(profile.at, times))
