"""The paper's indices while the exercise runs."""

from __future__ import annotations

from collections.abc import Iterator

from softrig_core import Measure, Watch, WatchParams, command, executable, joint_state, param, reference
from softrig_core.rig import measures

from .model import JOINTS


class RehabMonitorParams(WatchParams):
    """From when on the late figures count."""

    period: float = param(0.001, "sampling period", "s", gt=0.0, le=100.0)
    late: float = param(3.0, "begin of the late window", "s", ge=0.0)


class RehabMonitor(Watch[RehabMonitorParams]):
    """MSE, SAE, IAE of the error, MAC of the currents, MAV of the voltages, rms of the late error; angles in degrees.

    Remap ``reference`` to ``regenerated`` behind an impedance law.
    """

    INPUTS = (
        joint_state("joint_states", "joint_states", JOINTS, position="rad"),
        joint_state("motor_states", "motor_states", JOINTS, effort="A"),
        command("motor_command", "motor_command", JOINTS, "V"),
        reference("reference", "reference", JOINTS, position="rad"),
    )

    def measures(self) -> Iterator[Measure]:
        """Figures of each joint."""
        for joint in JOINTS:
            error = {"signal": f"joint_states/{joint}/position", "reference": f"reference/{joint}/position"}
            yield Measure(f"mse {joint}", measures.mean_square, error, "deg^2")
            yield Measure(f"sae {joint}", measures.sum_absolute, error, "deg")
            yield Measure(f"iae {joint}", measures.integral_absolute, error, "deg s")
            yield Measure(f"mac {joint}", measures.mean_absolute, {"signal": f"motor_states/{joint}/effort"})
            yield Measure(f"mav {joint}", measures.mean_absolute, {"signal": f"motor_command/{joint}/effort"})
            yield Measure(f"late_rms_error {joint}", measures.rms, error | {"start": self.p.late}, "deg")


main = executable(RehabMonitor)
