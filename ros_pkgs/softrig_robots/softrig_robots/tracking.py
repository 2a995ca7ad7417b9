"""Figures of a tracking loop while it runs."""

from __future__ import annotations

import math
from collections.abc import Mapping

from softrig_core.model.block import Observer
from softrig_core.model.params import BlockParams, param
from softrig_core.model.port import Port, command, joint_state, reference
from softrig_core.node import executable

from .joints import motor_names

JOINTS = ("joint1", "joint2", "joint3")
Vector = tuple[float, ...]


class TrackingMetricsParams(BlockParams):
    """Which joints and motors, and from when on the late figures count."""

    period: float = param(0.001, "sampling period", "s", gt=0.0)
    joints: tuple[str, ...] = param(JOINTS, "joint names", min_length=1)
    motors: tuple[str, ...] = param(motor_names(JOINTS), "channels of motor_command", min_length=1)
    late: float = param(2.5, "begin of the late window", "s", ge=0.0)
    band: float = param(0.002, "an error inside this band counts as settled", "rad", gt=0.0)


class TrackingMetrics(Observer):
    """Largest and rms errors, largest late errors, settling times, peak voltages and their total variation.

    In constant memory; the definitions are those of `softrig_core.rig.metrics`, which see
    the whole recording. A sample counts when the next one has come: at the end of a run the plant gives
    outputs that no reference belongs to.
    """

    Params = TrackingMetricsParams
    p: TrackingMetricsParams

    @classmethod
    def ports(cls, params: TrackingMetricsParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Listens only."""
        return (
            joint_state("joint_states", "joint_states", params.joints, position="rad"),
            reference("reference", "reference", params.joints, position="rad"),
            command("motor_command", "motor_command", params.motors, "V"),
        ), ()

    def start(self) -> None:
        """Nothing seen yet."""
        n, m = len(self.p.joints), len(self.p.motors)
        self._count = 0
        self._waiting: tuple[int, Vector, Vector, Vector] | None = None
        self._max, self._late, self._squares, self._settled = [0.0] * n, [0.0] * n, [0.0] * n, [0.0] * n
        self._peak, self._variation = [0.0] * m, [0.0] * m
        self._voltages: Vector | None = None
        self._from = self._now = 0.0

    def update(self, t: int, *, joint_states: Vector, reference: Vector, motor_command: Vector) -> Mapping[str, Vector]:
        """Take one sample in."""
        if self._waiting is not None:
            self._account(*self._waiting)
        self._waiting = (t, joint_states, reference, motor_command)
        return {}

    def _account(self, t: int, joint_states: Vector, reference: Vector, motor_command: Vector) -> None:
        self._now = now = t / 1e9
        late = now >= self.p.late
        self._count += 1
        for i, (q, q_d) in enumerate(zip(joint_states, reference, strict=True)):
            e = abs(q_d - q)
            self._squares[i] += e * e
            self._max[i] = max(self._max[i], e)
            if late:
                self._late[i] = max(self._late[i], e)
            if e > self.p.band:
                self._settled[i] = math.inf
            elif self._settled[i] == math.inf:
                self._settled[i] = now
        for i, v in enumerate(motor_command):
            self._peak[i] = max(self._peak[i], abs(v))
        if late:
            if self._voltages is None:
                self._from = now
            else:
                for i, (v, before) in enumerate(zip(motor_command, self._voltages, strict=True)):
                    self._variation[i] += abs(v - before)
            self._voltages = motor_command

    def status(self) -> Mapping[str, tuple[float, str]]:
        """Give the figures so far."""
        figures = {}
        for i, joint in enumerate(self.p.joints if self._count else ()):
            figures[f"max_error {joint}"] = (self._max[i], "rad")
            figures[f"rms_error {joint}"] = (math.sqrt(self._squares[i] / self._count), "rad")
            figures[f"late_max_error {joint}"] = (self._late[i], "rad")
            figures[f"settling_time {joint}"] = (self._settled[i], "s")
        for i, motor in enumerate(self.p.motors if self._count else ()):
            figures[f"peak_voltage {motor}"] = (self._peak[i], "V")
            if self._now > self._from and self._voltages is not None:
                figures[f"total_variation {motor}"] = (self._variation[i] / (self._now - self._from), "V/s")
        return figures


main = executable(TrackingMetrics)
