"""What has come from whom: a lockstep node's inputs, clock and acknowledgements, and what its tick still lacks."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from ..model.port import CLOCK, Port, Refused, Sample
from ..model.schedule import Schedule
from ..model.timebase import SECOND
from ..rig.options import InputLink
from ..wire.cdr import Layout
from ..wire.codec import Decoder
from .adapter import repeated
from .endpoint import Input
from .middleware import Direct, Message, Receive, Send
from .pairing import BAD, KEEP, Counted, Pairing
from .tick import END, TICK, TickReader

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
        self._node = node
        self.pairings: list[Pairing] = []
        self.unpaced: list[Pairing] = []
        self.missing = 0
        self.heard = 0
        self._takes: dict[str, Callable[[Counted, int], None]] = {}
        self._came: dict[str, int] = {}  # tick at which a held input came last
        self._by_port: dict[str, Pairing] = {}

    def input(self, item: Input) -> tuple[Receive, Direct | None]:
        """Paired inputs wait for their stamp; other held inputs take the newest value."""
        node = self._node
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
        return self._paired(pairing, item)

    def _held(self, item: Input) -> Callable[[bytes], None]:
        node = self._node

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

    def _paired(self, pairing: Pairing, item: Input) -> tuple[Receive, Direct | None]:
        node = self._node
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
                    spoilt(_stamp(data))
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
            if not (item.port.stamped or self._in_turn(pairing, stamp)):
                return
            pairing.queue.append((stamp, values, data))
            if not pairing.port:
                pairing.announced.append(schedule.time(pairing.received))
            pairing.received += 1
            self._serve(pairing, take)

        def take(message: Counted, position: int) -> None:
            stamp, values, data = message
            if values is None:
                spoilt(position)
            else:
                accept(stamp, values, position, data)

        def spoilt(position: int) -> None:
            """A controller answers a tick with a bad measurement too; a plant waits for a good command."""
            if pairing.may_come(position):
                pairing.excused = position
                self._heard_at(pairing, position, BAD)

        def accept(stamp: int, values: tuple[float, ...], position: int, data: bytes = b"") -> None:
            if position == pairing.want and not pairing.have and not pairing.said and not pairing.port:
                if record is not None and node.sink is not None:
                    node.sink.add(record, node.t, data)
                if item.port.partial:
                    decode.kept = values
                node.values[name] = Sample(stamp, values) if delayed else values
                pairing.stamp = pairing.used = position
                self._arrived(pairing)
            elif pairing.may_come(position):
                if item.port.partial:
                    decode.kept = values
                self.heard += 1
                self._heard_at(pairing, position, (Sample(stamp, values) if delayed else values, data))
            elif position == pairing.excused or (node.cut and position > (schedule.last or 0)):
                return  # a better one is too late, and after the end its sender did not know of it yet
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
                    self.missing -= 1
                    if not self.missing and node.ready:
                        node.step()
                elif pairing.used < stamp < pairing.want and stamp not in pairing.said and due(stamp):
                    self.heard += 1  # of a faster sender only the newest may serve, when the run ends before its time
                    pairing.said = {stamp: (values, b"")}
                elif node.state not in ("done", "failed"):
                    accept(stamp, values, stamp)

            return receive_numbers

        self._takes[name] = take
        return (receive_by_order if by_order else receive), direct

    def _in_turn(self, pairing: Pairing, number: int) -> bool:
        """Whether an array is the next one; one that is repeated is refused, one that is missing ends the run."""
        node, expected = self._node, pairing.received
        if number in (-1, expected):
            return True
        if number > expected:
            lost = f"{number - expected} lost"
            node.fail(f"{pairing.topic}: number {number} from {pairing.sender}, expected {expected} ({lost})")
        elif number or not node.links.guests:  # else it is said again for somebody else
            node.refuse(pairing.item, repeated(number, pairing.sender, expected))
        return False

    def _serve(self, pairing: Pairing, take: Callable[[Counted, int], None]) -> None:
        """Bring together messages without a stamp and the ticks at which their sender says it has spoken."""
        while pairing.queue and pairing.announced:
            take(pairing.queue.popleft(), pairing.announced.popleft())

    def _heard_at(self, pairing: Pairing, position: int, found: Any) -> None:
        """Keep what a sender has said at one of its ticks, and use it if that completes what ours needs."""
        pairing.put(position, found)
        if not pairing.have and pairing.complete():
            self._use(pairing)
            self._arrived(pairing)

    def _use(self, pairing: Pairing) -> None:
        """Take the newest of what a sender has said up to the awaited tick."""
        node = self._node
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
        node = self._node
        value = node.values[name]
        pairing = self._by_port.get(name)
        if isinstance(value, Sample):
            return node.t - value.stamp
        if pairing is None:
            return node.t - self._came[name] if name in self._came else None
        return None if pairing.stamp is None else node.t - pairing.stamp

    def _pace_pairing(self, port: Port, link: InputLink, earlier: bool = False) -> Pairing:
        pairing = Pairing(port.topic, self._node.peer(link), link.node, Input(port), carries=False, earlier=earlier)
        self.pairings.append(pairing)
        return pairing

    def follow_ticks(self) -> None:
        """Read the acknowledgements of nodes that we wait for, that may be silent, or that may end the run."""
        node = self._node
        links = node.links
        silent: dict[str, list[Pairing]] = {}
        for pairing in self.pairings:
            if pairing.port:
                silent.setdefault(pairing.sender, []).append(pairing)
        schedules = {p.sender: p.schedule for group in silent.values() for p in group}
        for peer in dict.fromkeys([*links.acks, *links.enders, *silent]):
            if peer == node.middleware.name:
                continue
            topic = f"{node.namespace}/{peer}/tick"
            port = Port("stamp", topic, TICK)
            paced = []
            if peer in links.acks:
                link = InputLink(period=links.acks[peer], node=peer)
                paced.append(self._pace_pairing(port, link, earlier=not links.owns_clock))
            if peer in links.enders:
                link = InputLink(period=links.enders[peer], node=peer)
                paced.append(self._pace_pairing(port, link, earlier=True))
            item = paced[0].item if paced else Input(port)
            for pairing in paced:
                pairing.item = item
            if not paced:  # only to be matched before the start
                watched = Pairing(topic, schedules[peer], peer, item, carries=False)
                watched.want, watched.have = -1, True
                self.unpaced.append(watched)
            self._listen(item, self._tick_receiver(item, paced, silent.get(peer, [])))

    def _tick_receiver(self, item: Input, paced: list[Pairing], silent: list[Pairing]) -> Callable[[bytes], None]:
        node = self._node
        read = TickReader()

        def receive(data: bytes) -> None:
            item.heard = True
            try:
                stamp, sent = read(data)
            except Refused as error:
                node.refuse(item, str(error))
                return
            self.heard += 1
            if END in sent:
                node.end_after(stamp)
            for pairing in silent:
                if pairing.port not in sent:
                    if pairing.may_come(stamp):
                        self._heard_at(pairing, stamp, KEEP)
                elif pairing.item.port.delayed or not pairing.item.port.stamped:
                    pairing.announced.append(stamp)
                    self._serve(pairing, self._takes[pairing.item.name])
            for pairing in paced:
                self._reached(pairing, stamp)
            if node.over and node.state == "running":
                node.leave()

        return receive

    def follow_clock(self, link: InputLink) -> None:
        """Follow /clock."""
        node = self._node
        pairing = self._pace_pairing(CLOCK, link)
        item, decode = pairing.item, Decoder(CLOCK)

        def receive(data: bytes) -> None:
            item.heard = True
            try:
                stamp, _ = decode(data)
            except Refused as error:
                node.refuse(item, str(error))
                return
            self.heard += 1
            self._reached(pairing, stamp)

        def receive_numbers(message: Message) -> None:
            item.heard = True
            self.heard += 1
            self._reached(pairing, message[0])

        self._listen(item, receive, lambda layout, greatest: receive_numbers)

    def _listen(self, item: Input, receive: Receive, direct: Direct | None = None) -> None:
        node = self._node
        node.paces.append(item)
        node.middleware.listen(item.port.topic, item.port.msgtype, receive, direct, item.matched)

    def _reached(self, pairing: Pairing, stamp: int) -> None:
        """A clock or an acknowledgement: its sender has come to a tick of its own."""
        if stamp == pairing.want and not pairing.have:
            pairing.used = pairing.reached = stamp
            self._arrived(pairing)
        elif stamp == pairing.schedule.next(pairing.reached):
            pairing.reached = stamp

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
            return pairing.schedule.before(self._node.schedule.next(t) if self._node.is_plant else t)
        want = pairing.schedule.awaited(t)
        pairing.holds = pairing.schedule.next(t)
        return want

    def _arrived(self, pairing: Pairing) -> None:
        pairing.have = True
        self.missing -= 1
        if not self.missing and self._node.ready:
            self._node.step()

    def stop(self, ticks: int) -> None:
        """The run ends at a tick of the clock: what senders would have said after it is not waited for."""
        for schedule in {p.schedule for p in self.pairings}:
            schedule.stop(ticks)
        for pairing in self.pairings:
            last = pairing.schedule.last
            pairing.until = pairing.until if last is None else last
            if pairing.earlier or last is None or pairing.want <= last:
                continue
            pairing.want = last  # we wait for what will never come: what its sender said last serves
            if not pairing.have and pairing.complete():
                self._use(pairing)
                self.missing -= 1


def _stamp(data: bytes) -> int:
    """The stamp of a refused message, as far as it can be read."""
    if len(data) < 12 or data[1] != 1:
        return -1
    return int.from_bytes(data[4:8], "little", signed=True) * SECOND + int.from_bytes(data[8:12], "little")
