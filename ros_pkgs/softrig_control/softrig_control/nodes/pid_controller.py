"""PID controller with every common form, for any two signals; two of them make a cascade."""

from __future__ import annotations

from typing import Literal, NamedTuple

from softrig_core import Block, BlockParams, Port, Values, param

from .signal_name import signal_port


class PidControllerParams(BlockParams):
    """Signals, form and gains, limits and the behaviour at them, and manual mode."""

    period: float = param(0.001, "sampling period T", "s", gt=0.0, le=100.0)
    measurement: str = param("measurement/y/position", "controlled signal, topic/channel/field")
    measurement_unit: str = param("1", "its unit")
    measurement_also: tuple[str, ...] = param((), "other channels of the measurement's message")
    reference: str = param("", "reference signal, such as the command of an outer loop; empty: `set_point`")
    command: str = param("command/u/effort", "manipulated signal, topic/channel/field")
    command_unit: str = param("1", "its unit")
    set_point: float = param(0.0, "reference if there is no signal, and until its first message", live=True)
    form: Literal["parallel", "ideal", "series"] = param(
        "parallel", "parallel: Kp, Ki, Kd; ideal: Kp (1 + 1/(Ti s) + Td s); series: Kp (1 + 1/(Ti s)) (1 + Td s)"
    )
    kp: float = param(1.0, "proportional gain Kp; negative for a reverse-acting controller", live=True)
    ki: float = param(0.0, "parallel: integral gain Ki", "1/s", live=True)
    kd: float = param(0.0, "parallel: derivative gain Kd", "s", live=True)
    t_i: float = param(0.0, "ideal, series: integral time Ti; 0: no integral", "s", ge=0.0, live=True)
    t_d: float = param(0.0, "ideal, series: derivative time Td", "s", ge=0.0, live=True)
    n_filter: float = param(100.0, "corner N of the derivative's filter N s/(s + N)", "1/s", gt=0.0, live=True)
    derivative_on: Literal["error", "measurement"] = param("error", "signal that is differentiated", live=True)
    weight: float = param(1.0, "weight b of the reference in the proportional part", ge=0.0, le=1.0, live=True)
    bias: float = param(0.0, "added to the command", live=True)
    u_min: float = param(-1e9, "smallest command", live=True)
    u_max: float = param(1e9, "largest command", live=True)
    anti_windup: Literal["none", "conditional", "back_calculation"] = param(
        "conditional",
        "at a limit: none; stop the integral while the error drives it further; track the limited command",
        live=True,
    )
    t_t: float = param(0.0, "back-calculation: tracking time; 0: one period", "s", ge=0.0, live=True)
    manual: bool = param(False, "the command is `manual_command`; the change back to automatic is bumpless", live=True)
    manual_command: float = param(0.0, "command in manual mode", live=True)

    def _check(self) -> None:
        if self.u_min >= self.u_max:
            raise ValueError(f"u_min = {self.u_min:g}: expected less than u_max = {self.u_max:g}")
        if self.form == "parallel" and (self.t_i or self.t_d):
            raise ValueError(
                "t_i, t_d: the parallel form has ki and kd; set form to ideal or series, or leave them out"
            )
        if self.form != "parallel" and (self.ki or self.kd):
            raise ValueError(f"ki, kd: the {self.form} form has t_i and t_d; set form to parallel")
        self.signals()

    def signals(self) -> tuple[Port, ...]:
        """Return the ports measurement, command, and reference where there is one."""
        ports = (
            signal_port("measurement", self.measurement, self.measurement_unit, also=self.measurement_also),
            signal_port("command", self.command, self.command_unit),
        )
        if self.reference:
            return (*ports, signal_port("reference", self.reference, self.measurement_unit, held=True))
        return ports

    def gains(self) -> tuple[float, float, float]:
        """Return Kp, Ki, Kd of the parallel form; a series law is (1 + Td/Ti), 1/Ti, Td times Kp."""
        if self.form == "parallel":
            return self.kp, self.ki, self.kd
        rate = 1.0 / self.t_i if self.t_i else 0.0
        more = 1.0 + (self.t_d * rate if self.form == "series" else 0.0)
        return self.kp * more, self.kp * rate, self.kp * self.t_d


class State(NamedTuple):
    """Integral and filtered derivative (units of the command), the previous derivative input, and the newest error."""

    integral: float = 0.0
    derivative: float = 0.0
    before: float = 0.0
    proportional: float = 0.0
    error: float = 0.0
    begun: bool = False


class PidController(Block[PidControllerParams]):
    """Control any signal of a rig by any other with a PID controller.

    ::

        P   = Kp (b r - y)
        d_k = (d_(k-1) + Kd N (z_k - z_(k-1)))/(1 + N T)       z: r - y, or -y
        u   = clip(P + I + d + bias)
        I  += T Ki (r - y)                                     or nothing at a limit (conditional)
        I  += T/Tt (u - (P + I + d + bias))                    back calculation, beside that

    The series form has the gains of the parallel one by Kp (1 + Td/Ti), Kp/Ti, Kp Td. A change of gains is bumpless:
    with integral action, the change of the command by another Kp, b or bias is moved into I. In manual mode I follows
    the command, so that the controller continues from it. The first sample has no derivative. With `parallel`, `error`,
    `conditional`, b = 1 this is `softrig_control.pid.Pid`, its output clipped.

    A refused measurement holds the integral; the command is that of the newest state.

    References
    ----------
    K. J. Astrom, T. Hagglund, PID Controllers: Theory, Design, and Tuning, 2nd ed., ISA 1995, chapter 3.
    """

    STATE = State

    @classmethod
    def ports(cls, params: PidControllerParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Measurement, reference where it is a signal; one command."""
        measurement, command, *reference = params.signals()
        return (measurement, *reference), (command,)

    def setup(self) -> None:
        """Turn the form into gains."""
        p = self.p
        self._kp, ki, kd = p.gains()
        self._ki_t, self._kd_n, self._decay = ki * p.period, kd * p.n_filter, 1.0 + p.n_filter * p.period
        self._lead = 1.0 if not p.t_t else min(p.period / p.t_t, 1.0)
        self._on_error = p.derivative_on == "error"
        self._conditional = p.anti_windup == "conditional"
        self._back = p.anti_windup == "back_calculation"

    def go_on(self, x: State, before: PidControllerParams) -> State:
        """Continue with other gains, weight or bias without a jump of the output."""
        p = self.p
        old, was = x.proportional, before.gains()[0]
        # P = Kp (b r - y) = Kp (e + (b - 1) r); r is left out, because it is known only at the next tick
        new = old + (self._kp - was) * x.error if p.weight == before.weight else self._kp / was * old if was else old
        if self._ki_t:
            return x._replace(integral=x.integral + old - new + before.bias - p.bias, proportional=new)
        return x

    def update(
        self, x: State, t: int, *, measurement: tuple[float, ...], reference: tuple[float, ...] | None = None
    ) -> tuple[State, Values]:
        """Compute the command."""
        p = self.p
        y, r = measurement[0], p.set_point if reference is None else reference[0]
        error = r - y
        z = error if self._on_error else -y
        d = (x.derivative + self._kd_n * (z - x.before)) / self._decay if x.begun else 0.0
        proportional = self._kp * (p.weight * r - y)
        free = proportional + x.integral + d + p.bias
        u = min(max(free, p.u_min), p.u_max)
        if p.manual:
            u = min(max(p.manual_command, p.u_min), p.u_max)
            integral = u - proportional - d - p.bias
            return State(integral, d, z, proportional, error, True), {"command": (u,)}
        step = self._ki_t * error
        if self._conditional and u != free and (free - u) * step > 0.0:
            step = 0.0
        if self._back:
            step += self._lead * (u - free)
        return State(x.integral + step, d, z, proportional, error, True), {"command": (u,)}

    def refused(self, x: State, t: int) -> tuple[State, Values]:
        """Hold the command of the newest state."""
        p = self.p
        free = p.manual_command if p.manual else x.proportional + x.integral + x.derivative + p.bias
        return x, {"command": (min(max(free, p.u_min), p.u_max),)}
