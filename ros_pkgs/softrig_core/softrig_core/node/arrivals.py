"""What has come from whom, and what the tick under way of a lockstep node still lacks."""

from __future__ import annotations

from collections.abc import Callable, Set

from ..model.port import Refused, Sample
from ..model.schedule import Schedule
from .adapter import Adapter
from .endpoint import Input
from .middleware import Receive
from .pairing import BAD, KEEP, Pairing


class Arrivals:
    """Puts messages into the values of a step at the tick that they belong to.

    Parameters
    ----------
    node : Adapter
    turn : callable
        Has the ticks go on; called when the tick under way lacks nothing any more.

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

    def __init__(self, node: Adapter, turn: Callable[[], object]) -> None:
        self.node = node
        self.step = node.step
        self.turn = turn
        self.pairings: list[Pairing] = []
        self.unpaced: list[Pairing] = []
        self.missing = 0
        self.heard = 0

    def pairing(self, item: Input) -> Pairing | None:
        """Give the pairing of an input; None for one that takes the newest value."""
        node, name = self.node, item.name
        link = node.links.inputs.get(name)
        by_itself = link is None and (item.port.held or item.port.sporadic) and name not in node.options.paired
        if by_itself or name in node.links.free:
            return None
        pairing = (
            Pairing(item.port.topic, node.peer(link), link.node, item, port=link.port if link.sporadic else "")
            if link else Pairing(item.port.topic, Schedule(node.schedule.period), "another node", item)
        )  # fmt: skip
        pairing.same = pairing.schedule.period == node.schedule.period
        self.step.stamps[name] = lambda: pairing.stamp
        self.pairings.append(pairing)
        return pairing

    def held(self, item: Input) -> Receive:
        """Give what takes the messages of an input whose newest value counts."""
        node, step = self.node, self.step
        came: list[int | None] = [None]
        step.stamps[item.name] = lambda: came[0]

        def receive(data: bytes) -> None:
            try:
                stamp, values = item.decode(data)
            except Refused as error:
                node.refuse(item, str(error))
                step.bad = True
                return
            if not (item.port.stamped or node.in_order(item, stamp)):
                return
            if item.port.partial:
                item.decode.kept = values
            step.values[item.name] = Sample(stamp, values) if item.port.delayed else values
            came[0] = node.t
            if node.sink is not None and item.name in node.foreign:
                node.sink.add(node.foreign[item.name], node.t, data)

        return receive

    def without(self, local: Set[str]) -> None:
        """Wait for nobody who is in the same process: the runner's order sees to that."""
        self.pairings = [p for p in self.pairings if p.sender not in local and not p.item.local]

    def heard_at(self, pairing: Pairing, position: int, found: object) -> None:
        """Keep what a sender has said at one of its ticks, and use it if that completes what ours needs."""
        pairing.put(position, found)
        if not pairing.have and pairing.complete():
            self._use(pairing)
            self.arrived(pairing)

    def reached(self, pairing: Pairing, stamp: int) -> None:
        """A clock or an acknowledgement: its sender has come to a tick of its own."""
        if stamp == pairing.want and not pairing.have:
            pairing.used = pairing.reached = stamp
            self.arrived(pairing)
        elif stamp == pairing.schedule.next(pairing.reached):
            pairing.reached = stamp

    def arrived(self, pairing: Pairing) -> None:
        """The tick under way lacks one less; go on when that was the last one."""
        pairing.have = True
        self.missing -= 1
        if not self.missing:
            self.turn()

    def _use(self, pairing: Pairing) -> None:
        """Take the newest of what a sender has said up to the awaited tick."""
        node = self.node
        found = pairing.take()
        if found is BAD:
            self.step.bad = True
        elif found is not KEEP and pairing.carries:
            name = pairing.item.name
            self.step.values[name], data = found
            if node.sink is not None and name in node.foreign:
                node.sink.add(node.foreign[name], node.t, data)

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
                pairing.have = True
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
