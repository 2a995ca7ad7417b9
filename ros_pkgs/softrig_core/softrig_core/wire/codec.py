"""Codecs of ports: message bytes to tuples of float64, and how the values of one port become those of another."""

from __future__ import annotations

from ..model.port import Port, Refused
from .cdr import NAMED, CdrError, Message, Pick, getter, parse


class Decoder:
    """Reads the values of an input port from message bytes of any layout, fast for the last layout seen."""

    def __init__(self, port: Port) -> None:
        self._port = port
        self._layout = port.layout()
        self._pick: Pick | None = None

    def __call__(self, data: bytes) -> tuple[int, tuple[float, ...]]:
        """Give (stamp in ns, values).

        Raises
        ------
        Refused
            Malformed bytes, missing or unknown channels, wrong length, wrong frame, NaN or infinity.
        """
        found = self._layout.decode(data)
        if found is None:
            self._learn(data)
            found = self._layout.decode(data)
            if found is None:  # padding or endianness that no prepared layout has
                return self._slow(data)
        stamp, values = found
        if self._pick is not None:
            values = self._pick(values)
        total = sum(values)
        if total - total != 0.0:  # NaN or infinity somewhere, or a sum beyond the range of float64
            self._check_finite(values)
        return stamp, values

    def _check_finite(self, values: tuple[float, ...]) -> None:
        for label, value in zip(self._port.labels, values, strict=True):
            if value - value != 0.0:
                raise Refused(f"{label} is {value}, expected a finite number")

    def _learn(self, data: bytes) -> None:
        """Adopt the layout of `data` if it carries what the port needs."""
        message = self._parse(data)
        order = self._order(message)  # first: a layout that is refused must not be known the next time
        self._layout = message.layout(self._port.msgtype)
        self._pick = None if order == tuple(range(self._layout.size)) else getter(order)

    def _slow(self, data: bytes) -> tuple[int, tuple[float, ...]]:
        message = self._parse(data)
        flat = [float(x) for values in message.fields.values() for x in values]
        values = tuple(flat[i] for i in self._order(message))
        self._check_finite(values)
        return message.stamp or 0, values

    def _parse(self, data: bytes) -> Message:
        try:
            return parse(self._port.msgtype, data)
        except CdrError as error:
            raise Refused(str(error)) from None

    def _order(self, message: Message) -> tuple[int, ...]:
        """Where each value of the port stands among all numbers of the message."""
        port = self._port
        if port.frame_id and message.frame_id != port.frame_id:
            raise Refused(f"frame_id {message.frame_id!r}, expected {port.frame_id!r}")
        if (message.dims or ()) != port.dims:
            raise Refused(f"shape {dict(message.dims or ())}, expected {dict(port.dims)}")
        named = port.msgtype in NAMED
        if named and sorted(message.names) != sorted(port.channels):
            raise Refused(f"names {list(message.names)}, expected {list(port.channels)}")
        order: list[int] = []
        start = dict.fromkeys(message.fields, 0)
        at = 0
        for name, values in message.fields.items():
            start[name] = at
            at += len(values)
        for name in port.fields:
            n = len(message.fields[name])
            if named and n != len(port.channels):
                raise Refused(f"{name} has {n} values, expected {len(port.channels)} ({', '.join(port.channels)})")
            places = [message.names.index(c) for c in port.channels] if named else range(n)
            order += [start[name] + i for i in places]
        return tuple(order)


def selection(source: Port, sink: Port) -> Pick | None:
    """Say how the values of `source` become those of `sink`; None when they are the same.

    Raises
    ------
    Refused
        The two ports do not fit: another type, frame, channel set, or a field that the source does not fill.
    """
    if source.msgtype != sink.msgtype:
        raise Refused(f"type {source.msgtype}, expected {sink.msgtype}")
    if sink.frame_id and source.frame_id != sink.frame_id:
        raise Refused(f"frame_id {source.frame_id!r}, expected {sink.frame_id!r}")
    if source.dims != sink.dims:
        raise Refused(f"shape {dict(source.dims)}, expected {dict(sink.dims)}")
    if sorted(source.channels) != sorted(sink.channels):
        raise Refused(f"channels {list(source.channels)}, expected {list(sink.channels)}")
    missing = [f for f in sink.fields if f not in source.fields]
    if missing:
        raise Refused(f"fields {list(source.fields)} lack {missing[0]}")
    order = tuple(source.labels.index(label) for label in sink.labels)
    return None if order == tuple(range(source.size)) else getter(order)
