"""A network link between two nodes: delay, jitter, loss and quantisation, with the original stamps."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

from softrig_core import Block, Level, Port, Sample, jit, param, to_ns

from .unit_delay import LinkParams

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

Blocks = tuple[tuple[tuple[int, int, Any], ...], ...]


class FieldbusDelayParams(LinkParams):
    """Parameters of a fieldbus link: the messages it carries, and their delay, jitter and loss."""

    delay: float = param(0.08, "delay, rounded up to whole periods", "s", ge=0.0, live=True)
    jitter: float = param(
        0.0, "largest additional delay; whole periods from 0 up to it are equally likely", "s", ge=0.0, live=True
    )
    loss: float = param(0.0, "probability that a message is lost", ge=0.0, lt=1.0, live=True)
    quantum: tuple[float, ...] = param(
        (), "step to which each value is rounded, 0 for none; empty: no rounding", each=(0.0, 1e12), live=True
    )
    restamp: bool = param(False, "stamp with the time of delivery, for a receiver that pairs messages by stamp")

    def _check(self) -> None:
        self.check_size("quantum")
        if not self.type.stamped:
            raise ValueError(f"message {self.message} has no stamp, which is needed to order messages")


# Messages of a block. A tick copies the block into which it inserts, so a block is small even if the line is long.
BLOCK = 64


class Line:
    """Messages in transit, a value: each with its arrival and its stamp, ns, sorted by these.

    They are stored in blocks, so that a tick copies only a few.

    Parameters
    ----------
    size : int
        Numbers in a message; 0: messages are not rows of numbers, which native code does not support.
    blocks : tuple of tuple of (int, int, object), optional
        Arrival, stamp and message of each, sorted; no block is empty.
    """

    __slots__ = ("_blocks", "_size")

    def __init__(self, size: int = 0, blocks: Blocks = ()) -> None:
        self._size, self._blocks = size, blocks

    def put(self, due: int, stamp: int, message: Any) -> Line:
        """Return the line with one message more, which arrives at `due`, ns."""
        blocks, item = self._blocks, (due, stamp, message)
        k = len(blocks) - 1
        while k > 0 and item < blocks[k][0]:
            k -= 1
        if k < 0:
            return Line(self._size, ((item,),))
        index = bisect_right(blocks[k], item)
        block = (*blocks[k][:index], item, *blocks[k][index:])
        pieces = (block,) if len(block) <= BLOCK else (block[:BLOCK], block[BLOCK:])
        return Line(self._size, (*blocks[:k], *pieces, *blocks[k + 1 :]))

    def pop_arrived(self, t: int, since: int, message: Any) -> tuple[Line, int, Any]:
        """Remove the messages that have arrived at `t`; return the newest of those from `since` (ns) on, stamp before
        message.

        Where none of them is, that is `since` and `message`.
        """
        blocks = self._blocks
        if not blocks or blocks[0][0][0] > t:
            return self, since, message
        while blocks and blocks[0][0][0] <= t:
            block, k = blocks[0], 0
            while k < len(block) and block[k][0] <= t:
                if block[k][1] >= since:
                    _, since, message = block[k]
                k += 1
            blocks = blocks[1:] if k == len(block) else (block[k:], *blocks[1:])
        return Line(self._size, blocks), since, message

    def native(self) -> Line | LineRow:
        """Return its native form."""
        if not self._size:
            return self
        import numpy as np

        items = self._messages()
        room = 2 * len(items) + BLOCK
        dues, stamps = np.zeros(room, np.int64), np.zeros(room, np.int64)
        values = np.zeros((room, self._size))
        for k, item in enumerate(items):
            dues[k], stamps[k], values[k] = item
        return LineRow((0.0,) * self._size, 0, len(items), dues, stamps, values.ravel())

    def numbers(self) -> NDArray[np.float64]:
        """Return the numbers of all messages in one row, which a linear view uses as states."""
        from softrig_core.kit import floats

        return floats.numbers(self._blocks)

    def with_numbers(self, row: NDArray[np.float64]) -> Line:
        """Return it with other numbers, in the order of `numbers`."""
        from softrig_core.kit import floats

        return Line(self._size, floats.put(self._blocks, floats.split(self._blocks, row)))

    def _messages(self) -> list[tuple[int, int, Any]]:
        return [item for block in self._blocks for item in block]

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Line):
            return NotImplemented
        return self._messages() == other._messages()

    def __repr__(self) -> str:
        return f"Line({self._size}, {tuple(self._messages())})"


class LineRow(NamedTuple):
    """A `Line` in native code: all messages in one row, those from `begin` to `end` in transit."""

    blank: tuple[float, ...]
    begin: int
    end: int
    dues: NDArray[np.int64]
    stamps: NDArray[np.int64]
    values: NDArray[np.float64]

    def put(self, due: int, stamp: int, message: tuple[float, ...]) -> LineRow:
        """See `Line.put`."""
        begin, end = _insert(self.dues, self.stamps, self.values, self.begin, self.end, due, stamp, message)
        return self._replace(begin=begin, end=end)

    def pop_arrived(self, t: int, since: int, message: tuple[float, ...]) -> tuple[LineRow, int, tuple[float, ...]]:
        """See `Line.pop_arrived`."""
        begin, n = self.begin, len(self.blank)
        while begin < self.end and self.dues[begin] <= t:
            if self.stamps[begin] >= since:
                since = self.stamps[begin]
                message = tuple([self.values[begin * n + k] for k, _ in enumerate(self.blank)])
            begin += 1
        return self._replace(begin=begin), since, message

    def python(self) -> Line:
        """Return its Python form."""
        n, result = len(self.blank), Line(len(self.blank))
        for k in range(self.begin, self.end):
            row = tuple(self.values[k * n : (k + 1) * n].tolist())
            result = result.put(int(self.dues[k]), int(self.stamps[k]), row)
        return result


@jit
def _insert(
    dues: NDArray[np.int64],
    stamps: NDArray[np.int64],
    values: NDArray[np.float64],
    begin: int,
    end: int,
    due: int,
    stamp: int,
    message: tuple[float, ...],
) -> tuple[int, int]:
    n = len(message)
    if end == len(dues):
        if begin == 0:
            raise IndexError("the line is full")
        for k in range(begin, end):
            dues[k - begin], stamps[k - begin] = dues[k], stamps[k]
            for j in range(n):
                values[(k - begin) * n + j] = values[k * n + j]
        begin, end = 0, end - begin
    index = end
    while index > begin and (due < dues[index - 1] or (due == dues[index - 1] and stamp < stamps[index - 1])):
        dues[index], stamps[index] = dues[index - 1], stamps[index - 1]
        for j in range(n):
            values[index * n + j] = values[(index - 1) * n + j]
        index -= 1
    dues[index], stamps[index] = due, stamp
    for j in range(n):
        values[index * n + j] = message[j]
    return begin, end + 1


class State(NamedTuple):
    """Stamp of the newest message sent, ns; messages in transit; arrived messages; random numbers drawn."""

    newest: int | None = None
    line: Line = Line()
    held: Sample | None = None
    k: int = 0


class FieldbusDelay(Block[FieldbusDelayParams]):
    """A link that answers every tick with the newest message that has arrived, under its acquisition stamp.

    A message sent at t arrives at t + d, d = ceil(delay / period) + a random whole number of periods up to the jitter;
    a message overtaken by a newer one is dropped. Before the first arrival it publishes the initial values with the
    stamp of the first message sent. The random numbers depend on the rig's seed and the node's name only.

    Notes
    -----
    A port that reads the link must be declared `delayed`, unless `restamp` is set. On a command link set the `initial`
    values: without them the first command takes effect immediately and holds until the second arrives.
    """

    @classmethod
    def ports(cls, params: FieldbusDelayParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Return both ends, of the same message type."""
        return (params.port("sent", params.topic_in, delayed=True),), (
            params.port("arrived", params.topic_out, delayed=not params.restamp),
        )

    def setup(self) -> None:
        """Turn times into whole periods."""
        p = self.p
        self._period = to_ns(p.period)
        self._delay, self._rounded = whole_periods(p.delay, p.period)
        self._jitter, rounded = whole_periods(p.jitter, p.period)
        self._late = self._delay * self._period
        self._rounded |= rounded
        self._random = self._jitter > 0 or p.loss > 0.0

    def first(self) -> State:
        """Return the empty line."""
        return State(line=Line(self.p.port("sent", self.p.topic_in).size))

    def update(self, x: State, t: int, *, sent: Sample) -> tuple[State, Mapping[str, Sample | tuple[float, ...]]]:
        """Store the newest message sent, return the newest that has arrived."""
        newest, line, held, k = x
        if held is None:
            held = Sample(sent.stamp, self.p.initial or sent.data)
            if self._rounded:
                self.report(
                    Level.WARN,
                    "delay",
                    f"delay {self.p.delay:g} s and jitter {self.p.jitter:g} s are not whole "
                    f"periods of {self.p.period:g} s: rounded up to {self._delay} and {self._jitter} periods",
                )
        # The same stamp again is the same message, which the input still holds.
        if newest is None or sent.stamp > newest:
            newest = sent.stamp
            line, k = self._send(line, k, t, sent)
        elif sent.stamp < newest:
            self.report(Level.WARN, "order", "a message older than the previous one was dropped")
        return self._deliver(newest, line, held, k, t)

    def refused(self, x: State, t: int) -> tuple[State, Mapping[str, Sample | tuple[float, ...]] | None]:
        """Treat a message that cannot be read as lost; messages in transit still arrive."""
        return (x, None) if x.held is None else self._deliver(x.newest, x.line, x.held, x.k, t)

    def _deliver(
        self, newest: int | None, line: Line, held: Sample, k: int, t: int
    ) -> tuple[State, Mapping[str, Sample | tuple[float, ...]]]:
        line, stamp, data = line.pop_arrived(t, held.stamp, held.data)
        held = Sample(stamp, data)
        return State(newest, line, held, k), {"arrived": held.data if self.p.restamp else held}

    def _send(self, line: Line, k: int, t: int, sample: Sample) -> tuple[Line, int]:
        late = self._late
        # Both numbers are always drawn, so that switching one option leaves the sequence of the other as it is.
        if self._random:
            draw, survive = self.uniform(k), self.uniform(k + 1)
            k += 2
            late += int(draw * (self._jitter + 1)) * self._period
            if survive < self.p.loss:
                return line, k
        data = sample.data
        if self.p.quantum:
            data = tuple(math.floor(x / q + 0.5) * q if q else x for x, q in zip(data, self.p.quantum, strict=True))
        return line.put(t + late, sample.stamp, data), k


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
