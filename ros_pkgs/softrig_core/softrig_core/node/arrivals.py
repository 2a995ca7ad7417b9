"""What has come from whom, and what the tick under way of a lockstep node still lacks."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from ..model.port import Refused, Sample
from ..model.schedule import Schedule
from .endpoint import Input
from .middleware import Direct, Receive
from .paired import paired
from .pairing import BAD, KEEP, Pairing

if TYPE_CHECKING:
    from .lockstep import Lockstep


class Arrivals:
    """Puts messages into the values of a lockstep node at the tick that they belong to, and has it step.

    Parameters
    ----------
    node : Lockstep

    Attributes
    ----------
    pairings : list of Pairing
        What a tick waits for.
    unpaced : list of Pairing
        To be matched before the start, but not waited for.
    missing : int
        Number of pairings that the tick under way still lacks.
    heard : int
        Messages that are no step of ours: a peer is alive.
    """

    def __init__(self, node: Lockstep) -> None:
        self.node = node
        self.pairings: list[Pairing] = []
        self.unpaced: list[Pairing] = []
        self.missing = 0
        self.heard = 0
        self._came: dict[str, int] = {}  # tick at which a held input came last
        self._by_port: dict[str, Pairing] = {}

    def input(self, item: Input) -> tuple[Receive, Direct | None]:
        """Paired inputs wait for their stamp; other held inputs take the newest value."""
        node = self.node
        link = node.links.inputs.get(item.name)
        node.values[item.name] = item.port.initial
        by_itself = link is None and (item.port.held or item.port.sporadic) and item.name not in node.options.paired
        if by_itself or item.name in node.links.free:
            return self._held(item), None
        pairing = (
            Pairing(item.port.topic, node.peer(link), link.node, item, port=link.port if link.sporadic else "")
            if link else Pairing(item.port.topic, Schedule(node.schedule.period), "another node", item)
        )  # fmt: skip
        pairing.same = pairing.schedule.period == node.schedule.period
        self._by_port[item.name] = pairing
        self.pairings.append(pairing)
        return paired(self, pairing, item)

    def _held(self, item: Input) -> Callable[[bytes], None]:
        node = self.node

        def receive(data: bytes) -> None:
            try:
                stamp, values = item.decode(data)
            except Refused as error:
                node.refuse(item, str(error))
                node.bad = True
                return
            if not (item.port.stamped or node.in_order(item, stamp)):
                return
            if item.port.partial:
                item.decode.kept = values
            node.values[item.name] = Sample(stamp, values) if item.port.delayed else values
            self._came[item.name] = node.t
            if node.sink is not None and item.name in node.foreign:
                node.sink.add(node.foreign[item.name], node.t, data)

        return receive

    def heard_at(self, pairing: Pairing, position: int, found: Any) -> None:
        """Keep what a sender has said at one of its ticks, and use it if that completes what ours needs."""
        pairing.put(position, found)
        if not pairing.have and pairing.complete():
            self._use(pairing)
            self.arrived(pairing)

    def _use(self, pairing: Pairing) -> None:
        """Take the newest of what a sender has said up to the awaited tick."""
        node = self.node
        found = pairing.take()
        if found is BAD:
            node.bad = True
        elif found is not KEEP and pairing.carries:
            name = pairing.item.name
            node.values[name], data = found
            if node.sink is not None and name in node.foreign:
                node.sink.add(node.foreign[name], node.t, data)

    def age(self, name: str) -> int | None:
        """Age of an input at the tick under way."""
        node = self.node
        value = node.values[name]
        pairing = self._by_port.get(name)
        if isinstance(value, Sample):
            return node.t - value.stamp
        if pairing is None:
            return node.t - self._came[name] if name in self._came else None
        return None if pairing.stamp is None else node.t - pairing.stamp

    def await_tick(self, t: int) -> None:
        """Set what tick `t` needs."""
        missing = 0
        for pairing in self.pairings:
            if t < pairing.holds:
                continue  # a slower sender: its last message still holds
            want = t if pairing.same and t <= pairing.until else self._wanted(pairing, t)
            if want == pairing.want and (t or pairing.earlier):
                continue  # at the end time: what came at the last tick is held
            pairing.want = want
            pairing.have = False
            if want > pairing.used and want > pairing.reached and not pairing.said:  # nearly always; see `complete`
                missing += 1
            elif pairing.complete():
                self._use(pairing)
            else:
                missing += 1
        self.missing = missing

    def _wanted(self, pairing: Pairing, t: int) -> int:
        """Give the stamp that tick `t` needs of a sender."""
        if pairing.earlier:
            return pairing.schedule.before(self.node.schedule.next(t) if self.node.is_plant else t)
        want = pairing.schedule.awaited(t)
        pairing.holds = pairing.schedule.next(t)
        return want

    def arrived(self, pairing: Pairing) -> None:
        """The tick under way lacks one less; step when that was the last one."""
        pairing.have = True
        self.missing -= 1
        if not self.missing and self.node.ready:
            self.node.step()
