"""Figures of the queue loop while it runs."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any

from softrig_core import BlockParams, Observer, executable, param
from softrig_core.kit.dense import total

from .model import Bottleneck, equilibrium
from .ports import COMMAND, REFERENCE, STATE, TRUTH


class AqmMonitorParams(Bottleneck, BlockParams):
    """The network, and the windows of the figures."""

    period: float = param(0.001, "sampling period", "s", gt=0.0, le=1.0)
    set_point: float = param(120.0, "queue wanted, until a reference comes", "packet", gt=0.0, le=1e6)
    window: float = param(5.0, "the standard deviation is of the last so many seconds", "s", gt=0.0, le=1e4)
    band: float = param(0.02, "settling band as a fraction of the set point", gt=0.0, lt=1.0)


class AqmMonitor(Observer[AqmMonitorParams]):
    """Mean squares J of queue, window, round trip and drop probability; peak, settling, deviation, utilisation.

    J_q = mean (q - q_d)^2 of the measured queue, J_w = mean (w - w0)^2, J_R = mean R^2, J_p = mean p^2, over all
    samples so far; the memory is that of the window.
    """

    INPUTS = (STATE, TRUTH, COMMAND, REFERENCE)

    @classmethod
    def agreed(cls, params: AqmMonitorParams) -> Mapping[str, Any]:
        """The bottleneck that it judges, and what is wanted of it."""
        return {**params.agreed(), "tcp/set_point": params.set_point}

    def start(self) -> None:
        """Nothing seen."""
        p = self.p
        self._aim(p.set_point)
        self._n = 0
        self._squares = [0.0, 0.0, 0.0, 0.0]
        self._peak = self._seconds = self._served = 0.0
        self._outside = 0.0
        self._recent: deque[float] = deque(maxlen=round(p.window / p.period) + 1)

    def _aim(self, q_d: float) -> None:
        self._q_d = q_d
        self._w0 = equilibrium(self.p, q_d).window

    def update(
        self, t: int, *, state: tuple[float, ...], truth: tuple[float, ...], command: tuple[float, ...],
        reference: tuple[float, ...] | None,
    ) -> Mapping[str, Any]:  # fmt: skip
        """Take one sample in."""
        if reference is not None and reference[0] != self._q_d:
            self._aim(reference[0])
        w, q, R = state
        e = q - self._q_d
        self._n += 1
        for i, x in enumerate((e, w - self._w0, R, command[0])):
            self._squares[i] += x * x
        self._seconds = t / 1e9
        if abs(e) > self.p.band * self._q_d:
            self._outside = self._seconds
        self._peak = max(self._peak, q)
        self._served = truth[5]
        self._recent.append(q)
        return {}

    def status(self) -> Mapping[str, tuple[float, str]]:
        """Give the figures so far."""
        if not self._n or not self._seconds:
            return {}
        J_q, J_w, J_R, J_p = (x / self._n for x in self._squares)
        n = len(self._recent)
        mean = total(self._recent) / n
        spread = (total((q - mean) ** 2 for q in self._recent) / n) ** 0.5
        settled = self._outside < self._seconds
        return {
            "J_q": (J_q, "packet^2"),
            "J_w": (J_w, "packet^2"),
            "J_R": (J_R, "s^2"),
            "J_p": (J_p, ""),
            "peak": (self._peak, "packet"),
            "settling_time": (self._outside + self.p.period if settled else float("inf"), "s"),
            "deviation": (spread, "packet"),
            "utilisation": (self._served / (self.p.C * self._seconds), ""),
        }


main = executable(AqmMonitor)
