"""Lockstep: a node answers tick k when everything stamped t_k has arrived, at any speed of the host.

No number depends on a clock here; wall-clock time only ends a run that makes no progress.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Mapping, Set
from typing import Any

import numpy as np
from numpy.typing import NDArray
from softrig_core.block.answer import Rows
from softrig_core.block.block import Level
from softrig_core.block.link import Link
from softrig_core.block.port import Port
from softrig_core.solver.solver import Solver
from softrig_core.timebase import SECOND

from ..adapter.adapter import Adapter
from ..adapter.handshake import CHECK, Handshake
from ..adapter.sender import Sender
from ..seam.endpoint import Input
from ..seam.health import percentiles
from ..seam.middleware import Place, Reader
from ..seam.solving import Busy, Solving
from .comeback import Comeback, LastPublished
from .first import repeat_first
from .paired import PairedSenders
from .stalls import Stalls
from .turns import Turns

FEW = 2  # followers that a loop of two can have and still be placed by itself
REPORT_AFTER = 5 * SECOND // CHECK  # checks after which a node that cannot begin logs what it lacks


class Lockstep(Link):
    """Makes the ticks of a node ready when the messages of its peers in other processes have arrived.

    Parameters
    ----------
    turns : Turns
        The loop of this process.
    """

    # In lockstep no tick has a deadline, and the runner recognises a waiting node by two statuses with the same tick.
    status_every = 1

    def __init__(self, node: Adapter, turns: Turns) -> None:
        self.node = node
        self.ready = False  # whether all peers are there
        self._turns = turns
        self.senders = PairedSenders(node, turns)
        self._stalls = Stalls(self.senders)
        self._checks = 0  # checks of the start
        self._over = False  # the last tick is answered
        self._awaited = 0  # tick whose required messages are set
        self._last = math.inf if node.schedule.last is None else node.schedule.last
        record = node.record
        # A shard stores many rows of numbers in one call. Any other sink gets message after message, and an answer with
        # silences or with stamps of its own is no such row.
        self._keeps = node.step.plain and (record.shard is not None or record.sink is None)
        # The length bounds the memory of a long run; its percentiles are then those of the newest ticks.
        self._durations: deque[int] = deque(maxlen=100_000)
        self._sent = self._first = self._longest = 0
        self.solving: Solving | None = None
        self._comeback: Comeback | None = None
        self._ticks_before = -1  # ticks at the last look at its progress
        self._shake: Callable[[], Handshake]  # describes the peers again when some have left
        super().__init__(node.step)
        node.begin(self)
        # After `begin`, which binds the functions that `LastPublished` wraps.
        self.last_published = LastPublished(node) if node.links.returns else None

    def join(self, local: Set[str]) -> None:
        """Wait for the peers that are not in this process.

        Parameters
        ----------
        local : set of str
            Names of the other nodes of this process.
        """
        node, senders, links = self.node, self.senders, self.node.links
        senders.without(local)
        if links.clock is not None and links.clock.node not in local:
            senders.follow_clock(links.clock)
        if links.follows_clock:
            # An outside plant may publish /clock and wait for its subscribers, although this node does not need it.
            node.middleware.subscribe("/clock", "rosgraph_msgs/msg/Clock", Reader())
        if links.guests:
            # A subscriber recognises a repeated message by the stamp of its tick, so arrays and delayed ports are not
            # repeated.
            stamped = [o for o in node.outgoing.outputs if o.port.stamped and not o.port.delayed]
            # A plant counts a tick when it moves on, any other node when it has answered.
            first = 0 if node.is_plant else 1
            repeat_first(
                [*stamped, node.outgoing.clock_output], lambda: node.state == "running" and node.ticks == first
            )
        senders.follow_ticks({*local, node.middleware.name}, self.on_last_message)
        senders.await_tick(0)
        wanted = [(o, list(links.readers.get(o.name, []))) for o in node.outgoing.outputs]
        if links.owns_clock:
            wanted.append((node.outgoing.clock_output, links.clock_readers))
            node.hold.begin(node.middleware, self._turns.turn)
        if links.acknowledges:
            wanted.append((node.outgoing.tick_output, links.tick_readers))
        awaited: list[tuple[Input, str]] = [(row, row.publisher) for row in [*senders.rows, *senders.unpaced]]
        # A node in a process of its own receives what it publishes itself; one in a container does not.
        in_process = {*local, node.middleware.name} if local else set()
        solvers = [name for name in links.solvers if name not in in_process]
        # An outside node may be a solver, too, so the topic is subscribed to even if the rig names none.
        busy = Busy(node.middleware, max(1, len(solvers)), self._patient)
        awaited += [(busy, name) for name in solvers]
        if isinstance(node.block, Solver):
            self.solving = Solving(node.middleware, node.step, self._turns.turn)
        ended: Set[str] = set()
        if node.files is not None:
            self._comeback = Comeback(self, node.files)
            self._comeback.go(self._turns.ticks)
            ended = self._comeback.ended

        def shake() -> Handshake:
            return Handshake(
                node, [(i, publisher) for i, publisher in awaited if publisher not in ended], wanted, {*local, *ended}
            )

        self.handshake, self._shake = shake(), shake
        self._stalls.handshake = self.handshake
        # A solver node resumes by a timer of the executor's thread, so it also takes its messages there.
        if self.solving is None:
            node.middleware.be_prompt(self._place())
        self._starter = node.middleware.timer(CHECK, self._start)

    def _place(self) -> Place:
        """Return the node's place on the processors: in a loop of two nodes only one works at a time."""
        links = self.node.links
        loop = set(links.starts) - set(links.followers)
        # Only in a loop of two does one node wait while the other works, so that they can share a processor.
        if links.guests or len(loop) != 2 or len(links.followers) > FEW:
            return "anywhere"
        return "together" if self.node.middleware.name in loop else "beside"

    # peers -----------------------------------------------------------------------------------------------------

    def row(self, port: Port) -> Sender:
        """Create the row of an input."""
        return self.senders.row(port)

    @property
    def t(self) -> int:
        """Time of the tick under way."""
        return self.node.schedule.time(self.node.ticks)

    def now(self) -> int:
        """Time of the tick under way."""
        return self.t

    def record(self, number: int, data: bytes) -> None:
        """Record a message from outside at the tick that uses it."""
        if self.node.record.sink is not None:
            self.node.record.sink.add(number, self.t, data)

    def on_matched(self, item: Input) -> None:
        """End the run, naming both, if a second publisher on a paired topic makes it ambiguous."""
        node = self.node
        if node.links.returns:
            # A second publisher is expected when a killed node is started again: DDS still lists the old process.
            return
        if item.publishers > 1 and node.state != "done" and (item.local or item in self.senders.rows):
            self._stalls.rivals = item
            node.state = "failed"  # no message counts from here on; `progress` ends the run when the names are known

    def _start(self) -> None:
        """Begin when every declared peer is matched, both ways."""
        if self.ready or self.node.state != "starting":
            return
        self.node.absent = absent = self.handshake.absent()
        self.node.lacking = self.handshake.lacking
        if absent:
            self._checks += 1
            if self._checks == REPORT_AFTER:
                self.node.middleware.log(Level.WARN, f"cannot begin yet: {'; '.join(absent)}")
        else:
            self._starter.cancel()
            self.ready = True
            self._stalls.restart()
            # Its peers may wait for messages that were lost when it died, and only now are they matched with the new
            # process.
            if self._comeback is not None and self.last_published is not None:
                self.last_published.again()
            self._turns.begin()
            # A node that comes back may have answered its last tick from the files of the run, before its peers were
            # matched.
            if self._over:
                self._leave()

    def _patient(self) -> None:
        """Restart the time without progress, because a solver of the rig is at work."""
        self.senders.signs_of_life += 1

    def on_last_message(self) -> None:
        """See `Drive.on_last_message`."""
        if self._over and self.node.state == "running":
            self._leave()

    # ticks -----------------------------------------------------------------------------------------------------

    def lacks(self, t: int) -> bool:
        """Return whether a message that tick `t` needs has not arrived."""
        senders = self.senders
        # The loop asks again and again while a tick waits, but the requirements of a tick are set only once.
        if senders.rows and t != self._awaited:
            self.await_tick(t)
        if senders.missing or self.solving is None:
            # The hold is asked last, because the question uses up a single step that a person has granted.
            return senders.missing > 0 or self.node.hold.holds(t)
        # `finished` also begins the work on a tick, so it is called only when all inputs have arrived.
        return not self.solving.finished(t)

    def await_tick(self, t: int) -> None:
        """Set the requirements of tick `t`."""
        self._awaited = t
        self.senders.await_tick(t)

    def send(self, t: int, rows: Rows, numbers: tuple[float, ...]) -> None:
        """Publish an answer; note the time if the node is a plant."""
        node = self.node
        node.outgoing.publish(t, rows, numbers)
        if node.is_plant:
            now = time.perf_counter_ns()
            if self._sent:
                self._durations.append(elapsed := now - self._sent)
                if elapsed > self._longest:
                    self._longest = elapsed
            else:
                self._first = now
            self._sent = now
            # No plant is moved beyond the end, so `over` is not called for its last tick.
            if t >= self._last:
                self._leave()

    def send_all(self, times: NDArray[np.int64], numbers: NDArray[np.float64], stamps: NDArray[np.int64]) -> None:
        """Record answers of native code that have no readers."""
        if not self._keeps:
            super().send_all(times, numbers, stamps)
            return
        node = self.node
        node.outgoing.keep(times, numbers)
        # `over` is not called for native ticks, so they are counted here.
        node.ticks += len(times)
        if node.is_plant and self._sent:
            now = time.perf_counter_ns()
            # A native tick has no time of its own, so each counts with the mean of its batch.
            share = (now - self._sent) // len(times)
            self._durations.extend([share] * min(len(times), self._durations.maxlen or 0))
            self._longest = max(self._longest, share)
            self._sent = now
        if times[-1] >= self._last:
            self._leave()

    def changed(self, t: int, values: Mapping[str, Any]) -> None:
        """Record new parameters."""
        node = self.node
        node.record.change(node.epoch + t, node.middleware.name, values)

    def over(self, t: int) -> None:
        """Count a tick; a node that has answered its last tick leaves."""
        node = self.node
        node.ticks += 1
        if node.buttons.pressed:
            node.buttons.release()
        if not node.is_plant and t >= self._last:
            self._leave()

    @property
    def alone(self) -> bool:
        """Return whether no other process and no user takes part in the ticks."""
        node = self.node
        return (
            node.outgoing.alone
            and node.state in ("running", "done")
            and not (self.senders.rows or self.solving or node.links.returns or node.step.bad or node.buttons.pressed)
            and (not node.step.plain or self._keeps)
            and not (node.hold.held or node.hold.pace)
        )

    def _leave(self) -> None:
        """Finish when every node that acknowledges its ticks to us has started; until then it may wait for us.

        Then wait for a bounded time for the last messages of external nodes, and record them.
        """
        self._over = True
        begun = self.ready and all(row.received_any for row in self.senders.rows if row.earlier)
        if begun and self.node.overheard.complete():
            self.node.finish()

    def busy(self) -> bool:
        """Return whether a solver is at work or the run is paused."""
        hold = self.node.hold
        return hold.held or hold.waits or (self.solving is not None and self.solving.working)

    def counts(self) -> dict[str, int]:
        """Return no counts: nothing is late in lockstep."""
        return {}

    def statistics(self) -> dict[str, Any]:
        """Return the wall-clock time of a plant's ticks (all in s, each in ms), and which ticks ran natively.

        Only after the run, because sorting is slow.
        """
        if self.node.state == "running":
            return {}
        result: dict[str, Any] = {"running_s": (self._sent - self._first) / 1e9} | percentiles(
            "tick", self._durations, self._longest
        )
        if self._turns.report_native is not None:
            self._turns.report_native()
            result |= {"native": self.step.native}
        return result

    def progress(self) -> None:
        """End the run if a peer has gone, stalls or never came; publish messages again that may have been lost
        with a peer.
        """
        if self.last_published is not None:
            # A rig that answered a tick since the last check has lost nothing, so messages are only repeated while it
            # waits.
            stands, self._ticks_before = self._ticks_before == self.node.ticks, self.node.ticks
            if stands and self.ready:
                self.last_published.again()
            if stands and self._comeback is not None and self._comeback.read_earlier():
                # Nodes that have left can no longer be matched, so the handshake is made again without them.
                self._stalls.handshake = self.handshake = self._shake()
        self.on_last_message()
        # The wait for last messages of external nodes ends by time, when no message may arrive that would check it.
        self._stalls.check()
