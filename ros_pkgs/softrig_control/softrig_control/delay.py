"""A network link between two nodes: delay, jitter, loss and quantisation, with the original stamps."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Mapping
from typing import Any, NamedTuple, Self

from pydantic import model_validator
from softrig_core import Block, Level, Port, Sample, executable, param, to_ns

from .unit_delay import LinkParams


class FieldbusDelayParams(LinkParams):
    """Which messages the link carries and what it does to them."""

    delay: float = param(0.08, "delay, rounded up to whole periods", "s", ge=0.0, live=True)
    jitter: float = param(0.0, "largest additional delay; whole periods from 0 up to it are equally likely", "s",
                          ge=0.0, live=True)  # fmt: skip
    loss: float = param(0.0, "probability that a message is lost", ge=0.0, lt=1.0, live=True)
    quantum: tuple[float, ...] = param((), "step to which each value is rounded, 0 for none; empty: no rounding",
                                       each=(0.0, 1e12), live=True)  # fmt: skip
    restamp: bool = param(False, "stamp with the time of delivery, for a receiver that pairs messages by stamp")

    @model_validator(mode="after")
    def _steps_fit(self) -> Self:
        self.check_size("quantum")
        if not self.type.stamped:
            raise ValueError(f"message {self.message} has no stamp, which tells what was sent before what")
        return self


Line = tuple[tuple[tuple[int, int, Any], ...], ...]
"""Messages under way, (arrival in ns, stamp in ns, message) each, sorted; in blocks, so that a tick copies few."""

BLOCK = 64  # messages


class State(NamedTuple):
    """Stamp of the newest message sent, ns; those under way; what has arrived; random numbers drawn."""

    newest: int | None = None
    line: Line = ()
    held: Sample | None = None
    k: int = 0


class FieldbusDelay(Block[FieldbusDelayParams]):
    """A link that answers every tick with the newest message that has arrived, under its acquisition stamp.

    A message sent at t arrives at t + d, d = ceil(delay / period) + a random whole number of periods up to the
    jitter; a message overtaken by a newer one is dropped. Nothing arrived yet: the initial values, under the stamp
    of the first message sent. The random numbers depend on the rig's seed and the node's name only.

    Notes
    -----
    A port that reads the link must be declared `delayed`, unless `restamp` is set. On a command link give the
    `initial` values: without them the first command takes effect at once and holds until the second arrives.
    """

    @classmethod
    def ports(cls, params: FieldbusDelayParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Give both ends, of the same message type."""
        return (params.port("sent", params.topic_in, delayed=True),), (
            params.port("arrived", params.topic_out, delayed=not params.restamp),
        )

    def setup(self) -> None:
        """Turn times into whole periods."""
        p = self.p
        self._period = to_ns(p.period)
        self._delay, self._rounded = whole_periods(p.delay, p.period)
        self._jitter, rounded = whole_periods(p.jitter, p.period)
        self._rounded |= rounded
        self._random = self._jitter > 0 or p.loss > 0.0

    def first(self) -> State:
        """Nothing is on the line."""
        return State()

    def update(
        self, x: State, t: int, *, sent: Sample
    ) -> tuple[State, Mapping[str, Sample | tuple[float, ...]]]:  # fmt: skip
        """Take the newest message sent, give the newest that has arrived."""
        newest, line, held, k = x
        if held is None:
            held = Sample(sent.stamp, self.p.initial or sent.data)
            if self._rounded:
                self.report(
                    Level.WARN, "delay", f"delay {self.p.delay:g} s and jitter {self.p.jitter:g} s are not whole "
                    f"periods of {self.p.period:g} s: rounded up to {self._delay} and {self._jitter} periods",
                )  # fmt: skip
        if newest is None or sent.stamp > newest:  # the same stamp again is the same message, held
            newest = sent.stamp
            line, k = self._send(line, k, t, sent)
        elif sent.stamp < newest:
            self.report(Level.WARN, "order", "a message older than the one before it was dropped")
        return self._deliver(newest, line, held, k, t)

    def refused(self, x: State, t: int) -> tuple[State, Mapping[str, Sample | tuple[float, ...]] | None]:
        """A message that cannot be read is lost; what is under way arrives all the same."""
        return (x, None) if x.held is None else self._deliver(x.newest, x.line, x.held, x.k, t)

    def _deliver(
        self, newest: int | None, line: Line, held: Sample, k: int, t: int
    ) -> tuple[State, Mapping[str, Sample | tuple[float, ...]]]:
        line, found = arrived(line, t, held.stamp)
        if found is not None:
            held = Sample(*found)
        return State(newest, line, held, k), {"arrived": held.data if self.p.restamp else held}

    def _send(self, line: Line, k: int, t: int, sample: Sample) -> tuple[Line, int]:
        periods = self._delay
        if self._random:  # always both numbers, so that switching one option leaves the other's sequence alone
            draw, survive = self.uniform(k), self.uniform(k + 1)
            k += 2
            periods += int(draw * (self._jitter + 1))
            if survive < self.p.loss:
                return line, k
        data = sample.data
        if self.p.quantum:
            data = tuple(
                math.floor(x / q + 0.5) * q if q else x for x, q in zip(data, self.p.quantum, strict=True)
            )  # fmt: skip
        return sent_on(line, t + periods * self._period, sample.stamp, data), k


def sent_on(line: Line, due: int, stamp: int, message: Any) -> Line:
    """Put a message on a line that arrives at `due`, ns."""
    item = (due, stamp, message)
    k = len(line) - 1
    while k > 0 and item < line[k][0]:
        k -= 1
    if k < 0:
        return ((item,),)
    at = bisect_right(line[k], item)
    block = (*line[k][:at], item, *line[k][at:])
    parts = (block,) if len(block) <= BLOCK else (block[:BLOCK], block[BLOCK:])
    return (*line[:k], *parts, *line[k + 1 :])


def arrived(line: Line, t: int, since: int) -> tuple[Line, tuple[int, Any] | None]:
    """Take off what has arrived at `t`, and give the newest, with its stamp, if that is `since` (ns) or later."""
    found = None
    while line and line[0][0][0] <= t:
        block, k = line[0], 0
        while k < len(block) and block[k][0] <= t:
            _, stamp, message = block[k]
            if stamp >= since:
                found, since = (stamp, message), stamp
            k += 1
        line = line[1:] if k == len(block) else (block[k:], *line[1:])
    return line, found


def whole_periods(time: float, period: float) -> tuple[int, bool]:
    """Round a time up to whole periods, both in s.

    Parameters
    ----------
    time : float
        To be rounded, s.
    period : float
        s.

    Returns
    -------
    (int, bool)
        Number of periods, and whether the time was not a multiple.
    """
    exact = time / period
    periods = math.ceil(exact - 1e-9)
    return periods, abs(periods - exact) > 1e-9 * max(1.0, exact)


main = executable(FieldbusDelay)
