"""PID speed controller, the paper's baseline."""

from __future__ import annotations

from typing import NamedTuple

from softrig_control.pid import Pid, PidParams, PidState
from softrig_core import Values, param

from .ports import COMMAND, REFERENCE, SPEED
from .speed_control import SpeedControl, SpeedControlParams


class DcMotorPidParams(PidParams, SpeedControlParams):
    """Gains solved from rise time, settling time and overshoot of the paper's Table II."""

    kp: float = param(4.45596543, "proportional gain Kp", "V s/rad", live=True)
    ki: float = param(1.73184573, "integral gain Ki", "V/rad", live=True)
    kd: float = param(0.12374157, "derivative gain Kd", "V s^2/rad", live=True)
    u_max: float = param(12.0, "supply voltage that the anti-windup assumes", "V", gt=0.0, live=True)


class State(NamedTuple):
    """Reference that is followed (rad/s), memory of the law."""

    r: float
    pid: PidState = PidState()


class DcMotorPid(SpeedControl[DcMotorPidParams]):
    """u = Kp e + Ki int e + Kd e' on the measured speed, e = wd - w; see `softrig_control.pid.Pid`."""

    INPUTS = (SPEED, REFERENCE)
    OUTPUTS = (COMMAND,)

    def setup(self) -> None:
        """Create the law."""
        self._pid = Pid(self.p, self.p.period)

    def first(self) -> State:
        """Begin with the set point."""
        return State(self.p.set_point)

    def go_on(self, x: State, before: DcMotorPidParams) -> State:
        """Continue with other gains without a jump, see `softrig_control.pid.Pid.go_on`."""
        x = super().go_on(x, before)
        return State(x.r, self._pid.go_on(x.pid, before))

    def update(
        self, x: State, t: int, *, state: tuple[float, ...], reference: tuple[float, ...] | None
    ) -> tuple[State, Values]:
        """Return the voltage."""
        r = self.reference(x.r, reference)
        pid, u = self._pid(x.pid, r - state[0])
        return State(r, pid), {"command": (u,)}
