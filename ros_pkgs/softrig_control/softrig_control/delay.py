"""A network link between two nodes: delay, jitter, loss and quantisation, with the original stamps."""

from __future__ import annotations

import math
from bisect import insort
from collections.abc import Mapping
from typing import Any, Self

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

    def start(self) -> None:
        """Empty the line."""
        self._newest: int | None = None
        self._line = Line()
        self._held: Sample | None = None
        if self._rounded:
            self.report(
                Level.WARN, "delay", f"delay {self.p.delay:g} s and jitter {self.p.jitter:g} s are not whole "
                f"periods of {self.p.period:g} s: rounded up to {self._delay} and {self._jitter} periods",
            )  # fmt: skip

    def update(self, t: int, *, sent: Sample) -> Mapping[str, Sample | tuple[float, ...]]:
        """Take the newest message sent, give the newest that has arrived."""
        if self._held is None:
            self._held = Sample(sent.stamp, self.p.initial or sent.data)
        if self._newest is None or sent.stamp > self._newest:  # the same stamp again is the same message, held
            self._newest = sent.stamp
            self._send(t, sent)
        elif sent.stamp < self._newest:
            self.report(Level.WARN, "order", "a message older than the one before it was dropped")
        return self._deliver(t)

    def refused(self, t: int) -> Mapping[str, Sample | tuple[float, ...]] | None:
        """A message that cannot be read is lost; what is under way arrives all the same."""
        return None if self._held is None else self._deliver(t)

    def _deliver(self, t: int) -> Mapping[str, Sample | tuple[float, ...]]:
        held = self._held
        assert held is not None
        if (arrived := self._line.arrived(t, held.stamp)) is not None:
            self._held = held = Sample(*arrived)
        return {"arrived": held.data if self.p.restamp else held}

    def _send(self, t: int, sample: Sample) -> None:
        periods = self._delay
        if self._random:  # always both numbers, so that switching one option leaves the other's sequence alone
            draw, survive = self.rng.random(2).tolist()
            periods += int(draw * (self._jitter + 1))
            if survive < self.p.loss:
                return
        data = sample.data
        if self.p.quantum:
            data = tuple(
                math.floor(x / q + 0.5) * q if q else x for x, q in zip(data, self.p.quantum, strict=True)
            )  # fmt: skip
        self._line.send(t + periods * self._period, sample.stamp, data)


class Line:
    """Messages under way, each with the time of its arrival; of those that are there the newest one counts."""

    def __init__(self) -> None:
        self._under_way: list[tuple[int, int, Any]] = []

    def send(self, due: int, stamp: int, message: Any) -> None:
        """Put a message on the line that arrives at `due`, ns."""
        insort(self._under_way, (due, stamp, message))

    def arrived(self, t: int, since: int) -> tuple[int, Any] | None:
        """Take off what has arrived at `t`; give the newest if it is as new as `since`, ns. Older ones are dropped."""
        found = None
        while self._under_way and self._under_way[0][0] <= t:
            _, stamp, message = self._under_way.pop(0)
            if stamp >= since:
                found, since = (stamp, message), stamp
        return found


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
