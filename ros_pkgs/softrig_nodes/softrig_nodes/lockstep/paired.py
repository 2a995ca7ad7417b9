"""The table of senders in lockstep: the message that the current tick needs of each, and whether it has arrived."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterable, Set
from typing import Any

from softrig_core.block.codec import readable_stamp
from softrig_core.block.port import CLOCK, Port
from softrig_core.block.schedule import Schedule
from softrig_core.rig.options import InputLink
from softrig_core.timebase import SECOND

from ..adapter.adapter import Adapter
from ..adapter.sender import Sender
from ..seam.numbering import numbered, split
from ..seam.tick import TICK, TickReader, needed
from .turns import Turns

KEEP = object()  # a sporadic sender was silent at a tick
BAD = object()  # a message of a tick was rejected
_FOREVER = 1 << 62
# This bounds the memory for a publisher that runs far ahead of us.
AHEAD = 100_000  # messages that a sender may be ahead


class PairedSenders:
    """The senders of a lockstep node.

    Parameters
    ----------
    turns : Turns
        Continues when the current tick has all its messages.

    Attributes
    ----------
    rows : list of Paired
        Those that a tick waits for.
    unpaced : list of Paired
        To be matched before the start, but not waited for.
    missing : int
        Number of rows that the tick under way still lacks.
    signs_of_life : int
        Messages that do not advance our tick but show that a peer is alive.
    """

    def __init__(self, node: Adapter, turns: Turns) -> None:
        self.node = node
        self.turns = turns
        self.rows: list[Paired] = []
        self.unpaced: list[Paired] = []
        self.missing = 0
        self.signs_of_life = 0

    def row(self, port: Port) -> Sender:
        """Create the row of an input: paired with the ticks of its sender, or holding the newest value."""
        node, name = self.node, port.name
        link = node.links.inputs.get(name)
        # Nothing tells whether such a publisher will publish at a tick, so no tick can wait for it.
        by_itself = link is None and (port.held or port.sporadic) and name not in node.options.paired
        row: Sender
        if by_itself or name in node.links.free:
            row = Newest(node, port)
        else:
            # A stamp that is an acquisition time, or none at all, does not name a tick: such messages are counted.
            late = port.delayed if link is None else link.delayed
            kind = Counted if late or not port.stamped else Paired
            if link is None:
                # A node started by hand knows no schedules of others, so its publishers are taken to have its own
                # period.
                row = kind(self, port, "another node", Schedule(node.schedule.period))
            else:
                row = kind(self, port, link.node, node.peer(link), silent=link.port if link.sporadic else "")
            self.rows.append(row)
        node.step.stamps[name] = lambda: row.stamp
        return row

    def without(self, local: Set[str]) -> None:
        """Stop waiting for nodes of the same process; the order of the runner ensures that they have published."""
        self.rows = [r for r in self.rows if r.publisher not in local and not r.local]

    def follow_clock(self, link: InputLink) -> None:
        """Let /clock pace the node."""
        self._listen(Pace(self, CLOCK, link.node, self.node.peer(link)), awaited=True)

    def follow_ticks(self, local: Set[str], done: Callable[[], object]) -> None:
        """Subscribe to the acknowledgements of nodes in other processes that this one waits for or that may be silent.

        Parameters
        ----------
        local : set of str
            Nodes of this process.
        done : callable
            Called after each.
        """
        node, links = self.node, self.node.links
        silent: dict[str, list[Paired]] = {}
        for row in self.rows:
            if row.silent:
                silent.setdefault(row.publisher, []).append(row)
        for name in [w for w in dict.fromkeys([*links.acks, *silent]) if w not in local]:
            port, awaited = Port("stamp", f"{node.namespace}/{name}/tick", TICK), name in links.acks
            link = InputLink(period=links.acks[name], node=name) if awaited else links.inputs[silent[name][0].name]
            if name in links.followers:
                self._listen(Behind(self, port, name, node.peer(link)), awaited=True)
                continue
            # The clock leaves tick t when t is acknowledged. Any other node waits only for the tick before: the
            # acknowledging node may need its message of t in order to answer t.
            ticks = Ticks(
                self, port, name, node.peer(link), awaited and not links.owns_clock, silent.get(name, ()), done
            )
            # Rows that no tick waits for are not counted in `missing`, so their arrival must not lower it.
            ticks.have = ticks.have or not awaited
            self._listen(ticks, awaited)

    def _listen(self, row: Paired, awaited: bool) -> None:
        (self.rows if awaited else self.unpaced).append(row)
        self.node.paces.append(row)
        self.node.middleware.subscribe(row.port.topic, row.port.msgtype, row)

    def await_tick(self, t: int) -> None:
        """Set the requirements of tick `t`."""
        # Each row sets its awaited stamp here, so all are called: `any` would skip some.
        self.missing = sum([row.lacks(t) for row in self.rows])


class Newest(Sender):
    """An input that uses the newest value, at whatever tick it arrives."""

    def rejected(self, data: bytes) -> None:
        """Handle a rejected message as one that the next answer would have used."""
        self.node.step.bad = True

    def accept(self, stamp: int, value: Any, data: bytes) -> None:
        """Hold the value of a message."""
        if not (self.port.stamped or self.in_order(stamp)):
            return
        node = self.node
        node.values[self.name] = self.value(stamp, value)
        self.stamp = node.t
        self.record(node.t, data)


class Paired(Sender):
    """A sender whose messages are assigned by their stamps to the ticks that they belong to.

    A tick needs the newest message up to `want`. An early message is stored: a sender may be some ticks ahead of us
    if there are several plants or if it is an outside node.

    Parameters
    ----------
    schedule : Schedule
        Of the sender.
    earlier : bool
        Whether the awaited stamp is that of the last tick before ours; at the end of the run it is what the block
        published then.
    silent : str
        Name of the sender's port if that is sporadic: silence is reported by its acknowledgement.

    Attributes
    ----------
    want : int
        Awaited stamp, ns.
    have : bool
        Whether the sender has published up to there.
    used : int
        The last awaited stamp up to which the sender had published.
    reached : int
        The last tick that its messages, silences and acknowledgements cover.
    pending : dict
        What was published at ticks that are not used yet: value and bytes, `KEEP` or `BAD`.
    rejected_stamp : int
        Stamp of the newest rejected message whose tick is answered: a valid one that follows is too late.
    """

    def __init__(
        self, table: PairedSenders, port: Port, name: str, schedule: Schedule, earlier: bool = False, silent: str = ""
    ) -> None:
        super().__init__(table.node, port, name)
        self.table = table
        self.read = self.decode  # type: ignore[method-assign]
        self._values = table.node.values
        self.schedule = schedule
        self.earlier = earlier
        self.silent = silent
        self.used = self.reached = schedule.before(0)
        self.want = self.used if earlier else 0
        # Before t = 0 there is no earlier tick to wait for.
        self.have = earlier
        self.rejected_stamp = -1
        self.pending: dict[int, Any] = {}
        self.last_stamp_zero = False  # whether the last message that fits no tick had the stamp 0
        self._holds = 0  # time up to which the message in use is still the awaited one
        # with our period: due whenever we are, up to its last tick
        alike = schedule.period == table.node.schedule.period and not earlier
        self._alike = -1 if not alike else _FOREVER if schedule.last is None else schedule.last

    # what a tick needs ---------------------------------------------------------------------------------------------

    def lacks(self, t: int) -> bool:
        """Set the message that our tick `t` needs; return whether it has not arrived."""
        if t < self._holds:
            return False  # a slower sender: its last message still holds
        want = t if t <= self._alike else self.wanted(t)
        # An unchanged want has been met: at the end time the message of the last tick is still held. At t = 0 the want
        # equals the initial one although nothing has arrived.
        if want == self.want and (t or self.earlier):
            return False
        self.want = want
        self.have = (want <= self.used or want <= self.reached or bool(self.pending)) and self._complete()
        if self.have:
            self._use()
        return not self.have

    def wanted(self, t: int) -> int:
        """Return the stamp that tick `t` needs."""
        if self.earlier:
            node = self.node
            # A plant asks when it has published t and is about to move on; any other node asks before it publishes t.
            return self.schedule.before(node.schedule.next(t) if node.is_plant else t)
        want = self.schedule.awaited(t)
        self._holds = self.schedule.next(t)
        return want

    def resume(self, used: int, reached: int) -> None:
        """Continue after a tick of the publisher; its silences are known up to the tick `reached` (-1: none)."""
        self.used, self.reached = max(self.used, used), max(self.reached, reached)
        # An awaited stamp that no tick has makes the next `lacks` check everything again.
        self.want, self._holds, self.have = -_FOREVER, 0, False

    def learn(self, reached: int) -> None:
        """Record that the sender has published up to one of its ticks, and only the messages that have arrived."""
        self.reached = max(self.reached, reached)
        if not self.have and self._complete():
            self._use()
            self._arrived()

    def _complete(self) -> bool:
        """Return whether the sender has published up to the awaited tick."""
        return self.want <= self.used or self.want <= self.reached or (not self.silent and self.want in self.pending)

    def _use(self) -> None:
        """Use the newest message up to the awaited tick; drop the others."""
        self.used = max(self.used, self.want)
        result: Any = KEEP
        for position in sorted(p for p in self.pending if p <= self.want):
            value = self.pending.pop(position)
            if value is not KEEP:
                result = value
                # A rejected message leaves the old value, and with it that value's age.
                self.stamp = position if value is not BAD else self.stamp
        if result is BAD:
            self.node.step.bad = True
        elif result is not KEEP:
            self.node.values[self.name], data = result
            self.record(self.node.t, data)

    def _arrived(self) -> None:
        """Count that one message for the current tick has arrived; run the tick if it was the last one."""
        self.have = True
        self.table.missing -= 1
        if not self.table.missing:
            self.table.turns.turn()

    # what has come -------------------------------------------------------------------------------------------------

    def accept(self, stamp: int, value: Any, data: bytes, tick: int | None = None) -> None:
        """Accept a message for a tick of its sender: the tick of its stamp, unless given."""
        position = stamp if tick is None else tick
        # Nearly every message is the awaited one, with nothing stored ahead of it: it needs no table.
        if position == self.want and not self.have and not self.pending and not self.silent:
            if self._number is not None:
                self.record(self.node.t, data)
            self._values[self.name] = self.value(stamp, value) if self._valued else value
            self.stamp = self.used = position
            self._arrived()
        # In a run with restarts nodes repeat messages on purpose, so a repeated one is no error.
        elif self.node.links.returns and self._again(position):
            return
        elif self._is_new(position):
            self.table.signs_of_life += 1
            self._put(position, (self.value(stamp, value), data))
        # The tick has been answered with the rejected message, so a corrected one is too late.
        elif position == self.rejected_stamp:
            return
        # A stamp of 0 is a first message repeated for a late subscriber, or comes from an outside node that copies no
        # stamp; if a stall follows, its report names this cause.
        elif position == 0 and self.node.links.guests:
            self.last_stamp_zero = True
        else:
            got, want = position / SECOND, self.want / SECOND
            twice = " (already there)" if self.have else ""
            self.node.account.refuse(self, f"stamp {got:.9g} s from {self.publisher}, expected {want:.9g} s{twice}")

    def recall(self, number: int, data: bytes) -> None:
        """Accept a message from the record of its sender: its number there, from 0."""
        self.receive(data)

    def rejected(self, data: bytes) -> None:
        """Answer the tick of a rejected message: a controller also answers bad measurements, a plant waits for a good
        command.
        """
        if not self.node.is_plant:
            self._count_rejected(readable_stamp(data))

    def acknowledge(self, position: int, published: bool) -> None:
        """Process the report of a sporadic sender whether it published at one of its ticks."""
        # A tick at which it published is completed by the message itself.
        if not published and self._is_new(position):
            self._put(position, KEEP)

    def _again(self, position: int) -> bool:
        """Return whether a message has arrived before, or is older than one that was used in its place."""
        if position <= self.used or position in self.pending:
            return True
        return not self.silent and any(position < p <= self.want for p in self.pending)

    def _count_rejected(self, position: int | None) -> None:
        """Count a rejected message as the one of its tick."""
        if position is not None and self._is_new(position):
            self.rejected_stamp = position
            self._put(position, BAD)

    def _is_new(self, position: int) -> bool:
        """Return whether a message of this tick of the sender is new and possible."""
        last = self.schedule.last
        return (
            self.used < position
            and position not in self.pending
            and self.schedule.due(position)
            and (last is None or position <= last)
            and len(self.pending) < AHEAD
        )

    def _put(self, position: int, value: Any) -> None:
        """Store a message of a tick, and use it if it completes the inputs of our tick."""
        if not self.silent and position < self.want:
            # Of a faster publisher only the newest message up to the wanted tick can be used; older ones are dropped.
            self.pending = {p: message for p, message in self.pending.items() if p > position}
        self.pending[position] = value
        # Acknowledgements and messages overtake each other, so a tick only counts when all before it are known.
        while self.silent and (following := self.schedule.next(self.reached)) in self.pending:
            self.reached = following
            if self.pending[following] is KEEP:
                del self.pending[following]
            elif following <= self.want:
                self.pending = {p: message for p, message in self.pending.items() if p >= following}
        if not self.have and self._complete():
            self._use()
            self._arrived()


class Counted(Paired):
    """A sender whose messages have no stamp of their tick: the n-th belongs to its n-th tick.

    If it is sporadic, the n-th message belongs to the n-th tick at which it reports that it published. A plant does
    not count messages that it rejects.
    """

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.received = 0
        self._queue: deque[tuple[int, tuple[float, ...] | None, bytes]] = deque()  # None: a refused message
        self._announced: deque[int] = deque()  # ticks at which the messages were sent
        self._acknowledged = -1  # the newest tick that the publisher has acknowledged
        self._behind = self.port.delayed and self.node.links.returns  # whether a number follows each message

    def resume(self, used: int, reached: int) -> None:
        """See `Paired.resume`."""
        super().resume(used, reached)
        self._acknowledged = max(self._acknowledged, reached)

    def count(self, received: int, announced: Iterable[int]) -> None:
        """Continue after a number of used messages; messages of the announced ticks will still arrive."""
        self.received = received
        self._announced.extend(announced)

    def receive(self, data: bytes) -> None:
        """Receive the bytes of a message, without the appended number."""
        if self._behind and not self.deaf():
            number, data = split(data)
            if not self._in_turn(number):
                return
        super().receive(data)

    def recall(self, number: int, data: bytes) -> None:
        """See `Paired.recall`."""
        self.receive(numbered(number, data) if self._behind else data)

    def accept(self, stamp: int, value: Any, data: bytes) -> None:
        """Accept a message (None for a rejected one) at its number."""
        # For an array `stamp` is its number. A stamped message has been counted in `receive`, if it carries a number at
        # all.
        if not (self.port.stamped or self._in_turn(stamp)):
            return
        self._queue.append((stamp, value, data))
        if not self.silent:
            self._announced.append(self.schedule.time(self.received))
        self.received += 1
        self._serve()

    def rejected(self, data: bytes) -> None:
        """Count a rejected message if the node does not wait for a valid one."""
        if not self.node.is_plant:
            self.accept(self.decode.number(data), None, data)

    def acknowledge(self, position: int, published: bool) -> None:
        """Process the report of a sporadic sender whether it published at one of its ticks."""
        # This acknowledgement was repeated.
        if position <= self._acknowledged:
            return
        self._acknowledged = position
        if published:
            self._announced.append(position)
            self._serve()
        else:
            super().acknowledge(position, published)

    def _serve(self) -> None:
        """Assign the messages that have arrived to the ticks at which they were sent."""
        while self._queue and self._announced:
            (stamp, values, data), position = self._queue.popleft(), self._announced.popleft()
            if values is None:
                self._count_rejected(position)
            else:
                super().accept(stamp, values, data, position)

    def _in_turn(self, number: int) -> bool:
        """Return whether a message is the next one; reject a repeated one; end the run if one is missing."""
        node, expected = self.node, self.received
        # An outside node need not count; its messages have -1 and are taken by order.
        if number in (-1, expected):
            return True
        # Messages published while this node was down are missing; it reads them from the files, or they are repeated.
        if number > expected and node.files is not None:
            pass
        # A gap would pair all later messages with wrong ticks, so the run ends.
        elif number > expected:
            lost = f"{number - expected} lost"
            node.fail(f"{self.port.topic}: number {number} from {self.publisher}, expected {expected} ({lost})")
        # Repetition is intended in a run with restarts, and of the first message for late outside subscribers.
        elif not node.links.returns and (number or not node.links.guests):
            self.repeated(number, expected)
        return False


class Pace(Paired):
    """A sender whose messages carry only its ticks: /clock."""

    def accept(self, stamp: int, value: Any, data: bytes) -> None:
        """Process the report that the sender has reached one of its ticks."""
        self.table.signs_of_life += 1
        if stamp == self.want and not self.have:
            self.used = self.reached = stamp
            self._arrived()
        elif stamp == self.schedule.next(self.reached):
            self.reached = stamp

    def rejected(self, data: bytes) -> None:
        """Ignore an invalid message: another one follows, or the run ends without it."""


class Behind(Pace):
    """The acknowledgements of a follower; they keep the clock from running too far ahead of it."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.read = TickReader()  # type: ignore[method-assign]
        # The tick needed of a follower lies some ticks behind ours, so the shortcut for equal periods does not hold.
        self._alike = -1

    def wanted(self, t: int) -> int:
        """Return the tick that the follower must acknowledge before the present tick of this node."""
        return needed(self.schedule, self.node.schedule, t)

    def accept(self, stamp: int, value: Any, data: bytes) -> None:
        """Process the acknowledgement of a tick and all before it."""
        self.table.signs_of_life += 1
        self.reached = max(self.reached, stamp)
        if not self.have and stamp >= self.want:
            self._arrived()


class Ticks(Pace):
    """The acknowledgements of a node: its ticks, and the sporadic ports that published at them.

    Parameters
    ----------
    silent_rows : iterable of Paired
        Rows of these ports.
    done : callable
        Called after each.
    """

    def __init__(
        self,
        table: PairedSenders,
        port: Port,
        name: str,
        schedule: Schedule,
        earlier: bool,
        silent_rows: Iterable[Paired],
        done: Callable[[], object],
    ) -> None:
        super().__init__(table, port, name, schedule, earlier)
        self._silent_rows, self._then = tuple(silent_rows), done
        self.read = TickReader()  # type: ignore[method-assign]

    def accept(self, stamp: int, names: Collection[str], data: bytes) -> None:
        """Notify the rows of its sporadic ports, then continue as after any tick."""
        # The rows learn of it first, because `accept` may run the next tick, which asks them.
        for row in self._silent_rows:
            row.acknowledge(stamp, row.silent in names)
        super().accept(stamp, names, data)
        self._then()
