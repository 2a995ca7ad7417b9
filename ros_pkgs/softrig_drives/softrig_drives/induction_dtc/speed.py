"""Speed loop around the torque control."""

from __future__ import annotations

from typing import NamedTuple

from softrig_control.pid import Pid, PidParams, PidState
from softrig_core import Block, BlockParams, Values, param

from .ports import SPEED, SPEED_REF, TORQUE_REF


class SpeedControllerParams(PidParams, BlockParams):
    """Gains of the speed loop."""

    period: float = param(1e-3, "sampling period", "s", gt=0.0, le=100.0)
    kp: float = param(1.5, "proportional gain K_p", "N m s/rad", live=True)
    ki: float = param(15.0, "integral gain K_i", "N m/rad", live=True)
    kd: float = param(0.0, "derivative gain K_d", "N m s^2/rad", live=True)
    u_max: float = param(20.0, "largest torque reference", "N m", gt=0.0, live=True)
    slew: float = param(500.0, "slew rate of the speed reference", "rad/s^2", gt=0.0, live=True)


class State(NamedTuple):
    """Memory of the law, speed reference as slewed (rad/s)."""

    pid: PidState = PidState()
    reference: float = 0.0


class SpeedController(Block[SpeedControllerParams]):
    """PID on the speed error, its reference slewed, its output clipped; see `softrig_control.pid.Pid`."""

    INPUTS = (SPEED, SPEED_REF)
    OUTPUTS = (TORQUE_REF,)
    STATE = State

    def setup(self) -> None:
        """Create the law."""
        self._pid = Pid(self.p, self.p.period)
        self._rise = self.p.slew * self.p.period

    def go_on(self, x: State, before: SpeedControllerParams) -> State:
        """Continue with other gains without a jump, see `softrig_control.pid.Pid.go_on`."""
        return x._replace(pid=self._pid.go_on(x.pid, before))

    def update(
        self, x: State, t: int, *, joint_states: tuple[float, ...], speed_ref: tuple[float, ...] | None
    ) -> tuple[State, Values]:
        """Return the torque reference; without a speed reference hold the standstill."""
        target = 0.0 if speed_ref is None else speed_ref[0]
        reference = x.reference + min(max(target - x.reference, -self._rise), self._rise)
        pid, torque = self._pid(x.pid, reference - joint_states[0])
        u_max = self.p.u_max
        return State(pid, reference), {"torque_ref": (min(max(torque, -u_max), u_max),)}
