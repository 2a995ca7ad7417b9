"""The network as a fluid: expected window and queue as a delay differential equation."""

from __future__ import annotations

from typing import Self

import numpy as np
from pydantic import model_validator
from softrig_core import Level, check_steps, executable, param
from softrig_core.kit.dde import trajectory

from .fluid import QUEUE, Constants, look_back, period
from .network import Network, NetworkParams


class TcpFluidParams(NetworkParams):
    """Network, step and where the delay of the loop is."""

    period: float = param(0.001, "control and sampling period", "s", gt=0.0, le=1.0)
    h: float = param(0.001, "integration step; halving it changes no figure by 0.1 %", "s", gt=0.0, le=0.1)
    input_delay: bool = param(False, "the command acts one round trip later, as in a network; false as in the paper")

    @model_validator(mode="after")
    def _step(self) -> Self:
        if self.h > self.tau_p / 4.0:
            raise ValueError(f"h = {self.h:g} s: expected at most tau_p/4 = {self.tau_p / 4.0:g} s")
        check_steps(self.period, self.h, "h")
        ratio = self.period / self.h
        if round(ratio) < 1 or abs(ratio - round(ratio)) > 1e-9 * ratio:
            raise ValueError(f"h = {self.h:g} s: expected a whole part of period = {self.period:g} s")
        return self


class TcpFluid(Network[TcpFluidParams]):
    """Fluid model of Misra, Gong and Towsley (2000), eq. (1)-(5) of the paper; see `fluid.slopes`.

    Runge-Kutta steps of order 4 over the history that the suite's delay equations have. The delay can grow faster than
    time (N w/R > 2 C); that is legal, counted and reported.
    """

    def setup(self) -> None:
        """Count the steps in a period."""
        p = self.p
        self._steps = round(p.period / p.h)
        self._h = p.period / self._steps

    def begin(self) -> None:
        """A constant past."""
        p = self.p
        self._x = np.array([p.w0, p.q0, p.p0, 0.0])
        self._past = trajectory(self._h, p.history, tuple(self._x))
        self._step = 0
        self.changed()

    def move(self, steps: int, p: float) -> None:
        """Integrate."""
        self._take(period(self._past, self._step * self._h, self._x, self._h, steps, p, self._constants))
        c = self._constants
        if c.N * self.window + c.d * (self.queue / c.C + c.tau_p) >= 2.0 * (self.queue + c.C * c.tau_p):
            self.report(Level.WARN, "fast_delay", "the delay grows as fast as time or faster, N w/R >= 2 C")

    def jump(self, packets: float) -> None:
        """Raise the queue, within its bounds."""
        self._x[QUEUE] = min(max(self._x[QUEUE] + packets, 0.0), self.p.q_max)
        self.changed()

    def changed(self) -> None:
        """Take the constants of the network as they are now."""
        p = self.p
        self._constants = Constants(float(self.flows), self.capacity, self.propagation, p.q_max, p.w_min, p.w_max,
                                    self.rate, float(p.input_delay))  # fmt: skip
        self._take(look_back(self._past, self._step * self._h, self._x, self._constants))

    def _take(self, found: tuple[float, float, float, float, float]) -> None:
        self.window, self.queue, self.served, self.window_delayed, self.queue_delayed = found


main = executable(TcpFluid)
