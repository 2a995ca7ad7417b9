"""The motor: ideal, or behind the sensors and the power stage of a small digital rig."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, Self

from pydantic import model_validator
from softrig_control.discretise import zero_order_hold
from softrig_control.hardware import axis_urdf, hardware_tag
from softrig_control.profile import StepProfile
from softrig_core import BlockParams, Level, Plant, Port, executable, param, to_ns

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

    @model_validator(mode="after")
    def _load(self) -> Self:
        try:
            StepProfile(self.load_times, self.load_torques)
        except ValueError as error:
            raise ValueError(f"load_times, load_torques: {error}") from None
        if self.bridge_drop >= self.vmax:
            raise ValueError(f"bridge_drop = {self.bridge_drop:g} V leaves nothing of vmax = {self.vmax:g} V")
        return self


class State(NamedTuple):
    """Angle (rad), speed (rad/s), armature current (A)."""

    theta: float
    w: float
    i: float


class DcMotorPlant(Plant[DcMotorPlantParams]):
    """Brushed DC motor with zero-order hold, stepped exactly; see `model.state_space` for the equations.

    One period of the rig is: the sensors are read, the command of the same instant is applied, the motor moves.

    - encoder: count = floor(theta CPR/2 pi), w_k = (count_k - count_(k-1)) 2 pi/(CPR Ts), w_0 = 0
    - current: i rounded to `current_lsb`, clipped to `current_limit`
    - PWM and bridge: m = round((2^bits - 1) u/vmax), v = m/(2^bits - 1) (vmax - bridge_drop)

    The rig publishes what its encoder and current sensor tell in ``motor/state``, and besides the true state and the
    voltage that the bridge applied over the period that ends at t.

    Supply and load may change while it runs, what the motor is made of may not; another load profile counts as if it
    had been there from the start.
    """

    INPUTS = (replace(COMMAND, also=SHAFT),)  # ros2_control knows one name for both ways
    OUTPUTS = (STATE, SENSORS)

    @classmethod
    def drawing(cls) -> Any:
        """Give what draws it."""
        from .drawing import DcMotor

        return DcMotor

    @classmethod
    def ports(cls, params: DcMotorPlantParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """The true state and the applied voltage are topics of their own only where they differ."""
        return cls.INPUTS, (*cls.OUTPUTS, TRUE_STATE, APPLIED) if params.rig else cls.OUTPUTS

    def latched(self) -> Mapping[str, str]:
        """Give the URDF for ros2_control, whose command is the voltage of the armature."""
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

    def change(self, params: DcMotorPlantParams) -> None:
        """Look up the load anew before the next move."""
        super().change(params)
        self._change = 0

    def _transition(self, ns: int) -> tuple[float, ...]:
        """The numbers of x+ = Ad x + Bd u over ns that are neither 0 nor 1, without the load's column, and that."""
        ad, bd = zero_order_hold(*state_space(self.p), ns / 1e9)
        return (*(x for a, b in zip(ad, bd, strict=True) for x in (a[1], a[2], b[0])), *(b[1] for b in bd))

    def start(self) -> None:
        """Rest at angle zero, without current."""
        self.theta = self.w = self.i = 0.0
        self._count = 0
        self._load = self._profile.at(0)
        self._change = self._profile.next_change(0)
        self._sense(0.0)

    @property
    def state(self) -> State:
        """Give the true state."""
        return State(self.theta, self.w, self.i)

    def put(self, state: Sequence[float]) -> None:
        """Go on from another state; the encoder has stood there."""
        self.theta, self.w, self.i = state
        self._count = math.floor(self.theta * self._counts_per_rad)
        self._sense(0.0)

    def outputs(self, t: int) -> Mapping[str, tuple[float, ...]]:
        """Give the sensors' values at t; on the rig also the truth."""
        return self._answer

    def advance(self, t: int, *, command: tuple[float, ...]) -> None:
        """Apply the command over one period."""
        p = self.p
        u = command[0]
        if not -p.vmax <= u <= p.vmax:
            self.report(Level.WARN, "clipped", f"command {u:g} V clipped to the supply, {p.vmax:g} V")
            u = p.vmax if u > 0.0 else -p.vmax
        v = round(self._levels * u / p.vmax) * self._volts_per_level if p.rig else u
        end = t + self._period
        if end <= self._change:
            self._move(self._whole, v)
        else:
            self._move_with_load_steps(t, end, v)
        self._sense(v)

    def _move_with_load_steps(self, t: int, end: int, v: float) -> None:
        while t < end:
            self._load = self._profile.at(t)
            self._change = self._profile.next_change(t)
            until = min(end, self._change)
            self._move(self._transition(until - t), v)
            t = until
        self._load = self._profile.at(end)
        self._change = self._profile.next_change(end)

    def _move(self, transition: tuple[float, ...], v: float) -> None:
        a01, a02, b00, a11, a12, b10, a21, a22, b20, e0, e1, e2 = transition
        w, i, load = self.w, self.i, self._load
        self.theta += a01 * w + a02 * i + b00 * v + e0 * load
        self.w = a11 * w + a12 * i + b10 * v + e1 * load
        self.i = a21 * w + a22 * i + b20 * v + e2 * load

    def _sense(self, v: float) -> None:
        p = self.p
        theta, w, i = self.theta, self.w, self.i
        if not p.rig:
            self._answer = {
                "state": (theta, w, p.Kt * i),
                "sensors": (float(math.floor(theta * self._counts_per_rad)), i),
            }
            return
        count = math.floor(theta * self._counts_per_rad)
        speed = (count - self._count) * self._speed_per_count
        self._count = count
        current = i + p.current_noise * self.rng.standard_normal() if p.current_noise else i
        current = round(current / p.current_lsb) * p.current_lsb
        if abs(current) > p.current_limit:
            self.report(Level.WARN, "current_range", f"current {i:g} A beyond the sensor's {p.current_limit:g} A")
            current = math.copysign(p.current_limit, current)
        self._answer = {
            "state": (count * self._rad_per_count, speed, p.Kt * current),
            "sensors": (float(count), current),
            "true_state": (theta, w, p.Kt * i),
            "applied": (v,),
        }


main = executable(DcMotorPlant)
