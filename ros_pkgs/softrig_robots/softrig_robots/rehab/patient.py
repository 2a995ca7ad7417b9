"""The patient: pushes with the foot now and then, F = A sin^2(pi tau / T_push)."""

from __future__ import annotations

from math import pi, sin
from typing import Any

from softrig_core import Block, BlockParams, Values, param, to_ns, wrench

FOOT = "foot"
PATIENT_FORCE = "patient_force"


class PatientParams(BlockParams):
    """A push of 20 N forward for 2 s every 10 s (the paper's figure has no numbers)."""

    period: float = param(0.001, "sampling period", "s", gt=0.0, le=100.0)
    force_x: float = param(20.0, "largest force, forward", "N", live=True)
    force_z: float = param(0.0, "largest force, up", "N", live=True)
    begin: float = param(5.0, "time in each cycle at which the push begins", "s", ge=0.0, live=True)
    duration: float = param(2.0, "duration T_push of a push", "s", gt=0.0, live=True)
    cycle: float = param(10.0, "time between the begins of two pushes", "s", gt=0.0, live=True)

    def _check(self) -> None:
        if self.begin + self.duration > self.cycle:
            raise ValueError(
                f"begin = {self.begin:g} s and duration = {self.duration:g} s do not fit into cycle = {self.cycle:g} s"
            )


class Patient(Block[PatientParams]):
    """Publishes the force at the foot at every tick, in axes of the base."""

    OUTPUTS = (wrench(PATIENT_FORCE, PATIENT_FORCE, FOOT),)

    def setup(self) -> None:
        """Turn times into ns."""
        self._begin, self._duration, self._cycle = map(to_ns, (self.p.begin, self.p.duration, self.p.cycle))

    def update(self, x: Any, t: int, **inputs: Any) -> tuple[Any, Values]:
        """Return the force at t."""
        since = t % self._cycle - self._begin
        share = sin(pi * since / self._duration) ** 2 if 0 <= since < self._duration else 0.0
        return x, {PATIENT_FORCE: (self.p.force_x * share, 0.0, self.p.force_z * share, 0.0, 0.0, 0.0)}
