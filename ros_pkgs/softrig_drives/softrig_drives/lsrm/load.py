"""Load of the motor: added mass and Coulomb friction."""

from __future__ import annotations

from typing import Any

from softrig_control.profile import StepProfile
from softrig_core import Block, BlockParams, Values, param

from .ports import LOAD

GRAVITY = 9.81


class LsrmLoadParams(BlockParams):
    """Parameters of the load: masses on the translator, and the times at which they change."""

    period: float = param(1e-3, "sampling period", "s", gt=0.0, le=1.0)
    times: tuple[float, ...] = param(
        (0.0, 1.0), "times at which the mass changes, increasing from 0", "s", each=(0.0, 1e9), live=True
    )
    masses: tuple[float, ...] = param(
        (0.0, 8.0), "added mass from each of these times on", "kg", each=(0.0, 1e5), live=True
    )
    mu: float = param(0.05, "friction coefficient of the added mass", ge=0.0, le=10.0, live=True)

    def _check(self) -> None:
        if not self.times or self.times[0] != 0.0:
            raise ValueError(f"times {list(self.times)}: expected the first to be 0")
        StepProfile(self.times, self.masses)


class LsrmLoad(Block[LsrmLoadParams]):
    """Publishes the added mass m and its friction mu m g."""

    OUTPUTS = (LOAD,)

    def setup(self) -> None:
        """Prepare the answer for each time."""
        p = self.p
        self._answers = StepProfile(p.times, [{"load": (m, p.mu * m * GRAVITY)} for m in p.masses])

    def update(self, x: Any, t: int, **inputs: Any) -> tuple[Any, Values]:
        """Return the load at t."""
        return x, self._answers.at(t)
