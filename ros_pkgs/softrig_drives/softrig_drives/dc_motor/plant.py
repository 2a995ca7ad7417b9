"""The motor: ideal, or behind the sensors and the power stage of a small digital rig."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

from softrig_control.discretise import zero_order_hold
from softrig_control.hardware import axis_urdf, hardware_tag
from softrig_control.profile import StepProfile
from softrig_core import BlockParams, Level, Plant, Port, Values, param, to_ns

from .model import MotorConstants, SensorConstants, state_space
from .ports import APPLIED, COMMAND, SENSORS, SHAFT, STATE, TRUE_STATE


class DcMotorPlantParams(SensorConstants, MotorConstants, BlockParams):
    """Motor, supply, load, and the rig's encoder, INA219 current sensor, PWM and L298 bridge."""

    vmax: float = param(12.0, "supply voltage; the command is clipped there", "V", gt=0.0, live=True)
    load_times: tuple[float, ...] = param(
        (0.0,), "times at which the load torque changes, increasing", "s", each=(0.0, 1e9), live=True
    )
    load_torques: tuple[float, ...] = param(
        (0.0,), "load torque TL from each of these times on", "N m", each=(-1e6, 1e6), live=True
    )
    rig: bool = param(False, "sensors and power stage of the digital rig instead of the ideal motor")
    bridge_drop: float = param(2.0, "rig: voltage lost in the L298 bridge (1.5 to 2.5 V)", "V", ge=0.0)
    pwm_bits: int = param(8, "rig: resolution of the PWM", ge=1, le=16)
    current_lsb: float = param(0.0008, "rig: resolution of the current sensor (INA219, 0.1 ohm)", "A", gt=0.0)
    current_limit: float = param(3.2, "rig: range of the current sensor", "A", gt=0.0)
    current_noise: float = param(0.0, "rig: standard deviation of the current sensor's noise", "A", ge=0.0)

    def _check(self) -> None:
        try:
            StepProfile(self.load_times, self.load_torques)
        except ValueError as error:
            raise ValueError(f"load_times, load_torques: {error}") from None
        if self.bridge_drop >= self.vmax:
            raise ValueError(f"bridge_drop = {self.bridge_drop:g} V leaves no voltage of vmax = {self.vmax:g} V")


class State(NamedTuple):
    """Angle (rad), speed (rad/s), armature current (A); for the rig also the previous values, and the number of the
    tick.

    The previous values are the voltage (V) that the bridge applied over the previous period, and the encoder's count at
    its begin.
    """

    theta: float = 0.0
    w: float = 0.0
    i: float = 0.0
    applied: tuple[float, ...] = ()
    encoder: int = 0
    k: int = 0


class DcMotorPlant(Plant[DcMotorPlantParams]):
    """Brushed DC motor with zero-order hold, stepped exactly; see `model.state_space` for the equations.

    In each period the sensors are read, then the command of the same instant is applied, then the motor moves.

    - encoder: count = floor(theta CPR/2 pi), w_k = (count_k - count_(k-1)) 2 pi/(CPR Ts), w_0 = 0
    - current: i rounded to `current_lsb`, clipped to `current_limit`
    - PWM and bridge: m = round((2^bits - 1) u/vmax), v = m/(2^bits - 1) (vmax - bridge_drop)

    The plant publishes the readings of encoder and current sensor in ``motor/state``. It also publishes the true state
    and the voltage that the bridge applied over the period that ends at t.

    Supply and load may change while it runs; the constants of the motor may not. A changed load profile is evaluated as
    if it had applied from the start.
    """

    DRAWN_BY = "softrig_drives.dc_motor.drawing:DcMotor"
    INPUTS = (replace(COMMAND, also=SHAFT),)  # ros2_control knows one name for both ways
    OUTPUTS = (STATE, SENSORS)

    @classmethod
    def ports(cls, params: DcMotorPlantParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """The true state and the applied voltage are topics of their own only where they differ."""
        return cls.INPUTS, (*cls.OUTPUTS, TRUE_STATE, APPLIED) if params.rig else cls.OUTPUTS

    def latched(self) -> Mapping[str, str]:
        """Return the URDF for ros2_control, whose command is the voltage of the armature."""
        tag = hardware_tag("dc_motor", SHAFT, "/motor/state", "/motor/command")
        return {"robot_description": axis_urdf("dc_motor", *SHAFT, "continuous", (1e3, 1e4), tag)}

    def setup(self) -> None:
        """Sample the equations and scale the sensors."""
        p = self.p
        self._period = to_ns(p.period)
        self._whole = self._transition(self._period)
        self._profile = StepProfile(p.load_times, p.load_torques)
        self._levels = 2**p.pwm_bits - 1
        self._volts_per_level = (p.vmax - p.bridge_drop) / self._levels
        self._counts_per_rad = p.counts_per_rev / math.tau
        self._rad_per_count = math.tau / p.counts_per_rev
        self._speed_per_count = self._rad_per_count / p.period

    def _transition(self, ns: int) -> tuple[float, ...]:
        """The numbers of x+ = Ad x + Bd u over ns that are neither 0 nor 1, without the load's column, and that."""
        ad, bd = zero_order_hold(*state_space(self.p), ns / 1e9)
        return (*(x for a, b in zip(ad, bd, strict=True) for x in (a[1], a[2], b[0])), *(b[1] for b in bd))

    def first(self) -> State:
        """Rest at angle zero, without current."""
        return State(applied=(0.0,)) if self.p.rig else State()

    def outputs(self, x: State, t: int) -> Values:
        """Return the sensors' values at t; on the rig also the truth."""
        p = self.p
        theta, w, i, applied, before, k = x
        count = math.floor(theta * self._counts_per_rad)
        if not p.rig:
            return {"state": (theta, w, p.Kt * i), "sensors": (float(count), i)}
        current = i + p.current_noise * self.standard_normal(k) if p.current_noise else i
        current = round(current / p.current_lsb) * p.current_lsb
        if abs(current) > p.current_limit:
            self.report(Level.WARN, "current_range", f"current {i:g} A beyond the sensor's {p.current_limit:g} A")
            current = math.copysign(p.current_limit, current)
        return {
            "state": (count * self._rad_per_count, (count - before) * self._speed_per_count, p.Kt * current),
            "sensors": (float(count), current),
            "true_state": (theta, w, p.Kt * i),
            "applied": applied,
        }

    def advance(self, x: State, t: int, *, command: tuple[float, ...]) -> State:
        """Apply the command over one period."""
        p = self.p
        u = command[0]
        if not -p.vmax <= u <= p.vmax:
            self.report(Level.WARN, "clipped", f"command {u:g} V clipped to the supply, {p.vmax:g} V")
            u = p.vmax if u > 0.0 else -p.vmax
        v = round(self._levels * u / p.vmax) * self._volts_per_level if p.rig else u
        theta, w, i, applied, encoder, k = x
        if p.rig:
            applied, encoder, k = (v,), math.floor(theta * self._counts_per_rad), k + 1
        end = t + self._period
        while t < end:
            load, until = self._profile.at(t), min(end, self._profile.next_change(t))
            full_period = until - t == self._period
            a01, a02, b00, a11, a12, b10, a21, a22, b20, e0, e1, e2 = (
                self._whole if full_period else self._transition(until - t)
            )
            theta += a01 * w + a02 * i + b00 * v + e0 * load
            w, i = a11 * w + a12 * i + b10 * v + e1 * load, a21 * w + a22 * i + b20 * v + e2 * load
            t = until
        return State(theta, w, i, applied, encoder, k)
