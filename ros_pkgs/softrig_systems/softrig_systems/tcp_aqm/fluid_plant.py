"""The network as a fluid: expected window and queue as a delay differential equation."""

from __future__ import annotations

from typing import NamedTuple

from softrig_core import Level, check_steps, param
from softrig_core.kit.dde import Track, trajectory

from .fluid import past_values, stepped
from .network import Net, Network, NetworkParams, Seen


class TcpFluidParams(NetworkParams):
    """Network, step and where the delay of the loop is."""

    period: float = param(0.001, "control and sampling period", "s", gt=0.0, le=1.0)
    h: float = param(0.001, "integration step; halving it changes no figure by 0.1 %", "s", gt=0.0, le=0.1)
    input_delay: bool = param(False, "the command acts one round trip later, as in a network; false as in the paper")

    def _check(self) -> None:
        if self.h > self.tau_p / 4.0:
            raise ValueError(f"h = {self.h:g} s: expected at most tau_p/4 = {self.tau_p / 4.0:g} s")
        check_steps(self.period, self.h, "h")
        ratio = self.period / self.h
        if round(ratio) < 1 or abs(ratio - round(ratio)) > 1e-9 * ratio:
            raise ValueError(f"h = {self.h:g} s: expected a whole part of period = {self.period:g} s")


class State(NamedTuple):
    """Window and queue (packets), packets served so far; steps so far, the network, and the past of all that."""

    w: float
    q: float
    served: float
    step: int
    net: Net
    past: Track


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
        self._given = p.q_max, p.w_min, p.w_max, float(p.input_delay)
        super().setup()

    def begin(self, net: Net) -> State:
        """A constant past."""
        p = self.p
        return State(p.w0, p.q0, 0.0, 0, net, Track(trajectory(self._h, p.history, (p.w0, p.q0, p.p0, 0.0))))

    def seen(self, x: State) -> Seen:
        """Look back one round trip."""
        w, q, served, step, net, past = x
        k = step - self._change
        k = k if 0 <= k < self._steps else self._steps
        now = (step - k) * self._h + k * self._h  # rounded as `stepped` has come there
        earlier = now - q / net.capacity - net.propagation
        return Seen(w, q, served, *past_values(past.open(), earlier))

    def moved(self, x: State, steps: int, p: float) -> State:
        """Integrate."""
        w, q, served, step, net, track = x
        N, C, tau_p, d = float(net.flows), net.capacity, net.propagation, net.rate
        past = track.open(steps)
        x_now = w, q, p, served
        w, q, served = stepped(past, step * self._h, x_now, self._h, steps, (N, C, tau_p, d), self._given)
        if N * w + d * (q / C + tau_p) >= 2.0 * (q + C * tau_p):
            self.report(Level.WARN, "fast_delay", "the delay grows as fast as time or faster, N w/R >= 2 C")
        return State(w, q, served, step + steps, net, track.after(past))

    def jumped(self, x: State, packets: float) -> State:
        """Raise the queue, within its bounds."""
        return x._replace(q=min(max(x.q + packets, 0.0), self.p.q_max))

    def changed(self, x: State, net: Net) -> State:
        """Set the present network."""
        return x._replace(net=net)
