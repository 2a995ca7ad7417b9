"""Axis of a DC motor behind a limited amplifier, with an incremental encoder and optional dry friction."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

from softrig_control.hardware import axis_urdf, hardware_tag
from softrig_core import Plant, param

from .motor import Motion, MotorParams
from .ports import AXIS, COMMAND, STATE, TRUE_STATE

SUBSTEP = 1e-3  # s, with friction: the longest step between two looks at stick and slip


class DcAxisParams(MotorParams):
    """Motor, encoder and friction."""

    counts_per_rev: float = param(400.0, "encoder pulses per revolution", gt=0.0)
    mm_per_rev: float = param(10.0, "travel per revolution", "mm", gt=0.0)
    velocity_window: int = param(2, "periods between the two counts whose difference gives the speed", ge=1, le=1000)
    friction: bool = param(False, "dry friction on")
    coulomb: float = param(40.0, "deceleration by Coulomb friction", "mm/s^2", ge=0.0)
    stiction: float = param(60.0, "acceleration up to which the axis at rest sticks", "mm/s^2", ge=0.0)

    def _check(self) -> None:
        if self.stiction < self.coulomb:
            raise ValueError(f"stiction {self.stiction:g} mm/s^2 is below coulomb {self.coulomb:g} mm/s^2")


class State(NamedTuple):
    """Position (mm) and speed (mm/s); the encoder's counts of the previous periods, oldest first."""

    y: float = 0.0
    v: float = 0.0
    past: tuple[float, ...] = ()


class DcAxisPlant(Plant[DcAxisParams]):
    """Axis with y' = v, v' = -pole v + gain u_m - friction, |u_V| <= u_limit_v, held over the period.

    Without friction one exact step a period; with friction sub-steps of at most 1 ms, each exact between the events
    (stop, stick, break-away). The encoder reads E = floor(y / q + 1e-9) counts of q = mm_per_rev / counts_per_rev
    and its speed (E_k - E_(k-w)) q / (w dt); counts before the start are those at rest at y = 0.

    Notes
    -----
    Love, Kriger, Tshemese-Mvandaba (2024), eqs (1) and (2). The printed matrix is the plant of the unity position
    loop G/(1 + G), G = 2.2862 / (s (s + 5.26)); G itself is the motor.
    """

    DRAWN_BY = "softrig_drives.dc_axis.drawing:DcAxis"
    INPUTS = (replace(COMMAND, also=AXIS),)  # ros2_control knows one name for both ways
    OUTPUTS = (STATE, TRUE_STATE)

    def latched(self) -> Mapping[str, str]:
        """Return the URDF for ros2_control, whose command is the voltage of the armature."""
        tag = hardware_tag("dc_axis", AXIS, "/axis/state", "/axis/command", ("position", "velocity"))
        return {"robot_description": axis_urdf("dc_axis", *AXIS, "prismatic", (1e3, 1e4), tag)}

    def setup(self) -> None:
        """Prepare the exact steps."""
        p = self.p
        self._gain = p.gain * p.mm_per_volt
        self._steps = math.ceil(p.period / SUBSTEP - 1e-9) if p.friction else 1
        self._motion = Motion(p.pole, p.period / self._steps)
        self._resolution = p.mm_per_rev / p.counts_per_rev
        self._per_count = self._resolution / (p.velocity_window * p.period)

    def first(self) -> State:
        """Rest at y = 0."""
        return State(past=(0.0,) * self.p.velocity_window)

    def _counts(self, y: float) -> float:
        return float(math.floor(y / self._resolution + 1e-9))

    def outputs(self, x: State, t: int) -> Mapping[str, tuple[float, float]]:
        """Return the encoder's reading, and the true state."""
        y, v, past = x
        counts = self._counts(y)
        return {"state": (counts * self._resolution, (counts - past[0]) * self._per_count), "true_state": (y, v)}

    def advance(self, x: State, t: int, *, command: tuple[float]) -> State:
        """Move one period with the voltage held."""
        y, v, past = x
        past = (*past[1:], self._counts(y))
        u, limit = command[0], self.p.u_limit_v
        f = self._gain * min(max(u, -limit), limit)
        if self.p.friction:
            for _ in range(self._steps):
                y, v = self._slide(y, v, f)
        else:
            y, v = self._move(y, v, f)
        return State(y, v, past)

    def _move(self, y: float, v: float, f: float) -> tuple[float, float]:
        """Move by one step under the net force, up to the speed limit."""
        new_y, new_v = self._motion.step(y, v, f)
        if abs(new_v) > self.p.vmax:
            top = math.copysign(self.p.vmax, new_v)
            return self._motion.stop(y, v, f, top), top
        return new_y, new_v

    def _slide(self, y: float, v: float, f: float) -> tuple[float, float]:
        """Move by one sub-step with dry friction: stuck, slipping, or coming to rest inside it."""
        if v == 0.0:
            return self._move(y, v, f - math.copysign(self.p.coulomb, f)) if abs(f) > self.p.stiction else (y, v)
        net = f - math.copysign(self.p.coulomb, v)
        if v * self._motion.step(y, v, net)[1] > 0.0:
            return self._move(y, v, net)
        return self._motion.stop(y, v, net, 0.0), 0.0
