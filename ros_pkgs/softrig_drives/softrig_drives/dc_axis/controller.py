"""Full state feedback with integrator for the axis, with three ways to treat a late measurement."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

from softrig_control.discretise import zero_order_hold
from softrig_control.nodes.delay import whole_periods
from softrig_control.predictor import CommandReplay, Commands
from softrig_control.state_feedback import Gains, StateFeedback, closed_loop_poles, place, require_stable
from softrig_core import Block, Level, Sample, Values, param, to_ns

from .motor import MotorParams
from .nominal import Nominal, NominalAxis
from .ports import COMMAND, CONTROLLER_STATE, FEEDBACK, FORWARD, MODEL, REFERENCE, REVERSE
from .set_point import Asked, SetPoint

LARGEST_STEP = 60.0  # mm: what the amplifier can do without anti-windup, and only just
LARGEST_GAP = 5  # periods without an answer after which the drive's watchdog has taken the command to zero


MOST = 100_000  # commands that the predictor keeps: with so many its set-up takes 1 s


class FsfbControllerParams(MotorParams):
    """Gains in the paper's unit (command in mm of set point), and the treatment of the delay."""

    kv: float = param(5.810929, "gain of the velocity", "s", live=True)
    kp: float = param(46.050266, "gain of the position, the unity position loop included", live=True)
    ki: float = param(73.199977, "gain of the integrator", "1/s", live=True)
    poles: tuple[float, ...] = param(
        (),
        "three real poles of the loop from which kv, kp and ki are computed, whatever the motor; empty: as given",
        "1/s",
        each=(-1e6, -1e-6),
        live=True,
    )
    integral: bool = param(True, "integrator on; off: u = r - kv v - kp y")
    compensation: Literal["none", "velocity", "predictor"] = param("predictor", "treatment of the feedback delay")
    delay_from: Literal["stamps", "fixed"] = param("stamps", "delay of a sample: its age, or the parameter delay")
    delay: float = param(0.08, "feedback delay, used if delay_from is fixed", "s", ge=0.0)
    max_age: float = param(0.5, "age from which feedback is rejected", "s", gt=0.0)
    count_mm: float = param(
        0.0, "encoder count: half of it is added to a reading that is rounded down; 0: as read", "mm", ge=0.0, live=True
    )
    aw: bool = param(False, "anti-windup: no integration further into saturation", live=True)
    step_mm: float = param(10.0, "change of the set point per press of a button", "mm", gt=0.0, live=True)

    def _check(self) -> None:
        if self.delay_from == "fixed" and self.delay > self.max_age:
            raise ValueError(f"delay = {self.delay:g} s is beyond max_age = {self.max_age:g} s")
        if self.max_age > MOST * self.period:
            raise ValueError(f"max_age = {self.max_age:g} s: expected at most {MOST} periods of {self.period:g} s")
        if self.poles and (len(self.poles) != 3 or not self.integral):
            raise ValueError(f"poles = {list(self.poles)}: expected three, of which the third needs the integrator")
        kv, kp, ki = self.gains()
        k = kv / self.mm_per_volt, kp / self.mm_per_volt
        integral = ki / self.mm_per_volt if self.integral else None
        require_stable(closed_loop_poles(self.a, self.b, (0.0, 1.0), k, integral))

    def gains(self) -> tuple[float, float, float]:
        """Return kv, kp and ki."""
        return design(self.poles, self) if self.poles else (self.kv, self.kp, self.ki)


def design(poles: Sequence[complex], motor: MotorParams | None = None) -> tuple[float, float, float]:
    """Gains (kv, kp, ki) of the controller for three wanted poles.

    s^3 + (pole + gain kv) s^2 + gain kp s + gain ki = (s - p1)(s - p2)(s - p3)

    Parameters
    ----------
    poles : three numbers
        In 1/s, complex ones in conjugate pairs.
    motor : MotorParams, optional
        The published motor when absent.

    Raises
    ------
    softrig_control.state_feedback.UnstableDesign
        A pole is not in the open left half plane; names the poles.
    """
    motor = motor or MotorParams()
    gains: Gains = place(motor.a, (motor.gain, 0.0), (0.0, 1.0), poles)
    return gains.k[0], gains.k[1], gains.ki


class State(NamedTuple):
    """Nominal loop, known commands (V), set point; times (ns; None before the first) of newest tick and measurement.

    That measurement (v, y), late, and compensated, in mm/s and mm; integral (mm s), command (V).
    """

    nominal: Nominal
    history: Commands
    set_point: Asked = Asked()
    t: int | None = None
    stamp: int | None = None
    measured: tuple[float, float] = (0.0, 0.0)
    state: tuple[float, ...] = (0.0, 0.0)
    xi: float = 0.0
    u: float = 0.0


class FsfbController(Block[FsfbControllerParams]):
    """u = -kv v - kp y + ki xi, xi' = r - y, on the state that the compensation computes from a late measurement.

    none
        The late (v, y) as they are.
    velocity
        y + v tau for the delay tau, v as it is: what the drive vendor documents for its encoder.
    predictor
        The present (v, y) by replaying the commands issued since the measurement through the exact sampled motor.

    The command is 0 V and the integrator is held, with a report, if feedback is from the future, older than `max_age`
    or not finite. The same applies if not all commands that the prediction needs are known. The controller starts
    without a bump: set point and integrator are initialised from the first measured position. A live change of gains
    causes no bump either: the integrator compensates the change of the command at the present state (without an
    integrator the command jumps). The predictor's motor model, the delays and the largest age, which sizes its memory,
    are fixed at the start.

    Notes
    -----
    Love, Kriger, Tshemese-Mvandaba (2024). The paper gives no gains; the defaults have the poles -2.649278 and
    twice -7.947834 1/s, solved for the published rise time of 0.966 s. ``axis/model`` carries the loop as designed
    (`NominalAxis`). ``axis/controller_state`` has the variables of the control law: set point, compensated position and
    velocity, integrator, age of the feedback.
    """

    INPUTS = (FEEDBACK, REFERENCE, FORWARD, REVERSE)
    OUTPUTS = (COMMAND, MODEL, CONTROLLER_STATE)

    def setup(self) -> None:
        """Gains in volts, the sampled motor, the predictor."""
        p = self.p
        self._period = to_ns(p.period)
        self._max_age = to_ns(p.max_age)
        phi, gamma = zero_order_hold(p.a, [[b] for b in p.b], p.period)
        self._law = _law(p)
        self._nominal = NominalAxis(p, phi, gamma, self._law)
        self._replay = CommandReplay(phi, gamma, math.ceil(p.max_age / p.period))
        self._set_point = SetPoint(p.step_mm, self.report, math.inf if p.aw else LARGEST_STEP)
        self._half_count = 0.5 * p.count_mm
        self._fixed, self._rounded = whole_periods(p.delay, p.period)

    def first(self) -> State:
        """Wait for the first measurement."""
        history = self._replay.nothing()
        if self.p.delay_from == "fixed":
            for _ in range(self._fixed):  # until the first command arrives the drive holds 0 V
                history = self._replay.record(history, 0.0)
            if self._rounded:
                self.report(
                    Level.WARN,
                    "delay",
                    f"delay = {self.p.delay:g} s is not a whole number of periods: rounded up to {self._fixed}",
                )
        return State(self._nominal.rest(0.0), history, xi=self._law.settle((0.0, 0.0)))

    def go_on(self, x: State, before: FsfbControllerParams) -> State:
        """Continue with other gains without a jump; the known commands and the set point stay."""
        law = _law(before)
        xi = self._law.go_on(x.xi, law, x.state, x.set_point.value)
        return x._replace(xi=xi, nominal=self._nominal.go_on(x.nominal, law))

    def update(
        self,
        x: State,
        t: int,
        *,
        feedback: Sample,
        reference: tuple[float] | None,
        forward: tuple[float] | None,
        reverse: tuple[float] | None,
    ) -> tuple[State, Values]:
        """Answer one period."""
        history = self._known(x, t)
        usable = self._usable(t, feedback)
        if usable:
            x = self._measure(x, feedback)
        set_point = self._set_point(
            x.set_point, None if reference is None else reference[0], forward == (1.0,), reverse == (1.0,)
        )
        state, xi, nominal, u = x.state, x.xi, x.nominal, 0.0
        if usable:
            usable, state = self._compensate(x, t, history)
        if usable:
            r = set_point.value
            nominal = self._nominal(nominal, r)
            xi, u = self._law(xi, r, state, state[1])
        history = self._replay.record(history, u)
        return self._answer(State(nominal, history, set_point, t, x.stamp, x.measured, state, xi, u))

    def refused(self, x: State, t: int) -> tuple[State, Values]:
        """Publish 0 V, which enters the command history; the last good measurement and the integrator are held."""
        return self._answer(x._replace(t=t, u=0.0, history=self._replay.record(self._known(x, t), 0.0)))

    def _answer(self, x: State) -> tuple[State, Values]:
        v, y = x.state
        age = 0.0 if x.stamp is None or x.t is None else (x.t - x.stamp) * 1e-9
        return x, {
            "command": (x.u,),
            "model": x.nominal.signals,
            "controller_state": (x.set_point.value, y, v, x.xi, age),
        }

    def _known(self, x: State, t: int) -> Commands:
        """Return the command history, true when periods were left out."""
        history = x.history
        if x.t is not None:
            gap = (t - x.t) // self._period - 1
            if gap > LARGEST_GAP:
                return self._replay.nothing()
            for _ in range(gap):  # the drive held the last command
                history = self._replay.record(history, x.u)
        return history

    def _usable(self, t: int, feedback: Sample) -> bool:
        """Return whether there is a measurement that may be used."""
        stamp = feedback[0]
        if stamp > t:
            self.report(Level.ERROR, "feedback time", f"feedback stamped {(stamp - t) * 1e-9:g} s in the future: 0 V")
            return False
        if t - stamp > self._max_age:
            self.report(Level.ERROR, "feedback age", f"feedback is older than {self.p.max_age:g} s: 0 V")
            return False
        return True

    def _measure(self, x: State, feedback: Sample) -> State:
        """Process the measurement; the first one defines the initial value."""
        stamp, (y, v) = feedback
        measured = v, y + self._half_count
        if x.stamp is None:
            return x._replace(
                nominal=self._nominal.rest(y),
                set_point=Asked(y),
                stamp=stamp,
                measured=measured,
                xi=self._law.settle((0.0, y + self._half_count), y),
            )
        if stamp < x.stamp:
            self.report(Level.WARN, "feedback order", "feedback older than the previous one was dropped")
        return x._replace(stamp=stamp, measured=measured) if stamp > x.stamp else x

    def _compensate(self, x: State, t: int, history: Commands) -> tuple[bool, tuple[float, ...]]:
        """Create the state for the law of the late measurement; whether that can be done."""
        p = self.p
        assert x.stamp is not None
        v, y = x.measured
        late = -((x.stamp - t) // self._period) if p.delay_from == "stamps" else self._fixed
        if p.compensation == "none":
            return True, (v, y)
        if p.compensation == "velocity":
            return True, (v, y + v * late * p.period)
        if late > history.known:
            self.report(Level.WARN, "predictor", f"the commands of the last {late} periods are not all known: 0 V")
            return False, x.state
        return True, self._replay.present(history, (v, y), late)


def _law(p: FsfbControllerParams) -> StateFeedback:
    scale, (kv, kp, ki) = p.mm_per_volt, p.gains()
    return StateFeedback(
        (kv / scale, kp / scale),
        ki / scale if p.integral else 0.0,
        p.period,
        p.u_limit_v,
        kr=0.0 if p.integral else 1.0 / scale,
        anti_windup=p.aw,
    )
