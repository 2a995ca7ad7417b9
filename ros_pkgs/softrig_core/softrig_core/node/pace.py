"""What a lockstep node paces itself by beside its inputs: /clock, and what other nodes say of their ticks."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from ..model.port import CLOCK, Port, Refused
from ..rig.options import InputLink
from ..wire.codec import Decoder
from .endpoint import Input
from .middleware import Direct, Message, Receive
from .pairing import KEEP, Pairing
from .tick import TICK, TickReader

if TYPE_CHECKING:
    from .arrivals import Arrivals
    from .lockstep import Lockstep


def _pairing(arrivals: Arrivals, port: Port, link: InputLink, earlier: bool = False) -> Pairing:
    pairing = Pairing(port.topic, arrivals.node.peer(link), link.node, Input(port), carries=False, earlier=earlier)
    arrivals.pairings.append(pairing)
    return pairing


def follow_ticks(arrivals: Arrivals) -> None:
    """Read the acknowledgements of nodes that we wait for, that may be silent, or that may end the run."""
    node = arrivals.node
    links = node.links
    silent: dict[str, list[Pairing]] = {}
    for pairing in arrivals.pairings:
        if pairing.port:
            silent.setdefault(pairing.sender, []).append(pairing)
    schedules = {p.sender: p.schedule for group in silent.values() for p in group}
    for peer in dict.fromkeys([*links.acks, *silent]):
        if peer == node.middleware.name:
            continue
        topic = f"{node.namespace}/{peer}/tick"
        port = Port("stamp", topic, TICK)
        paced = []
        if peer in links.acks:
            link = InputLink(period=links.acks[peer], node=peer)
            paced.append(_pairing(arrivals, port, link, earlier=not links.owns_clock))
        item = paced[0].item if paced else Input(port)
        for pairing in paced:
            pairing.item = item
        if not paced:  # only to be matched before the start
            watched = Pairing(topic, schedules[peer], peer, item, carries=False)
            watched.want, watched.have = -1, True
            arrivals.unpaced.append(watched)
        _listen(node, item, _tick_receiver(arrivals, item, paced, silent.get(peer, [])))


def _tick_receiver(
    arrivals: Arrivals, item: Input, paced: list[Pairing], silent: list[Pairing]
) -> Callable[[bytes], None]:
    node = arrivals.node
    read = TickReader()

    def receive(data: bytes) -> None:
        item.heard = True
        try:
            stamp, sent = read(data)
        except Refused as error:
            node.refuse(item, str(error))
            return
        arrivals.heard += 1
        for pairing in silent:
            if pairing.port not in sent:
                if pairing.may_come(stamp):
                    arrivals.heard_at(pairing, stamp, KEEP)
            elif pairing.item.port.delayed or not pairing.item.port.stamped:
                pairing.announced.append(stamp)
                pairing.serve()
        for pairing in paced:
            _reached(arrivals, pairing, stamp)
        if node.over and node.state == "running":
            node.leave()

    return receive


def follow_clock(arrivals: Arrivals, link: InputLink) -> None:
    """Follow /clock."""
    node = arrivals.node
    pairing = _pairing(arrivals, CLOCK, link)
    item, decode = pairing.item, Decoder(CLOCK)

    def receive(data: bytes) -> None:
        item.heard = True
        try:
            stamp, _ = decode(data)
        except Refused as error:
            node.refuse(item, str(error))
            return
        arrivals.heard += 1
        _reached(arrivals, pairing, stamp)

    def receive_numbers(message: Message) -> None:
        item.heard = True
        arrivals.heard += 1
        _reached(arrivals, pairing, message[0])

    _listen(node, item, receive, lambda layout, greatest: receive_numbers)


def _listen(node: Lockstep, item: Input, receive: Receive, direct: Direct | None = None) -> None:
    node.paces.append(item)
    node.middleware.listen(item.port.topic, item.port.msgtype, receive, direct, item.matched)


def _reached(arrivals: Arrivals, pairing: Pairing, stamp: int) -> None:
    """A clock or an acknowledgement: its sender has come to a tick of its own."""
    if stamp == pairing.want and not pairing.have:
        pairing.used = pairing.reached = stamp
        arrivals.arrived(pairing)
    elif stamp == pairing.schedule.next(pairing.reached):
        pairing.reached = stamp
