"""PI speed controller, the first of the two that the fuzzy controller is compared with."""

from __future__ import annotations

from collections.abc import Mapping

from softrig_control.pid import Pid, PidParams, PidState
from softrig_core import param

from .speed_control import SpeedControl, SpeedControlParams


class LsrmPiParams(SpeedControlParams):
    """The paper's gains, and the scale that the paper does not state."""

    K_F: float = param(
        80.0,
        "force for a control value of 1; gives the published peak error of 0.1 m/s",
        "N",
        gt=0.0,
        le=1e4,
        live=True,
    )
    K_p: float = param(1.3, "proportional gain", "s/m", ge=0.0, le=1e4, live=True)
    K_i: float = param(3.2, "integral gain", "1/m", ge=0.0, le=1e5, live=True)


class LsrmPi(SpeedControl[LsrmPiParams]):
    """F* = K_F (K_p e + K_i int e dt), within plus and minus F_max, with conditional anti-windup.

    The integral does not contain the newest error yet (see `softrig_control.pid.Pid`).
    """

    STATE = PidState

    def setup(self) -> None:
        """Create the law."""
        p = self.p
        self._pid = Pid(PidParams(kp=p.K_F * p.K_p, ki=p.K_F * p.K_i, u_max=p.F_max), p.period)

    def go_on(self, x: PidState, before: LsrmPiParams) -> PidState:
        """Continue with other gains without a jump, see `softrig_control.pid.Pid.go_on`."""
        return self._pid.after_kp(x, before.K_F * before.K_p)

    def update(
        self, x: PidState, t: int, *, joint_states: tuple[float, ...], reference: tuple[float, ...]
    ) -> tuple[PidState, Mapping[str, tuple[float, ...]]]:
        """Return the force command."""
        x, force = self._pid(x, reference[1] - joint_states[0])
        return x, {"force_cmd": (self.clip(force),)}
