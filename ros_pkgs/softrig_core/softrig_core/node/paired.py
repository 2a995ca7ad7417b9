"""An input that is paired with the ticks of its sender: by the stamps of its messages, or by their order."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..model.port import Refused, Sample
from ..model.timebase import SECOND
from ..wire.cdr import Layout
from ..wire.codec import readable_stamp
from .adapter import repeated
from .endpoint import Input
from .middleware import Direct, Message, Receive, Send
from .pairing import BAD, Pairing

if TYPE_CHECKING:
    from .arrivals import Arrivals
    from .lockstep import Lockstep


def paired(arrivals: Arrivals, pairing: Pairing, item: Input) -> tuple[Receive, Direct | None]:
    """Give what takes the messages of an input, as bytes and if it can as numbers.

    Parameters
    ----------
    arrivals : Arrivals
    pairing : Pairing
        What the input's sender has said; gets its `serve`.
    item : Input
    """
    node = arrivals.node
    name, decode, delayed = item.name, item.decode, item.port.delayed
    # stamps that are acquisition times, and messages without one, are paired by counting
    by_order = delayed or not item.port.stamped
    record = node.foreign.get(name)
    schedule = pairing.schedule

    def receive(data: bytes) -> None:
        if node.state in ("done", "failed"):
            return
        item.heard = True
        try:
            stamp, values = decode(data)
        except Refused as error:
            node.refuse(item, str(error))
            if not node.is_plant:
                found = readable_stamp(data)
                spoilt(-1 if found is None else found)
            return
        accept(stamp, values, stamp, data)

    def receive_by_order(data: bytes) -> None:
        if node.state in ("done", "failed"):
            return
        item.heard = True
        values: tuple[float, ...] | None = None
        try:
            stamp, values = decode(data)
        except Refused as error:
            node.refuse(item, str(error))
            if node.is_plant:
                return
            stamp = decode.number(data)
        if not (item.port.stamped or _in_turn(node, pairing, stamp)):
            return
        pairing.queue.append((stamp, values, data))
        if not pairing.port:
            pairing.announced.append(schedule.time(pairing.received))
        pairing.received += 1
        serve()

    def serve() -> None:
        """Bring together messages that have come and the ticks at which their sender says it has spoken."""
        while pairing.queue and pairing.announced:
            (stamp, values, data), position = pairing.queue.popleft(), pairing.announced.popleft()
            if values is None:
                spoilt(position)
            else:
                accept(stamp, values, position, data)

    def spoilt(position: int) -> None:
        """A controller answers a tick with a bad measurement too; a plant waits for a good command."""
        if pairing.may_come(position):
            pairing.excused = position
            arrivals.heard_at(pairing, position, BAD)

    def accept(stamp: int, values: tuple[float, ...], position: int, data: bytes = b"") -> None:
        if position == pairing.want and not pairing.have and not pairing.said and not pairing.port:
            if record is not None and node.sink is not None:
                node.sink.add(record, node.t, data)
            if item.port.partial:
                decode.kept = values
            node.values[name] = Sample(stamp, values) if delayed else values
            pairing.stamp = pairing.used = position
            arrivals.arrived(pairing)
        elif pairing.may_come(position):
            if item.port.partial:
                decode.kept = values
            arrivals.heard += 1
            arrivals.heard_at(pairing, position, (Sample(stamp, values) if delayed else values, data))
        elif position == pairing.excused:
            return  # a better one is too late
        elif position == 0 and node.links.guests:
            return  # said again for somebody else
        else:
            got, want = position / SECOND, pairing.want / SECOND
            twice = " (already there)" if pairing.have else ""
            node.refuse(item, f"stamp {got:.9g} s from {pairing.sender}, expected {want:.9g} s{twice}")

    def direct(layout: Layout, greatest: float) -> Send | None:
        if greatest > decode.bound or by_order or pairing.port or item.port.partial or record is not None:
            return None
        try:
            pick = decode.pick(layout)
        except Refused:  # each message will be, with its reason
            return None
        due, inputs = schedule.due, node.values

        def receive_numbers(message: Message) -> None:
            stamp, values = message
            if pick is not None:
                values = pick(values)
            item.heard = True
            if stamp == pairing.want and not pairing.have and not pairing.said:
                inputs[name] = values
                pairing.stamp = pairing.used = stamp
                pairing.have = True
                arrivals.missing -= 1
                if not arrivals.missing and node.ready:
                    node.step()
            elif pairing.used < stamp < pairing.want and stamp not in pairing.said and due(stamp):
                arrivals.heard += 1  # of a faster sender only the newest may serve, when the run ends before its time
                pairing.said = {stamp: (values, b"")}
            elif node.state not in ("done", "failed"):
                accept(stamp, values, stamp)

        return receive_numbers

    pairing.serve = serve
    return (receive_by_order if by_order else receive), direct


def _in_turn(node: Lockstep, pairing: Pairing, number: int) -> bool:
    """Whether an array is the next one; one that is repeated is refused, one that is missing ends the run."""
    expected = pairing.received
    if number in (-1, expected):
        return True
    if number > expected:
        lost = f"{number - expected} lost"
        node.fail(f"{pairing.topic}: number {number} from {pairing.sender}, expected {expected} ({lost})")
    elif number or not node.links.guests:  # else it is said again for somebody else
        node.refuse(pairing.item, repeated(number, pairing.sender, expected))
    return False
