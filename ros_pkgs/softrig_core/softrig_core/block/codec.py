"""Codecs of ports: message bytes to tuples of float64, and how the values of one port become those of another."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from ..timebase import SECOND
from ..wire.cdr import Layout, Message, Picker, getter, parse
from ..wire.stream import CdrError
from .answer import sum_of_products
from .fill import Pick
from .port import Port, Refused


class Decoder:
    """Reads the values of an input port from message bytes of any layout, fast for the last layout seen."""

    def __init__(self, port: Port) -> None:
        self._port = port
        self._bound = port.bound
        self._decode = port.layout().decode  # decoder of the newest layout
        self._pick: Picker | None = None
        # Of a partial port: values of the channels that a message leaves out; its reader updates them.
        self.kept = port.safe

    def __call__(self, data: bytes) -> tuple[int, tuple[float, ...]]:
        """Return (stamp in ns, values); for the stamp of a message without one see `cdr.Message.mark`.

        Raises
        ------
        Refused
            Malformed bytes, missing or unknown channels, wrong length, wrong frame, NaN, infinity, beyond a limit.
        """
        result = self._decode(data)
        if result is None:
            self._learn(data)
            result = self._decode(data)
            # Other padding or another byte order, which no prepared layout has.
            if result is None:
                return self._slow(data)
        if self._pick is not None:
            stamp, values = result
            result = stamp, self._pick(values + self.kept if self._port.partial else values)
        values = result[1]
        size = sum_of_products(values, values)
        # One value is beyond its limit, NaN or infinite; or many are large, and each is still within its limit.
        if type(size) is not float or not size <= self._bound:
            self._check(values)
        return result

    def _check(self, values: tuple[float, ...]) -> None:
        if reason := self._port.beyond(values):
            raise Refused(reason)

    def _learn(self, data: bytes) -> None:
        """Adopt the layout of `data` if it contains the values of the port."""
        message = self._parse(data)
        # This comes first: a layout that is refused must be refused again the next time.
        order = self._order(message)
        layout = message.layout(self._port.msgtype)
        self._decode = layout.decode
        self._pick = None if order == tuple(range(layout.size)) and not self._port.partial else getter(order)

    def _slow(self, data: bytes) -> tuple[int, tuple[float, ...]]:
        message = self._parse(data)
        flat = [float(x) for values in message.fields.values() for x in values]
        order = self._order(message)
        values = tuple([*flat, *self.kept][i] for i in order)
        self._check(values)
        return message.mark, values

    def number(self, data: bytes) -> int:
        """Return the sequence number of a rejected array; -1 if there is none or it cannot be read."""
        try:
            return self._parse(data).mark
        except Refused:
            return -1

    def _parse(self, data: bytes) -> Message:
        try:
            return parse(self._port.msgtype, data)
        except CdrError as error:
            raise Refused(str(error)) from None

    def _order(self, message: Message) -> tuple[int, ...]:
        """Return the place of each value of the port among all numbers of the message, followed by those kept."""
        port = self._port
        if port.frame_id and message.frame_id != port.frame_id:
            raise Refused(f"frame_id {message.frame_id!r}, expected {port.frame_id!r}")
        # People and ros2_controllers send arrays without dimensions.
        flat = port.held and message.dims == ()
        if not flat and (message.dims or ()) != port.dims:
            raise Refused(f"shape {dict(message.dims or ())}, expected {dict(port.dims)}")
        named, names = port.type.named, message.names
        if port.also and sorted(names) == sorted(port.also):
            names = tuple(port.channels[port.also.index(name)] for name in names)
        if port.partial:
            _check_partial(names, port)
        elif named and sorted(names) != sorted(port.channels):
            raise Refused(f"names {list(names)}, expected {list(port.channels)}")
        order: list[int] = []
        start: dict[str, int] = {}
        offset = 0
        for name, values in message.fields.items():
            start[name] = offset
            offset += len(values)
        for name in port.fields:
            n = len(message.fields[name])
            if named and n != len(message.names):
                raise Refused(f"{name} has {n} values, expected {len(message.names)} ({', '.join(message.names)})")
            if flat and n != port.size:
                raise Refused(f"{name} has {n} values, expected {port.size}")
            if not named:
                order += [start[name] + i for i in range(n)]
                continue
            index_of = {c: start[name] + i for i, c in enumerate(names)}
            order += [index_of.get(c, offset + len(order) + i) for i, c in enumerate(port.channels)]
        return tuple(order)


def _check_partial(names: Sequence[str], port: Port) -> None:
    if not names or len(set(names)) != len(names) or not set(names) <= set(port.channels):
        raise Refused(f"names {list(names)}, expected some of {list(port.channels)}")


def encoder(layout: Layout, counts: dict[str, int], name: str) -> Callable[[int, Sequence[float]], bytes]:
    """Return a function that makes the messages of an output, each from its stamp and values.

    An array has a number in place of a stamp: the count of those before it, which is kept in `counts` under `name`.
    """
    if not layout.numbered:
        return layout.encode

    def encode(stamp: int, values: Sequence[float]) -> bytes:
        return layout.encode(next_number(counts, name), values)

    return encode


def next_number(counts: dict[str, int], name: str) -> int:
    """Count one more message of an output (see `Step.counts`); return the number of earlier ones."""
    counts[name] += 1
    return counts[name] - 1


def selection(source: Port, sink: Port) -> Pick | None:
    """Return which values of `source` are those of `sink` (see `fill.Fill`); None when all are, in their order.

    Parameters
    ----------
    source : Port
        Writes the messages.
    sink : Port
        Reads them.

    Raises
    ------
    Refused
        The two ports do not fit: another type, frame, channel set, or a field that the source does not fill.
    """
    if source.msgtype != sink.msgtype:
        raise Refused(f"type {source.msgtype}, expected {sink.msgtype}")
    if sink.frame_id and source.frame != sink.frame_id:
        raise Refused(f"frame_id {source.frame!r}, expected {sink.frame_id!r}")
    if source.dims != sink.dims:
        raise Refused(f"shape {dict(source.dims)}, expected {dict(sink.dims)}")
    if sink.partial:
        _check_partial(source.channels, sink)
    elif sorted(source.channels) != sorted(sink.channels):
        raise Refused(f"channels {list(source.channels)}, expected {list(sink.channels)}")
    missing = [f for f in sink.fields if f not in source.fields]
    if missing:
        raise Refused(f"fields {list(source.fields)} lack {missing[0]}")
    # Channels of a partial input that this source never sends keep the safe value.
    indices = tuple([source.places.get(x, safe) for x, safe in zip(sink.labels, sink.safe, strict=True)])
    return None if indices == tuple(range(source.size)) else indices


def readable_stamp(data: bytes) -> int | None:
    """Return the stamp (ns) at the beginning of a rejected message; None if it cannot be read.

    Parameters
    ----------
    data : bytes
        Little-endian CDR of a message that begins with a stamp or a header.
    """
    if len(data) < 12 or data[1] != 1:
        return None
    return int.from_bytes(data[4:8], "little", signed=True) * SECOND + int.from_bytes(data[8:12], "little")
