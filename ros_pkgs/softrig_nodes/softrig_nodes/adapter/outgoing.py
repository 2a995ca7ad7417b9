"""What a node publishes: its outputs, the clock, and the acknowledgement of its ticks."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from softrig_core.block.answer import Rows
from softrig_core.block.codec import next_number
from softrig_core.block.port import CLOCK, Port, Sample
from softrig_core.wire.cdr import Layout

from ..seam.endpoint import Output
from ..seam.middleware import Matched
from ..seam.numbering import Numbering
from ..seam.tick import TICK, TickWriter, acknowledged
from .record import CLOCK_LAYOUT

if TYPE_CHECKING:
    from .adapter import Adapter


class Outgoing:
    """Publishes and records the answers of a node.

    Parameters
    ----------
    owns_clock : bool
        Whether it publishes /clock.

    Attributes
    ----------
    acknowledge : callable or None
        Acknowledges a tick by its stamp, with the sporadic outputs that published at it; None: no node waits for that.
    alone : bool
        Whether nothing that it publishes has a subscriber in another process.
    """

    def __init__(self, node: Adapter, outputs: list[Output], owns_clock: bool) -> None:
        self._node, self._step, self.outputs = node, node.step, outputs
        middleware = node.middleware
        self.clock_output = Output(CLOCK, middleware.resolve(CLOCK.topic), -1)
        self.tick_output = Output(Port("tick", "~/tick", TICK), f"{middleware.full_name}/tick", -1)
        self.acknowledge: Callable[[int, Iterable[str]], None] | None = None
        self._silent = any(o.port.sporadic for o in outputs)  # at times
        self._owns_clock = owns_clock
        # An array carries a number of its own, and some records need each message; any other answer goes out row by
        # row.
        self._plain = node.step.plain and not any(o.numbered for o in outputs) and node.record.by_numbers
        self.alone = False
        self._unread = False  # whether nothing is sent, and the answers are plain, which are then only recorded

    def begin(self) -> None:
        """Create the publishers."""
        node, middleware, links = self._node, self._node.middleware, self._node.links
        if links.acknowledges if node.options.mode == "lockstep" else links.silence_readers:
            self.acknowledge = self._acknowledging()
        for output in self.outputs:
            topic, layout, matched = output.port.topic, output.layout, self._noting(output)
            if links.returns and output.port.delayed:
                publish = middleware.publisher(topic, layout.msgtype, matched)
                output.send = Numbering(publish, layout, self._step.counts, output.name)
            else:
                output.send = middleware.sender(topic, layout, matched)
        if self._owns_clock:
            self.clock_output.send = middleware.sender(CLOCK.topic, CLOCK_LAYOUT, self._noting(self.clock_output))
        self._check_subscribers()

    def _noting(self, output: Output) -> Matched:
        """Return a callback that stores the number of subscribers of an output."""

        def matched(count: int) -> None:
            output.matched(count)
            self._check_subscribers()

        return matched

    def _check_subscribers(self) -> None:
        links, outputs = self._node.links, (*self.outputs, self.clock_output, self.tick_output)
        # Rigs with outside nodes or restarts repeat messages, so these are made even while no subscriber is matched.
        silent = self._node.middleware.mute and not (links.guests or links.returns)
        self.alone = silent and not any(o.readers for o in outputs)
        self._unread = self.alone and self._plain

    def publish(self, t: int, rows: Rows, numbers: tuple[float, ...]) -> None:
        """Publish and record the outputs of tick `t`, publish the clock if it is ours, and acknowledge the tick.

        All messages are sent in one burst: a reader that wakes for the first finds the others already there. The
        messages are recorded while it works. (Each wake-up between two messages costs as much as the controller.)
        """
        stamp, record = self._node.epoch + t, self._node.record
        # In a container this is nearly always so, and the encoding of messages is then saved.
        if self._unread:
            if record.add_row is not None:
                record.add_row(stamp, numbers)
            return
        messages: list[tuple[Output, int, tuple[float, ...]]] = []
        if self._plain:
            for output, row in zip(self.outputs, rows, strict=True):
                output.send(stamp, row)  # type: ignore[arg-type]
        else:
            messages = self._send_each(stamp, rows)
        if self.acknowledge is not None:
            self.acknowledge(stamp, [o.name for o, _, _ in messages if o.port.sporadic] if self._silent else ())
        if self._owns_clock:
            self.clock_output.send(stamp, ())
        if record.add_row is not None:
            record.add_row(stamp, numbers)
        elif record.sink is not None:
            for output, mark, values in messages:
                record.sink.add(output.number, stamp, output.layout.encode(mark, values))
            if self._owns_clock:
                record.sink.add(record.clock, stamp, CLOCK_LAYOUT.encode(stamp, ()))

    def by_memory(self) -> bool:
        """Return whether native code can publish its answers: only numbers, whose ticks nobody acknowledges."""
        record = self._node.record
        plain = self._plain and self.acknowledge is None and self._node.middleware.mute
        # Without a shard each message would have to be passed to the sink.
        kept = record.shard is not None or record.sink is None
        return plain and kept and all(code[-1] == "d" for o in self.outputs if o.readers for _, code in o.layout.slots)

    def keep(self, times: NDArray[np.int64], numbers: NDArray[np.float64]) -> None:
        """Record many answers that have no subscribers: their ticks, shape (n,), and all their numbers, (n, size)."""
        shard = self._node.record.shard
        if shard is not None and numbers.shape[1]:
            shard.add_rows(self._node.epoch + times, numbers)
        for output in self.outputs:
            self._step.counts[output.name] += len(times)

    def _send_each(self, stamp: int, rows: Rows) -> list[tuple[Output, int, tuple[float, ...]]]:
        """Publish the outputs; return output, stamp or number, and values of each message."""
        messages = []
        for output, row in zip(self.outputs, rows, strict=True):
            if row is None:
                continue
            mark, values = (row.stamp + self._node.epoch, row.data) if isinstance(row, Sample) else (stamp, row)
            if output.numbered:
                mark = next_number(self._step.counts, output.name)
            output.send(mark, values)
            messages.append((output, mark, values))
        return messages

    def _acknowledging(self) -> Callable[[int, Iterable[str]], None]:
        """Return a callable that acknowledges a tick and lists the sporadic ports that published at it."""
        node, matched = self._node, self._noting(self.tick_output)
        if self._silent:
            write, publish = TickWriter(), node.middleware.publisher("~/tick", TICK, matched)
            return lambda stamp, published: publish(write(stamp, published))
        send = node.middleware.sender("~/tick", Layout(TICK), matched)
        if node.options.mode != "lockstep" or node.middleware.name not in node.links.followers:
            return lambda stamp, published: send(stamp, ())
        return lambda stamp, published: send(stamp, ()) if acknowledged(node.schedule, stamp) else None
