"""The paper's indices while the exercise runs."""

from __future__ import annotations

import math
from collections.abc import Mapping

from softrig_core.model.block import Observer
from softrig_core.model.params import BlockParams, param
from softrig_core.model.port import command, joint_state, reference
from softrig_core.node import executable

from .model import JOINTS

Vector = tuple[float, ...]


class RehabMetricsParams(BlockParams):
    """From when on the late figures count."""

    period: float = param(0.001, "sampling period", "s", gt=0.0)
    late: float = param(3.0, "begin of the late window", "s", ge=0.0)


class RehabMetrics(Observer):
    """MSE, SAE, IAE of the error, MAC of the currents, MAV of the voltages, rms of the late error; angles in degrees.

    In constant memory. Remap ``reference`` to ``regenerated`` behind an impedance law. A sample counts when the next
    one has come: at the end of a run the plant gives outputs that no reference belongs to.
    """

    Params = RehabMetricsParams
    p: RehabMetricsParams
    INPUTS = (
        joint_state("joint_states", "joint_states", JOINTS, position="rad"),
        joint_state("motor_states", "motor_states", JOINTS, effort="A"),
        command("motor_command", "motor_command", JOINTS, "V"),
        reference("reference", "reference", JOINTS, position="rad"),
    )

    def start(self) -> None:
        """Nothing seen yet."""
        n = len(JOINTS)
        self._count = self._late = 0
        self._squares, self._late_squares, self._absolute = [0.0] * n, [0.0] * n, [0.0] * n
        self._current, self._voltage = [0.0] * n, [0.0] * n
        self._waiting: tuple[int, Vector, Vector, Vector, Vector] | None = None

    def update(
        self, t: int, *, joint_states: Vector, motor_states: Vector, motor_command: Vector, reference: Vector
    ) -> Mapping[str, Vector]:
        """Take one sample in."""
        if self._waiting is not None:
            self._account(*self._waiting)
        self._waiting = (t, joint_states, motor_states, motor_command, reference)
        return {}

    def _account(
        self, t: int, joint_states: Vector, motor_states: Vector, motor_command: Vector, reference: Vector
    ) -> None:
        late = t >= self.p.late * 1e9
        self._count += 1
        self._late += late
        for i in range(len(JOINTS)):
            e = math.degrees(reference[i] - joint_states[i])
            self._squares[i] += e * e
            self._late_squares[i] += e * e * late
            self._absolute[i] += abs(e)
            self._current[i] += abs(motor_states[i])
            self._voltage[i] += abs(motor_command[i])

    def status(self) -> Mapping[str, tuple[float, str]]:
        """Give the figures so far."""
        figures = {}
        n = self._count
        for i, joint in enumerate(JOINTS if n else ()):
            figures[f"mse {joint}"] = (self._squares[i] / n, "deg^2")
            figures[f"sae {joint}"] = (self._absolute[i], "deg")
            figures[f"iae {joint}"] = (self._absolute[i] * self.p.period, "deg s")
            figures[f"mac {joint}"] = (self._current[i] / n, "A")
            figures[f"mav {joint}"] = (self._voltage[i] / n, "V")
            if self._late:
                figures[f"late_rms_error {joint}"] = (math.sqrt(self._late_squares[i] / self._late), "deg")
        return figures


main = executable(RehabMetrics)
