"""What a lockstep node paces itself by beside its inputs: /clock, and what other nodes say of their ticks."""

from __future__ import annotations

from collections.abc import Callable, Set

from ..model.codec import Decoder
from ..model.port import CLOCK, Port, Refused
from ..rig.options import InputLink
from .arrivals import Arrivals
from .endpoint import Input
from .middleware import Receive
from .pairing import KEEP, Pairing
from .tick import TICK, TickReader


def _pairing(arrivals: Arrivals, port: Port, link: InputLink, earlier: bool = False) -> Pairing:
    pairing = Pairing(port.topic, arrivals.node.peer(link), link.node, Input(port), carries=False, earlier=earlier)
    arrivals.pairings.append(pairing)
    return pairing


def follow_ticks(arrivals: Arrivals, local: Set[str], heard: Callable[[], object]) -> None:
    """Read the acknowledgements of nodes of other processes that we wait for or that may be silent.

    Parameters
    ----------
    arrivals : Arrivals
    local : set of str
        Nodes of this process.
    heard : callable
        Called after each.
    """
    node = arrivals.node
    links = node.links
    silent: dict[str, list[Pairing]] = {}
    for pairing in arrivals.pairings:
        if pairing.port:
            silent.setdefault(pairing.sender, []).append(pairing)
    for peer in dict.fromkeys([*links.acks, *silent]):
        if peer in local:
            continue
        topic = f"{node.namespace}/{peer}/tick"
        port = Port("stamp", topic, TICK)
        if peer in links.acks:
            link = InputLink(period=links.acks[peer], node=peer)
            paced = _pairing(arrivals, port, link, earlier=not links.owns_clock)
            item = paced.item
        else:  # only to be matched before the start
            paced, item = None, Input(port)
            watched = Pairing(topic, silent[peer][0].schedule, peer, item, carries=False)
            watched.want, watched.have = -1, True
            arrivals.unpaced.append(watched)
        _listen(arrivals, item, _tick_receiver(arrivals, item, paced, silent.get(peer, []), heard))


def _tick_receiver(
    arrivals: Arrivals, item: Input, paced: Pairing | None, silent: list[Pairing], heard: Callable[[], object]
) -> Receive:
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
        if paced is not None:
            arrivals.reached(paced, stamp)
        heard()

    return receive


def follow_clock(arrivals: Arrivals, link: InputLink) -> None:
    """Follow /clock."""
    pairing = _pairing(arrivals, CLOCK, link)
    item, decode = pairing.item, Decoder(CLOCK)

    def receive(data: bytes) -> None:
        item.heard = True
        try:
            stamp, _ = decode(data)
        except Refused as error:
            arrivals.node.refuse(item, str(error))
            return
        arrivals.heard += 1
        arrivals.reached(pairing, stamp)

    _listen(arrivals, item, receive)


def _listen(arrivals: Arrivals, item: Input, receive: Receive) -> None:
    arrivals.node.paces.append(item)
    arrivals.node.middleware.subscribe(item.port.topic, item.port.msgtype, receive, item.matched)
