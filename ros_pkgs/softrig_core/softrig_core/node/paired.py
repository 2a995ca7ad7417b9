"""An input that is paired with the ticks of its sender: by the stamps of its messages, or by their order."""

from __future__ import annotations

from ..model.codec import readable_stamp
from ..model.port import Refused, Sample
from ..timebase import SECOND
from .adapter import Adapter
from .arrivals import Arrivals
from .endpoint import Input
from .middleware import Receive
from .pairing import BAD, Pairing


def paired(arrivals: Arrivals, pairing: Pairing, item: Input) -> Receive:
    """Give what takes the messages of an input.

    Parameters
    ----------
    arrivals : Arrivals
    pairing : Pairing
        What the input's sender has said; gets its `serve`.
    item : Input
    """
    node, step = arrivals.node, arrivals.step
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

    def accept(stamp: int, values: tuple[float, ...], position: int, data: bytes) -> None:
        if position == pairing.want and not pairing.have and not pairing.said and not pairing.port:
            if record is not None and node.sink is not None:
                node.sink.add(record, node.t, data)
            if item.port.partial:
                decode.kept = values
            step.values[name] = Sample(stamp, values) if delayed else values
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

    pairing.serve = serve
    return receive_by_order if by_order else receive


def _in_turn(node: Adapter, pairing: Pairing, number: int) -> bool:
    """Whether an array is the next one; one that is repeated is refused, one that is missing ends the run."""
    expected = pairing.received
    if number in (-1, expected):
        return True
    if number > expected:
        lost = f"{number - expected} lost"
        node.fail(f"{pairing.topic}: number {number} from {pairing.sender}, expected {expected} ({lost})")
    elif number or not node.links.guests:  # else it is said again for somebody else
        node.repeated(pairing.item, number, expected)
    return False
