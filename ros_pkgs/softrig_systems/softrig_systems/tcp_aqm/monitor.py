"""Figures of the queue loop while it runs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

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


BLOCK = 64


class State(NamedTuple):
    """Set point q_d and window w0 of its equilibrium (packets), samples, sums of squares, and what came last or most.

    `outside` and `seconds` are the times (s) of the last sample outside the band and of the last one, `blocks` and
    `newest` the queue of late: full blocks of 64 samples, and those after them.
    """

    q_d: float
    w0: float
    n: int = 0
    squares: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    peak: float = 0.0
    seconds: float = 0.0
    served: float = 0.0
    outside: float = 0.0
    blocks: tuple[tuple[float, ...], ...] = ()
    newest: tuple[float, ...] = ()


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

    def setup(self) -> None:
        """Size the window."""
        self._size = round(self.p.window / self.p.period) + 1
        self._blocks = -(-self._size // BLOCK)

    def first(self) -> State:
        """Nothing seen."""
        q_d = self.p.set_point
        return State(q_d, equilibrium(self.p, q_d).window)

    def update(
        self, x: State, t: int, *, state: tuple[float, ...], truth: tuple[float, ...], command: tuple[float, ...],
        reference: tuple[float, ...] | None,
    ) -> tuple[State, Mapping[str, Any]]:  # fmt: skip
        """Take one sample in."""
        q_d, w0, n, (s_q, s_w, s_R, s_p), peak, _, _, outside, blocks, newest = x
        if reference is not None and reference[0] != q_d:
            q_d = reference[0]
            w0 = equilibrium(self.p, q_d).window
        w, q, R = state
        e, off, p = q - q_d, w - w0, command[0]
        seconds = t / 1e9
        if abs(e) > self.p.band * q_d:
            outside = seconds
        newest = (*newest, q)
        if len(newest) == BLOCK:
            blocks, newest = (*blocks, newest)[-self._blocks :], ()
        squares = (s_q + e * e, s_w + off * off, s_R + R * R, s_p + p * p)
        return State(q_d, w0, n + 1, squares, max(peak, q), seconds, truth[5], outside, blocks, newest), {}

    def status(self, x: State) -> Mapping[str, tuple[float, str]]:
        """Give the figures so far."""
        if not x.n or not x.seconds:
            return {}
        J_q, J_w, J_R, J_p = (square / x.n for square in x.squares)
        recent = (*(q for block in x.blocks for q in block), *x.newest)[-self._size :]
        n = len(recent)
        mean = total(recent) / n
        spread = (total((q - mean) ** 2 for q in recent) / n) ** 0.5
        settled = x.outside < x.seconds
        return {
            "J_q": (J_q, "packet^2"),
            "J_w": (J_w, "packet^2"),
            "J_R": (J_R, "s^2"),
            "J_p": (J_p, ""),
            "peak": (x.peak, "packet"),
            "settling_time": (x.outside + self.p.period if settled else float("inf"), "s"),
            "deviation": (spread, "packet"),
            "utilisation": (x.served / (self.p.C * x.seconds), ""),
        }


main = executable(AqmMonitor)
