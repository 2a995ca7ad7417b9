"""Observers with a window of messages, and figures that are measured on it while the rig runs."""

from __future__ import annotations

import math
import struct
from abc import abstractmethod
from collections.abc import Container, Iterable, Iterator, Mapping
from functools import cache
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..block.answer import Messages, ReceivedMessages
from ..block.block import Observer
from ..block.gathering import EVER
from ..block.params import BlockParams, param
from ..block.port import Port, Sample
from ..judge.measures import UNMEASURED, Function, newest_step
from ..judge.units import compose
from ..timebase import SECOND
from ..wire.signals import Signal, topic_of
from .figures import Figure


class WatchParams(BlockParams):
    """Parameters of the live figures: the length of their time window."""

    window: float = param(60.0, "the figures are those of this last time", "s", gt=0.0, le=3600.0)


W = TypeVar("W", bound=WatchParams)
NONE: Mapping[str, Any] = MappingProxyType({})
# Bytes cannot grow in place: each new message copies those in `newest`, at most SOME bytes; each full `newest` copies
# those in `filling`, at most MANY bytes. Full blocks are not copied any more.
SOME = 1 << 11
MANY = 1 << 16
STAMP = struct.Struct("<q")


_new = tuple.__new__  # makes a named tuple in half the time of its own constructor


def row_of(size: int) -> struct.Struct:
    """Return the struct that packs the stamp and `size` values of a message."""
    return struct.Struct(f"<q{size}d")


@cache
def _rows(size: int) -> np.dtype[np.void]:
    """Return the array type of messages with `size` values."""
    return np.dtype([("stamp", "<i8"), ("values", "<f8", (size,))])


class Kept(NamedTuple):
    """Messages of one topic in the window as bytes: stamp in ns (int64) and values (float64), message after message.

    Bytes are immutable, take only the memory of their numbers, and are not visited by the garbage collector. Tuples
    took five times the memory, and after ten seconds garbage collection took all the time of a 20 kHz loop.
    """

    blocks: tuple[bytes, ...] = ()
    filling: bytes = b""
    """The block that is being filled, but for those that come one by one."""

    newest: bytes = b""
    stamp: int = EVER
    """Of the newest message."""

    since: int = EVER
    """What is older has left the window, though it is dropped by whole blocks only."""

    dropped: bool = False

    def stamps(self, size: int) -> NDArray[np.int64]:
        """Return the stamps in the window, ns, shape (n,), oldest first; `size` values for each message."""
        result = self._joined(size, "stamp")
        return result[result.searchsorted(self.since) :]

    def column(self, size: int, k: int, number: int) -> NDArray[np.float64]:
        """Return value k of the newest `number` messages, shape (number,), the oldest first."""
        result = self._joined(size, "values", k)
        return result[len(result) - number :]

    def _joined(self, size: int, *selection: Any) -> NDArray[Any]:
        """Return one number of all messages; block by block, because a window may have hundreds of MB."""
        kind, field, *column = _rows(size), *selection
        parts = [np.frombuffer(block, kind)[field] for block in (*self.blocks, self.filling, self.newest)]
        return np.concatenate([part[:, column[0]] if column else part for part in parts])

    @property
    def forgot(self) -> bool:
        """Return whether messages have left the window."""
        oldest = self.blocks[0] if self.blocks else self.filling or self.newest
        return self.dropped or (oldest != b"" and STAMP.unpack_from(oldest)[0] < self.since)

    def with_message(self, row: struct.Struct, stamp: int, values: Any, t: int, reach: int) -> Kept:
        """Add a message at tick t, if it is new; messages older than `reach` before t leave the window (ns).

        `row` packs it (`row_of`).
        """
        blocks, filling, newest, last, before, dropped = self
        since = t - reach
        # The window may have been made longer since, but what has left it stays out.
        if since < before:
            since = before
        if stamp <= last:
            return _new(Kept, (blocks, filling, newest, last, since, dropped))
        newest += row.pack(stamp, *(values.data if type(values) is Sample else values))
        if len(newest) >= SOME:
            filling, newest = filling + newest, b""
            if len(filling) >= MANY:
                blocks, filling = _since((*blocks, filling), stamp - reach, row.size), b""
                # One block was added, so if there are no more than before, an old one has gone.
                dropped = dropped or len(blocks) <= len(self.blocks)
        return _new(Kept, (blocks, filling, newest, stamp, since, dropped))

    def with_messages(self, messages: Messages, t: int, reach: int) -> Kept:
        """Add new messages, oldest first; equal to calling `with_message` for one after the other up to a tick t."""
        since = max(self.since, t - reach)
        if not messages:
            return self if self.stamp == EVER else self._replace(since=since)
        row = row_of(len(messages[0][1]))
        # Blocks end at the same messages as those of `with_message`, so that both ways lead to the same state.
        some = -(-SOME // row.size) * row.size
        many = -(-MANY // some) * some
        data = self.filling + self.newest + packed(messages)
        full = len(data) // many * many
        blocks, dropped = (*self.blocks, *(data[k : k + many] for k in range(0, full, many))), self.dropped
        if full:
            last, _ = messages[(full - len(self.filling) - len(self.newest)) // row.size - 1]
            known, blocks = len(blocks), _since(blocks, last - reach, row.size)
            dropped = dropped or len(blocks) < known
        remaining = full + (len(data) - full) // some * some
        return Kept(blocks, data[full:remaining], data[remaining:], messages[-1][0], since, dropped)


def packed(messages: Messages) -> bytes:
    """Return messages in their stored form."""
    stamps, values = (
        (messages.stamps, messages.values) if isinstance(messages, ReceivedMessages) else zip(*messages, strict=True)
    )
    rows = np.empty(len(messages), _rows(len(values[0])))
    rows["stamp"], rows["values"] = stamps, values
    return rows.tobytes()


def _since(blocks: tuple[bytes, ...], stamp: int, size: int) -> tuple[bytes, ...]:
    """Return the blocks with messages at or after a stamp; a message has `size` bytes."""
    count = 0
    # The last block contains the newest message, which is in the window, so the loop ends.
    while STAMP.unpack_from(blocks[count], len(blocks[count]) - size)[0] < stamp:
        count += 1
    return blocks[count:]


class Window(NamedTuple):
    """Received messages of each input, in the order of the ports; the first field of a subclass's state."""

    seen: tuple[Kept, ...]


class Watch(Observer[W]):
    """An observer that stores the messages of a window and evaluates figure functions on them on request.

    Subclasses define `figures`. Signals are named ``topic/channel/field`` with the port's original topic, before any
    remapping. Each message counts once, at its own stamp, so a slower input is not repeated. At the end of a run plants
    publish once more; the command of the previous tick is not paired with these messages.

    A subclass with more state defines a state type with a field `seen`, initially `nothing`, which `keep` updates.
    """

    def setup(self) -> None:
        """Find the units of the signals."""
        self.in_batches = type(self).update is Watch.update
        inputs, _ = self.ports(self.p)
        self._ports = {port.name: port for port in inputs}
        self._units = {f"{p.topic}/{label}": u for p in inputs for label, u in zip(p.labels, p.units, strict=True)}
        self._rows = {port.name: row_of(port.size) for port in inputs}
        self._reach = round(self.p.window * SECOND)
        self.nothing = (Kept(),) * len(inputs)

    def first(self) -> Any:
        """Return the initial state, without messages."""
        return Window(self.nothing)

    def update(self, x: Any, t: int, **inputs: Any) -> tuple[Any, Mapping[str, tuple[float, ...]]]:
        """Store new messages."""
        return Window(self.keep(x.seen, t, inputs)), {}

    def keep(self, stored: tuple[Kept, ...], t: int, inputs: Mapping[str, Any]) -> tuple[Kept, ...]:
        """Return the stored messages with the new ones in the inputs of a tick."""
        # `ages` is what `age` calls; it saves one call for each input and tick.
        reach, age, results = self._reach, self.ages or self.age, []
        for (name, row), topic in zip(self._rows.items(), stored, strict=True):
            values = inputs.get(name)
            results.append(topic if values is None else topic.with_message(row, t - (age(name) or 0), values, t, reach))
        return tuple(results)

    def at_once(self, x: Any, t: int, messages: Mapping[str, Messages]) -> Any:
        """See `softrig_core.block.gathering.Batched`."""
        stored = zip(self._ports, x.seen, strict=True)
        return Window(tuple(topic.with_messages(messages.get(name, ()), t, self._reach) for name, topic in stored))

    def figure(self, name: str, function: Function, arguments: Mapping[str, Any] = NONE) -> Figure:
        """Create a figure, in the unit of its function and its signal."""
        unit = compose(getattr(function, "unit", ""), self._units.get(arguments.get("signal", ""), ""))
        return Figure(name, function, arguments, unit, 1.0)

    def figures(self, x: Any) -> Iterable[Figure]:
        """Return the figures; called each time, so that they may depend on the messages."""
        raise NotImplementedError

    def status(self, x: Any) -> Mapping[str, tuple[float, str]]:
        """Return the figures that can be measured so far; none of a step before the window."""
        return status_of(self.figures(x), Seen(self._ports, dict(zip(self._ports, x.seen, strict=True))))


class Recent(Mapping[str, Signal]):
    """The signals of some ports from some time on, for figure functions."""

    def __init__(self, ports: Iterable[Port]) -> None:
        self.ports = {port.topic: port for port in ports}

    @property
    @abstractmethod
    def end(self) -> float:
        """Time of the newest message, s; the last sample of each signal is held up to it."""

    @property
    @abstractmethod
    def forgot(self) -> set[str]:
        """Topics whose older messages have left the window."""

    def topic(self, name: str) -> str:
        """Return the topic of a signal; empty if there is none."""
        return topic_of(name, self.ports)

    def __iter__(self) -> Iterator[str]:
        for topic, port in self.ports.items():
            yield from (f"{topic}/{label}" for label in port.labels)

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def place(self, name: str) -> tuple[Port, int]:
        """Return the port of a signal and its index there; raise a KeyError if there is none."""
        port = self.ports.get(self.topic(name))
        if port is None or (k := port.places.get(name[len(port.topic) + 1 :])) is None:
            raise KeyError(name)
        return port, k


def status_of(figures: Iterable[Figure], signals: Recent) -> Mapping[str, tuple[float, str]]:
    """Return value and unit of the figures that can be measured, by name."""
    forgot, result = signals.forgot, {}
    for figure in figures:
        try:
            value = math.nan if left_behind(figure.since, signals, forgot) else figure(signals)
        except UNMEASURED:  # not enough samples yet
            continue
        if math.isfinite(value):
            result[figure.name] = (value, figure.unit)
    return result


def left_behind(since: str, signals: Recent, forgot: Container[str]) -> bool:
    """Return whether the newest steps of signals are older than the stored messages, so a first sample is no step."""
    return all(
        signals.topic(name) in forgot and newest_step(signals, name)[0] == signals[name].t[0]
        for name in since.split(", ")
    )


class Seen(Recent):
    """The stored messages of a `Watch`, as signals for figure functions."""

    def __init__(self, ports: Mapping[str, Port], stored: Mapping[str, Kept]) -> None:
        super().__init__(ports.values())
        self._kept = {port.topic: stored[name] for name, port in ports.items()}
        self._times: dict[str, Any] = {}

    @property
    def end(self) -> float:
        """See `Recent`."""
        return max(kept.stamp for kept in self._kept.values()) / SECOND

    @property
    def forgot(self) -> set[str]:
        """Topics whose older messages have left the window; see `Recent`."""
        return {topic for topic, kept in self._kept.items() if kept.forgot}

    def __getitem__(self, name: str) -> Signal:
        port, k = self.place(name)
        topic, kept = port.topic, self._kept[port.topic]
        if topic not in self._times:
            self._times[topic] = kept.stamps(port.size) / SECOND
        times = self._times[topic]
        return Signal(times, kept.column(port.size, k, len(times)))
