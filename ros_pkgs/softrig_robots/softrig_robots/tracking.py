"""Figures of a tracking loop while it runs."""

from __future__ import annotations

from collections.abc import Iterator

from softrig_core import Measure, Port, Watch, WatchParams, command, executable, joint_state, param, reference
from softrig_core.rig import measures


class TrackingMonitorParams(WatchParams):
    """Which joints and motors, and from when on the late figures count."""

    period: float = param(0.001, "sampling period", "s", gt=0.0, le=100.0)
    joints: tuple[str, ...] = param(("joint1", "joint2", "joint3"), "joint names", min_length=1)
    motors: tuple[str, ...] = param(("motor1", "motor2", "motor3"), "channels of motor_command", min_length=1)
    late: float = param(2.5, "begin of the late window", "s", ge=0.0)
    band: float = param(0.002, "an error inside this band counts as settled", "rad", gt=0.0)


class TrackingMonitor(Watch[TrackingMonitorParams]):
    """Largest and rms errors, largest late errors, settling times, peak voltages and their total variation."""

    @classmethod
    def ports(cls, params: TrackingMonitorParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Listens only."""
        return (
            joint_state("joint_states", "joint_states", params.joints, position="rad"),
            reference("reference", "reference", params.joints, position="rad"),
            command("motor_command", "motor_command", params.motors, "V"),
        ), ()

    def measures(self) -> Iterator[Measure]:
        """Figures of each joint and motor."""
        for joint in self.p.joints:
            pair = {"signal": f"joint_states/{joint}/position", "reference": f"reference/{joint}/position"}
            yield Measure(f"max_error {joint}", measures.peak, pair)
            yield Measure(f"rms_error {joint}", measures.rms, pair)
            yield Measure(f"late_max_error {joint}", measures.peak, pair | {"start": self.p.late})
            yield Measure(f"settling_time {joint}", measures.error_settling_time, pair | {"band": self.p.band})
        for motor in self.p.motors:
            voltage = {"signal": f"motor_command/{motor}/effort"}
            yield Measure(f"peak_voltage {motor}", measures.peak, voltage)
            yield Measure(f"total_variation {motor}", measures.total_variation, voltage | {"start": self.p.late})


main = executable(TrackingMonitor)
