"""Lockstep: a node answers tick k when everything stamped t_k has arrived, at any speed of the host.

Nothing here looks at a clock to decide a number; wall-clock time only ends a run that makes no progress.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import Any

from ..errors import RunError
from ..model.block import Block
from ..model.port import Port, Refused, Sample
from ..model.schedule import Schedule
from ..model.solver import Solver
from ..model.timebase import SECOND
from ..rig.options import InputLink, RunOptions
from ..wire.cdr import Layout
from ..wire.codec import Decoder
from ..wire.recording import Sink
from .adapter import CLOCK_LAYOUT, CLOCK_TOPIC, Adapter
from .endpoint import Input, Output
from .first import repeat_first
from .health import percentiles
from .middleware import Direct, Message, Middleware, Receive, Send
from .pairing import BAD, KEEP, Pairing
from .solving import Solving, hear_busy
from .start import CHECK, Handshake
from .tick import END, TICK, TickReader

CLOCK = Port("clock", CLOCK_TOPIC, CLOCK_LAYOUT.msgtype)
GONE_AFTER = 0.5  # s without the awaited message after its only sender has vanished


class Lockstep(Adapter):
    """A block driven tick by tick; see `Adapter` for the parameters."""

    def __init__(self, middleware: Middleware, block: Block, options: RunOptions, sink: Sink | None = None) -> None:
        self.pairings: list[Pairing] = []
        self.unpaced: list[Pairing] = []  # to be matched before the start, but not waited for
        self._takes: dict[str, Callable[[bytes, int], None]] = {}
        self.missing = 0
        self.ready = False
        self._tick = 0
        self._since = middleware.steady()
        self._heard = 0  # messages of faster peers between two ticks
        self._progress = (-1, 0)
        self._cut = False  # a block has ended the run before its duration
        self._over = False  # the last tick is answered
        self._rivals: Input | None = None
        self._came: dict[str, int] = {}  # tick at which a held input came last
        self._durations: deque[int] = deque(maxlen=100_000)
        self._sent = self._first = 0
        self.clock_output = Output(CLOCK, "/clock", -1)
        super().__init__(middleware, block, options, sink)
        if self.links.owns_clock:
            self.clock_output.send, _ = middleware.sender(CLOCK_TOPIC, CLOCK_LAYOUT, 0.0, self.clock_output.matched)
        if self.links.clock is not None:
            self._pace(self._pace_pairing(CLOCK, self.links.clock))
        if self.links.hears_clock:
            middleware.subscribe(CLOCK_TOPIC, CLOCK.msgtype, lambda data: None, lambda count: None)
        if self.links.guests:
            stamped = [o for o in self.outputs if o.port.stamped and not o.delayed]
            first = 0 if self.is_plant else 1
            repeat_first([*stamped, self.clock_output], lambda: self.state == "running" and self.ticks == first)
        self._follow_ticks()
        self._by_port = {p.item.name: p for p in self.pairings if p.carries}
        self._await(0)
        readers = self.links.readers
        wanted = [(o, list(readers.get(o.name, []))) for o in self.outputs]
        if self.links.owns_clock:
            wanted.append((self.clock_output, self.links.clock_readers))
        if self.links.acknowledges:
            wanted.append((self.tick_output, self.links.tick_readers))
        awaited = [(p.item, p.sender) for p in [*self.pairings, *self.unpaced]]
        busy = hear_busy(middleware, max(1, len(self.links.solvers)), self._patient)  # an outside node may be one, too
        awaited += [(busy, name) for name in self.links.solvers]
        self._handshake = Handshake(self, awaited, wanted)
        self._starter = middleware.timer(CHECK, self._start)
        self._solving = Solving(middleware, block, self._step) if isinstance(block, Solver) else None

    # peers -----------------------------------------------------------------------------------------------------

    def receiver(self, item: Input) -> tuple[Receive, Direct | None]:
        """Paired inputs wait for their stamp; other held inputs take the newest value."""
        link = self.links.inputs.get(item.name)
        self.values[item.name] = item.port.initial
        by_itself = link is None and (item.port.held or item.port.sporadic) and item.name not in self.options.paired
        if by_itself or item.name in self.links.free:
            return self._held(item), None
        pairing = (
            Pairing(item.port.topic, self.peer(link), link.node, item, port=link.port if link.sporadic else "")
            if link else Pairing(item.port.topic, Schedule(self.schedule.period), "another node", item)
        )  # fmt: skip
        pairing.same = pairing.schedule.period == self.schedule.period
        self.pairings.append(pairing)
        return self._paired(pairing, item)

    def _held(self, item: Input) -> Callable[[bytes], None]:
        def receive(data: bytes) -> None:
            try:
                stamp, values = item.decode(data)
            except Refused as error:
                self.refuse(item, str(error))
                self.bad = True
                return
            if item.port.partial:
                item.decode.kept = values
            self.values[item.name] = Sample(stamp, values) if item.port.delayed else values
            self._came[item.name] = self.t
            if self.sink is not None and item.name in self.foreign:
                self.sink.add(self.foreign[item.name], self.t, data)

        return receive

    def _paired(self, pairing: Pairing, item: Input) -> tuple[Receive, Direct | None]:
        name, decode, delayed = item.name, item.decode, item.port.delayed
        # stamps that are acquisition times, and messages without one, are paired by counting
        by_order = delayed or not item.port.stamped
        announced = by_order and pairing.port != ""
        record = self.foreign.get(name)
        schedule = pairing.schedule

        def receive_by_order(data: bytes) -> None:
            if announced:
                pairing.queue.append(data)
                self._serve(pairing, take)
            else:
                pairing.received += 1
                take(data, schedule.time(pairing.received - 1))

        def take(data: bytes, position: int = -1) -> None:
            if self.state in ("done", "failed"):
                return
            item.heard = True
            try:
                stamp, values = decode(data)
            except Refused as error:
                self.refuse(item, str(error))
                # A controller answers a tick with a bad measurement too; a plant waits for a good command.
                at = position if by_order else _stamp(data)
                if self.is_plant:
                    pairing.received -= by_order and not announced
                elif pairing.may_come(at):
                    pairing.excused = at
                    self._heard_at(pairing, at, BAD)
                return
            accept(stamp, values, position if by_order else stamp, data)

        def accept(stamp: int, values: tuple[float, ...], position: int, data: bytes = b"") -> None:
            if position == pairing.want and not pairing.have and not pairing.said and not pairing.port:
                if record is not None and self.sink is not None:
                    self.sink.add(record, self.t, data)
                if item.port.partial:
                    decode.kept = values
                self.values[name] = Sample(stamp, values) if delayed else values
                pairing.stamp = pairing.used = position
                self._arrived(pairing)
            elif pairing.may_come(position):
                if item.port.partial:
                    decode.kept = values
                self._heard += 1
                self._heard_at(pairing, position, (Sample(stamp, values) if delayed else values, data))
            elif position == pairing.excused or (self._cut and position > (schedule.last or 0)):
                return  # a better one is too late, and after the end its sender did not know of it yet
            elif position == 0 and self.links.guests:
                return  # said again for somebody else
            else:
                got, want = position / SECOND, pairing.want / SECOND
                twice = " (already there)" if pairing.have else ""
                self.refuse(item, f"stamp {got:.9g} s from {pairing.sender}, expected {want:.9g} s{twice}")

        def direct(layout: Layout, greatest: float) -> Send | None:
            if greatest > decode.bound or by_order or pairing.port or item.port.partial or record is not None:
                return None
            try:
                pick = decode.pick(layout)
            except Refused:  # each message will be, with its reason
                return None
            due, inputs = schedule.due, self.values

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
                    if not self.missing and self.ready:
                        self._step()
                elif pairing.used < stamp < pairing.want and stamp not in pairing.said and due(stamp):
                    self._heard += 1  # of a faster sender only the newest may serve, when the run ends before its time
                    pairing.said = {stamp: (values, b"")}
                elif self.state not in ("done", "failed"):
                    accept(stamp, values, stamp)

            return receive_numbers

        self._takes[name] = take
        return (receive_by_order if by_order else take), direct

    def _serve(self, pairing: Pairing, take: Callable[[bytes, int], None]) -> None:
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
        found = pairing.take()
        if found is BAD:
            self.bad = True
        elif found is not KEEP and pairing.carries:
            name = pairing.item.name
            self.values[name], data = found
            if self.sink is not None and name in self.foreign:
                self.sink.add(self.foreign[name], self.t, data)

    def now(self) -> int:
        """Time of the tick under way."""
        return self.t

    def age(self, name: str) -> int | None:
        """Age of an input at the tick under way."""
        value = self.values[name]
        pairing = self._by_port.get(name)
        if isinstance(value, Sample):
            return self.t - value.stamp
        if pairing is None:
            return self.t - self._came[name] if name in self._came else None
        return None if pairing.stamp is None else self.t - pairing.stamp

    def _pace_pairing(self, port: Port, link: InputLink, earlier: bool = False) -> Pairing:
        pairing = Pairing(port.topic, self.peer(link), link.node, Input(port), carries=False, earlier=earlier)
        self.pairings.append(pairing)
        return pairing

    def _follow_ticks(self) -> None:
        """Read the acknowledgements of nodes that we wait for, that may be silent, or that may end the run."""
        links = self.links
        silent: dict[str, list[Pairing]] = {}
        for pairing in self.pairings:
            if pairing.port:
                silent.setdefault(pairing.sender, []).append(pairing)
        schedules = {p.sender: p.schedule for group in silent.values() for p in group}
        for node in dict.fromkeys([*links.acks, *links.enders, *silent]):
            if node == self.middleware.name:
                continue
            topic = f"{self.namespace}/{node}/tick"
            port = Port("stamp", topic, TICK)
            paced = []
            if node in links.acks:
                link = InputLink(period=links.acks[node], node=node)
                paced.append(self._pace_pairing(port, link, earlier=not links.owns_clock))
            if node in links.enders:
                link = InputLink(period=links.enders[node], node=node)
                paced.append(self._pace_pairing(port, link, earlier=True))
            item = paced[0].item if paced else Input(port)
            for pairing in paced:
                pairing.item = item
            if not paced:  # only to be matched before the start
                watched = Pairing(topic, schedules[node], node, item, carries=False)
                watched.want, watched.have = -1, True
                self.unpaced.append(watched)
            self._listen(item, self._tick_receiver(item, paced, silent.get(node, [])))

    def _tick_receiver(self, item: Input, paced: list[Pairing], silent: list[Pairing]) -> Callable[[bytes], None]:
        read = TickReader()

        def receive(data: bytes) -> None:
            item.heard = True
            try:
                stamp, sent = read(data)
            except Refused as error:
                self.refuse(item, str(error))
                return
            self._heard += 1
            if END in sent:
                self._end_after(stamp)
            for pairing in silent:
                if pairing.port not in sent:
                    if pairing.may_come(stamp):
                        self._heard_at(pairing, stamp, KEEP)
                elif pairing.item.port.delayed or not pairing.item.port.stamped:
                    pairing.announced.append(stamp)
                    self._serve(pairing, self._takes[pairing.item.name])
            for pairing in paced:
                self._reached(pairing, stamp)
            if self._over and self.state == "running":
                self._leave()

        return receive

    def _pace(self, pairing: Pairing) -> None:
        """Follow /clock."""
        item, decode = pairing.item, Decoder(CLOCK)

        def receive(data: bytes) -> None:
            item.heard = True
            try:
                stamp, _ = decode(data)
            except Refused as error:
                self.refuse(item, str(error))
                return
            self._heard += 1
            self._reached(pairing, stamp)

        def receive_numbers(message: Message) -> None:
            item.heard = True
            self._heard += 1
            self._reached(pairing, message[0])

        self._listen(item, receive, lambda layout, greatest: receive_numbers)

    def _listen(self, item: Input, receive: Receive, direct: Direct | None = None) -> None:
        def matched(count: int) -> None:
            item.publishers = count

        self.paces.append(item)
        self.middleware.listen(item.port.topic, item.port.msgtype, receive, direct, matched)

    def _reached(self, pairing: Pairing, stamp: int) -> None:
        """A clock or an acknowledgement: its sender has come to a tick of its own."""
        if stamp == pairing.want and not pairing.have:
            pairing.used = pairing.reached = stamp
            self._arrived(pairing)
        elif stamp == pairing.schedule.next(pairing.reached):
            pairing.reached = stamp

    def on_matched(self, item: Input) -> None:
        """A second publisher on a paired topic makes the run ambiguous: it ends, naming both."""
        if item.publishers > 1 and self.state != "done" and any(p.item is item for p in self.pairings):
            self._rivals = item
            self.state = "failed"  # from here on no message counts; `progress` ends the run when the names are known

    def _start(self) -> None:
        """Begin when every declared peer is matched, both ways."""
        if self.ready or self.state != "starting":
            return
        absent = self._handshake.absent()
        self.lacking = self._handshake.lacking
        if absent:
            return
        self._starter.cancel()
        self.ready = True
        self.state = "running"
        self._since = self.middleware.steady()
        if self.is_plant:
            try:
                self._send(0)
            except (ArithmeticError, RunError) as error:
                self.broke(error)
        if not self.missing:
            self._step()

    # ticks -----------------------------------------------------------------------------------------------------

    def _await(self, t: int) -> None:
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
            return pairing.schedule.before(self.schedule.next(t) if self.is_plant else t)
        want = pairing.schedule.awaited(t)
        pairing.holds = pairing.schedule.next(t)
        return want

    def _arrived(self, pairing: Pairing) -> None:
        pairing.have = True
        self.missing -= 1
        if not self.missing and self.ready:
            self._step()

    def _step(self) -> None:
        """Answer ticks as long as nothing is missing."""
        try:
            while not self.missing and self.state == "running" and not self._over:
                if self.is_plant:
                    self._advance(self.t)
                elif self._solving is not None and not self._solving.finished(
                    self.t, None if self.bad else self.values
                ):
                    return
                else:
                    self._update(self.t)
        except (ArithmeticError, RunError) as error:
            self.broke(error)

    def _advance(self, t: int) -> None:
        """Move the plant over one period and publish where it is."""
        last = self.schedule.last
        if last is not None and t >= last:
            self.finish()
            return
        self.block.advance(t, **self.values)  # type: ignore[attr-defined]
        self.t = t = self._next()
        self.buttons.release()
        self.ticks += 1
        self._await(t)
        self._send(t)
        last = self.schedule.last
        if last is not None and t >= last:
            self.finish()

    def _send(self, t: int) -> None:
        """Publish the plant's outputs at `t` and the clock."""
        self.publish(t, t, self.block.outputs(t))  # type: ignore[attr-defined]
        if self.block.ended:
            self._end_after(t)
        if self.links.owns_clock:
            self.clock_output.send((t, ()))
            if self.sink is not None and self._add_row is None:
                self.sink.add(self.extra_numbers, t, CLOCK_LAYOUT.encode(t, ()))
        now = time.perf_counter_ns()
        if self._sent:
            self._durations.append(now - self._sent)
        else:
            self._first = now
        self._sent = now

    def _update(self, t: int) -> None:
        """Answer one tick of a block that is not a plant."""
        self.publish(t, t, self.answer(t))
        if self.block.ended:
            self._end_after(t)
        self.ticks += 1
        self.t = self._next()
        self.buttons.release()
        self._await(self.t)
        if self.schedule.last is not None and self.t > self.schedule.last:
            self._leave()

    def _leave(self) -> None:
        """Finish when all who tell us of their ticks have begun: they may still wait for us to be there."""
        self._over = True
        if all(p.item.heard for p in self.pairings if p.earlier):
            self.finish()

    def _next(self) -> int:
        self._tick += 1
        return self.schedule.time(self._tick)

    def _end_after(self, stamp: int) -> None:
        """A block has ended the run at `stamp`: everybody's last tick is the first after it at which all can end."""
        self._cut = True
        stride = self.links.stride
        ticks = Schedule(self.schedule.clock).tick(stamp)
        for schedule in {self.schedule, *(p.schedule for p in self.pairings)}:
            schedule.stop(ticks + stride - ticks % stride)
        for pairing in self.pairings:
            last = pairing.schedule.last
            pairing.until = pairing.until if last is None else last
            if pairing.earlier or last is None or pairing.want <= last:
                continue
            pairing.want = last  # we wait for what will never come: what its sender said last serves
            if not pairing.have and pairing.complete():
                self._use(pairing)
                self.missing -= 1
        last = self.schedule.last
        if self.state == "running" and last is not None and (self.t >= last if self.is_plant else self.t > last):
            self._leave()

    def answer(self, t: int) -> Any:
        """Give what a block that is not a plant sends; a solver has begun with this tick before."""
        return super().answer(t) if self._solving is None or self.bad else self._solving.block.end(t)

    def busy(self) -> bool:
        """Whether a solver is at work."""
        return self._solving is not None and self._solving.block.working

    def statistics(self) -> dict[str, Any]:
        """Wall-clock time of a plant's ticks: all in s, each in ms; once they are over, for sorting them takes time."""
        if self.state == "running":
            return {}
        return {"running_s": (self._sent - self._first) / 1e9} | percentiles("tick", self._durations)

    # stalls ----------------------------------------------------------------------------------------------------

    def _patient(self) -> None:
        """A solver is at work somewhere in the rig: the time without progress begins anew."""
        self._heard += 1

    def _begun(self) -> bool:
        """Whether the rig has sent anything: before that, somebody still waits for an outside node."""
        if self.links.owns_clock or self._heard:
            return True
        others = [p for p in self.pairings if not p.earlier]  # a source of an outside plant says t = 0 unasked
        return any(p.have for p in others) or (self.ticks > 0 and bool(others))

    def progress(self) -> None:
        """End the run when a peer is gone, stalls or never came."""
        now = self.middleware.steady()
        if self._rivals is not None:
            topic = self._rivals.port.topic
            rivals = self.middleware.publishers(self.middleware.resolve(topic))
            names, count = sorted({p.full_name for p in rivals}), len(rivals)
            if not any("UNKNOWN" in n for n in names) or now - self._since > self.options.timeout:
                self.fail(f"{count} publishers on {topic} ({', '.join(names)}), expected exactly one")
            return
        if self.state == "starting" or (self.state == "running" and not self._begun()):
            limit = self.options.start_timeout
            if limit and now - self._since > limit:
                absent = self._handshake.absent() or [f"nothing on {p.topic} yet" for p in self.pairings if not p.have]
                self.fail(f"not all peers after {limit:g} s: {'; '.join(absent)}")
            return
        if self.state != "running":
            return
        if self._progress != (self.t, self._heard):
            self._progress, self._since = (self.t, self._heard), now
            return
        waited = now - self._since
        lacking = [p for p in self.pairings if not p.have]
        gone = [p for p in lacking if not p.item.publishers]
        if lacking and (waited > self.options.timeout or (gone and waited > GONE_AFTER)):
            lacking = gone or lacking
            what = ", ".join(
                f"{p.topic} from {p.sender}{' (gone)' if p in gone else ''}"
                f"{'; last refused: ' + p.item.last_refusal if p.item.last_refusal else ''}"
                f"{f'; it is ahead, at {max(p.said) / SECOND:.9g} s' if p.said else ''}"
                for p in lacking
            )
            self.waits_for = [p.sender for p in lacking]
            self.fail(f"nothing stamped t = {self.t / SECOND:.9g} s within {waited:.1f} s on {what}")


def _stamp(data: bytes) -> int:
    """The stamp of a refused message, as far as it can be read."""
    if len(data) < 12 or data[1] != 1:
        return -1
    return int.from_bytes(data[4:8], "little", signed=True) * SECOND + int.from_bytes(data[8:12], "little")
