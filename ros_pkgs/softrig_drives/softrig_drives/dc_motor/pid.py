"""PID speed controller, the paper's baseline."""

from __future__ import annotations

from collections.abc import Mapping

from softrig_control.pid import Pid, PidParams
from softrig_core import executable, param

from .ports import COMMAND, REFERENCE, SPEED
from .speed_control import SpeedControl, SpeedControlParams


class DcMotorPidParams(PidParams, SpeedControlParams):
    """Gains solved from rise time, settling time and overshoot of the paper's Table II."""

    kp: float = param(4.45596543, "proportional gain Kp", "V s/rad", live=True)
    ki: float = param(1.73184573, "integral gain Ki", "V/rad", live=True)
    kd: float = param(0.12374157, "derivative gain Kd", "V s^2/rad", live=True)
    u_max: float = param(12.0, "supply voltage that the anti-windup assumes", "V", gt=0.0, live=True)


class DcMotorPid(SpeedControl[DcMotorPidParams]):
    """u = Kp e + Ki int e + Kd e' on the measured speed, e = wd - w; see `softrig_control.pid.Pid`."""

    INPUTS = (SPEED, REFERENCE)
    OUTPUTS = (COMMAND,)

    def setup(self) -> None:
        """Make the law."""
        self._pid = Pid(self.p, self.p.period)

    def change(self, params: DcMotorPidParams) -> None:
        """Take other gains without a bump, see `softrig_control.pid.Pid.retune`."""
        law = self._pid
        super().change(params)
        law.retune(params, params.period)
        self._pid = law

    def start(self) -> None:
        """Forget integral, derivative and reference."""
        super().start()
        self._pid.reset()

    def update(
        self, t: int, *, state: tuple[float, ...], reference: tuple[float, ...] | None
    ) -> Mapping[str, tuple[float, ...]]:
        """Give the voltage."""
        e = self.reference(reference) - state[0]
        return {"command": (self._pid(e),)}


main = executable(DcMotorPid)
