"""The network packet by packet, with the topics of the fluid model."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from softrig_core import History, Level, param
from softrig_core.kit.draws import Stream

from .network import Net, Network, NetworkParams, Seen
from .packets import (
    DRAWN,
    MOST_EVENTS,
    NOBODY,
    SERVED,
    START,
    WAITING,
    Agenda,
    Fifo,
    Inside,
    Rules,
    Sources,
    Traffic,
    arrive,
    mean_window,
    run_until,
    schedule,
)


class TcpPacketsParams(NetworkParams):
    """Network, spread of its sources, and whether a congested queue drops or marks."""

    period: float = param(0.01, "control and sampling period", "s", gt=0.0, le=1.0)
    seed: int = param(0, "added to the seed of the run", ge=0, le=2**31 - 1)
    spread: float = param(0.05, "propagation times are uniform in tau_p (1 +- spread)", ge=0.0, lt=1.0)
    ecn: bool = param(True, "the queue marks packets; otherwise it drops them")

    def _check(self) -> None:
        if self.period > self.tau_p / 4.0:
            raise ValueError(f"period = {self.period:g} s: expected at most tau_p/4 = {self.tau_p / 4.0:g} s")
        if self.w_min < 1.0:
            raise ValueError(f"w_min = {self.w_min:g}: expected at least 1, a source sends whole packets")


class State(NamedTuple):
    """Steps so far, the network, packets and events in flight; recent mean window and queue, random numbers."""

    step: int
    net: Net
    traffic: Traffic
    past: History
    random: Stream


class TcpPackets(Network[TcpPacketsParams]):
    """N sources in congestion avoidance on one FIFO queue; see `packets.run_until` for the rules.

    The measured window is the mean over the sources. Each starts at a random time in [0, tau_p]. The heap of events
    holds at most N w_max + q_max entries plus one start for each flow and two more; its largest size is reported.
    """

    def setup(self) -> None:
        """Allocate memory for twice the flows, which events may start."""
        p = self.p
        self._h, self._steps = p.period, 1
        self._room = int(p.q_max)
        self.most_flows = 2 * p.N
        super().setup()

    def begin(self, net: Net) -> State:
        """Draw propagation and starting times; let the first packets wait."""
        p, most, room = self.p, self.most_flows, self._room
        stream = Stream(np.random.default_rng([p.seed, int(self.generator().integers(2**32))]))
        draw = stream.at(0)
        spread = 1.0 + p.spread * (2.0 * draw.random(most) - 1.0)
        active = np.zeros(most, np.int64)
        active[: p.N] = 1
        sources = Sources(
            np.full(most, p.w0), np.zeros(most, np.int64), p.tau_p * spread, np.full(most, -1.0), active, spread
        )
        events = most * (int(p.w_max) + 1) + room + 4
        agenda = Agenda(
            np.zeros(events),
            np.zeros(events, np.int64),
            np.zeros(events, np.int64),
            np.zeros(events, np.int64),
            np.zeros(events),
        )
        fifo = Fifo(np.zeros(room + 1, np.int64), np.zeros(room + 1, np.int64), np.zeros(room + 1))
        counts = np.zeros(8, np.int64)
        for flow in range(p.N):
            schedule(agenda, counts, p.tau_p * draw.random(), START, flow, 0, 0.0)
        counts[DRAWN] = stream.drawn(most + p.N)
        inside = Inside(sources, agenda, fifo, counts)
        self._fill(inside, 0.0, p.q0, net.capacity)
        return State(0, net, Traffic(inside), History(p.period, p.history, _mean(inside)), stream)

    def seen(self, x: State) -> Seen:
        """Return the mean window, and look back one round trip."""
        inside, net = x.traffic.inside, x.net
        window, queue = _mean(inside)
        return Seen(window, queue, float(inside.counts[SERVED]), *x.past.at(queue / net.capacity + net.propagation))

    def moved(self, x: State, steps: int, p: float) -> State:
        """Run the events of the period."""
        c, (step, net, traffic, past, stream) = self.p, x
        inside = traffic.copy()
        counts = inside.counts
        rules = Rules(p, net.rate, net.capacity, self._room, c.w_min, c.w_max, not c.ecn)
        for k in range(step + 1, step + steps + 1):
            run_until(k * self._h, rules, stream.at(int(counts[DRAWN])), inside)
            stream.drawn(int(counts[DRAWN]))
            past = past.put(_mean(inside))
        most, bound = int(counts[MOST_EVENTS]), net.flows * c.w_max + c.q_max
        if most > bound:
            self.report(Level.WARN, "events", f"{most} events at the same time, more than N w_max + q_max = {bound:g}")
        return State(step + steps, net, Traffic(inside), past, stream)

    def jumped(self, x: State, packets: float) -> State:
        """Add packets without a flow in one batch; those that find no room are lost."""
        inside = x.traffic.copy()
        self._fill(inside, x.step * self._h, packets, x.net.capacity)
        return x._replace(traffic=Traffic(inside))

    def _fill(self, inside: Inside, now: float, packets: float, capacity: float) -> None:
        for _ in range(round(packets)):
            arrive(inside, now, NOBODY, 0, capacity, self._room)

    def changed(self, x: State, net: Net) -> State:
        """Start or end flows; new propagation times apply to packets that leave the queue from now on."""
        inside, now = x.traffic.copy(), x.step * self._h
        s, agenda, _, counts = inside
        s.propagation[:] = net.propagation * s.spread
        for flow in range(self.most_flows):
            wanted = int(flow < net.flows)
            if wanted and not s.active[flow]:
                s.window[flow] = self.p.w_min
                schedule(agenda, counts, now, START, flow, 0, 0.0)
            s.active[flow] = wanted
        return x._replace(net=net, traffic=Traffic(inside))


def _mean(inside: Inside) -> tuple[float, float]:
    """Return mean window and queue, packets."""
    return mean_window(inside.sources), float(inside.counts[WAITING])
