"""The network packet by packet, behind the same topics as the fluid."""

from __future__ import annotations

from typing import Self

import numpy as np
from pydantic import model_validator
from softrig_core import History, Level, executable, param

from .network import Network, NetworkParams
from .packets import NOBODY, START, Agenda, Counts, Fifo, Sources, arrive, mean_window, run_until, schedule


class TcpPacketsParams(NetworkParams):
    """Network, spread of its sources, and what a congested queue does."""

    period: float = param(0.01, "control and sampling period", "s", gt=0.0, le=1.0)
    seed: int = param(0, "added to the seed of the run", ge=0, le=2**31 - 1)
    spread: float = param(0.05, "propagation times are uniform in tau_p (1 +- spread)", ge=0.0, lt=1.0)
    ecn: bool = param(True, "the queue marks packets; otherwise it drops them")

    @model_validator(mode="after")
    def _period(self) -> Self:
        if self.period > self.tau_p / 4.0:
            raise ValueError(f"period = {self.period:g} s: expected at most tau_p/4 = {self.tau_p / 4.0:g} s")
        if self.w_min < 1.0:
            raise ValueError(f"w_min = {self.w_min:g}: expected at least 1, a source sends whole packets")
        return self


class TcpPackets(Network[TcpPacketsParams]):
    """N sources in congestion avoidance on one FIFO queue; see `packets.run_until` for the rules.

    The measured window is the mean over the sources. Each starts at a random time in [0, tau_p]. The heap of events
    holds at most N w_max + q_max entries besides one start a flow and two more; its largest size is reported.
    """

    def setup(self) -> None:
        """Make room for the past and for twice the flows, which events may start."""
        p = self.p
        self._h, self._steps = p.period, 1
        self._history = History(p.period, p.history)
        self._room = int(p.q_max)
        self.most_flows = 2 * p.N

    def begin(self) -> None:
        """Draw propagation and starting times; let the first packets wait."""
        p = self.p
        self._random = np.random.default_rng([p.seed, int(self.rng.integers(2**32))])
        most, room = self.most_flows, self._room
        self._nominal = 1.0 + p.spread * (2.0 * self._random.random(most) - 1.0)
        active = np.zeros(most, np.int64)
        active[: p.N] = 1
        self._sources = Sources(np.full(most, p.w0), np.zeros(most, np.int64), p.tau_p * self._nominal,
                                np.full(most, -1.0), active)  # fmt: skip
        events = most * (int(p.w_max) + 1) + room + 4
        self._agenda = Agenda(np.zeros(events), np.zeros(events, np.int64), np.zeros(events, np.int64),
                              np.zeros(events, np.int64), np.zeros(events))  # fmt: skip
        self._fifo = Fifo(np.zeros(room + 1, np.int64), np.zeros(room + 1, np.int64), np.zeros(room + 1))
        self._counts = Counts(*(np.zeros(1, np.int64) for _ in Counts._fields))
        for flow in range(p.N):
            schedule(self._agenda, self._counts, p.tau_p * self._random.random(), START, flow, 0, 0.0)
        self.jump(p.q0)
        self._history.reset((self.window, self.queue))
        self._look_back()

    def move(self, steps: int, p: float) -> None:
        """Let the events of the period happen."""
        c = self.p
        for step in range(self._step + 1, self._step + steps + 1):
            run_until(step * self._h, p, self.rate, self.capacity, self._room, c.w_min, c.w_max, not c.ecn,
                      self._random, self._sources, self._agenda, self._fifo, self._counts)  # fmt: skip
            self._count()
            self._history.put((self.window, self.queue))
        self._look_back()
        bound = self.flows * c.w_max + c.q_max
        if self.most_events > bound:
            self.report(
                Level.WARN, "events", f"{self.most_events} events at once, more than N w_max + q_max = {bound:g}"
            )

    @property
    def most_events(self) -> int:
        """Largest number of events that waited at once."""
        return int(self._counts.most_events[0])

    @property
    def lost(self) -> int:
        """Packets lost so far."""
        return int(self._counts.lost[0])

    def _count(self) -> None:
        self.window = mean_window(self._sources)
        self.queue = float(self._counts.waiting[0])
        self.served = float(self._counts.served[0])

    def _look_back(self) -> None:
        self.window_delayed, self.queue_delayed = self._history.at(self.queue / self.capacity + self.propagation)

    def jump(self, packets: float) -> None:
        """Let packets of nobody arrive at once; what finds no room is lost."""
        now = self._step * self._h
        for _ in range(round(packets)):
            arrive(self._agenda, self._fifo, self._counts, now, NOBODY, 0, self.capacity, self._room)
        self._count()

    def changed(self) -> None:
        """Start or end flows; new propagation times hold for what leaves the queue from now on."""
        s, now = self._sources, self._step * self._h
        s.propagation[:] = self.propagation * self._nominal
        for flow in range(self.most_flows):
            wanted = int(flow < self.flows)
            if wanted and not s.active[flow]:
                s.window[flow] = self.p.w_min
                schedule(self._agenda, self._counts, now, START, flow, 0, 0.0)
            s.active[flow] = wanted


main = executable(TcpPackets)
