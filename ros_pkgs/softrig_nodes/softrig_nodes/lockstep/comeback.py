"""Restart a killed node: it repeats the ticks that it had answered, from the files of the run.

In a run whose nodes may be restarted (`Links.returns`) each node stores its last messages. It publishes them again as
long as the rig makes no progress; a reader that has them already ignores them. A node that was killed is started
again when all others wait. It repeats its ticks from the first one on without publishing. It reads the messages of
its senders from their recordings, and messages from outside and changes of parameters from its own. After that it has
its state, its tick and all its messages, and waits like the others.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

from softrig_core.block.change import Change
from softrig_core.block.link import Link
from softrig_core.block.port import Refused
from softrig_core.block.step import Step
from softrig_core.solver.solver import Solver
from softrig_core.wire.parameter_event import recorded
from softrig_core.wire.recording import relative

from ..adapter.account import WATCH_PERIOD
from ..adapter.adapter import Adapter
from ..adapter.files import Files
from ..adapter.sender import Sender
from ..seam.numbering import Numbering
from .paired import Counted, Pace, Paired, Ticks

if TYPE_CHECKING:
    from .lockstep import Lockstep

# In lockstep at most two messages of a topic are under way at a time (a rig with restarts has no followers, which may
# lag further behind), so no reader lacks an older one.
SAID = 2  # newest messages of each topic that are repeated


class LastPublished:
    """Stores what a node published last on each topic.

    Attributes
    ----------
    silent : bool
        Whether its outputs are only stored, not published.
    """

    def __init__(self, node: Adapter) -> None:
        self.silent = False
        self._kept: list[tuple[Callable[..., None], deque[tuple[Any, ...]]]] = []
        outgoing = node.outgoing
        for output in [*outgoing.outputs, *([outgoing.clock_output] if node.links.owns_clock else [])]:
            # A repeated message must carry the number that it had, so it is kept with that number.
            if isinstance(output.send, Numbering):
                output.send.publish = self._keeping(output.send.publish)
            else:
                output.send = self._keeping(output.send)
        if outgoing.acknowledge is not None:
            outgoing.acknowledge = self._keeping(outgoing.acknowledge)

    def _keeping(self, send: Callable[..., None]) -> Callable[..., None]:
        last: deque[tuple[Any, ...]] = deque(maxlen=SAID)
        self._kept.append((send, last))

        def keep(*message: Any) -> None:
            last.append(message)
            if not self.silent:
                send(*message)

        return keep

    def again(self) -> None:
        """Publish the newest message of each topic again."""
        for send, messages in self._kept:
            for message in messages:
                send(*message)


class _Recorded:
    """The messages of one row, as they were recorded."""

    def __init__(self, row: Sender, files: Files, outside: bool) -> None:
        self.row, self._node = row, row.node
        recording = files.local if outside else files.recording
        topic = recording.topics.get(relative(row.node.middleware.resolve(row.port.topic)))
        self.times: list[int] = [] if topic is None else topic.times
        self.data: list[bytes] = [] if topic is None else topic.data
        self._outside = outside
        self.next = 0  # first message that is not used

    def set_value(self, t: int) -> None:
        """Set the input to the newest message that had arrived up to tick t."""
        row, node = self.row, self._node
        first = self.next
        while self.next < len(self.times) and self.times[self.next] <= t:
            self.next += 1
        # Only the newest message counts, unless each has a lasting effect: channels of a partial port, or an entry in
        # the record of external messages.
        for k in range(first if row.port.partial or self._outside else max(first, self.next - 1), self.next):
            try:
                stamp, result = row.read(self.data[k])
            except Refused as error:
                # It was rejected before the node died as well, and the answer of that tick depended on it.
                node.account.refuse(row, str(error))
                node.step.bad = True
                continue
            node.values[row.name] = row.value(stamp, result)
            # As in `Newest.accept`: a message from outside has the age of the tick that used it, whatever its own stamp
            # is.
            row.stamp = node.t if self._outside else self.times[k]
            if self._outside:
                row.record(node.t, self.data[k])

    def unused(self) -> Iterator[tuple[int, bytes]]:
        """Return the number and the size in bytes of the messages that are not used."""
        return enumerate(self.data[self.next :], self.next)


class _Returning(Link):
    """Passes recorded messages to a node in place of arriving ones."""

    def __init__(self, step: Step, lacks: Callable[[int], bool]) -> None:
        super().__init__(step)
        self._lacks = lacks

    def lacks(self, t: int) -> bool:
        """Return whether the recorded messages are not enough for a tick."""
        return self._lacks(t)


class Comeback:
    """Brings a restarted node back to its state and tick.

    Parameters
    ----------
    drive : Lockstep
        Drive of the node; its table of senders is complete.
    look_up : callable
        Returns the current files.

    Attributes
    ----------
    gone : set of str
        Nodes that have answered their last tick and left.
    """

    def __init__(self, drive: Lockstep, look_up: Callable[[], Files]) -> None:
        self._drive, self._node, self._open_files = drive, drive.node, look_up
        files = self._files = look_up()
        self.ended = set(files.ended)
        self._reported_at = time.monotonic()
        rows = [*drive.senders.rows, *drive.senders.unpaced]
        # Acknowledgements are not recorded; the status files show which ticks a node has answered.
        self._paired = {row: _Recorded(row, files, outside=False) for row in rows if not isinstance(row, Ticks)}
        free = [i for i in self._node.inputs if isinstance(i, Sender) and i not in rows]
        self._free = [_Recorded(row, files, outside=True) for row in free]

    def go(self, ticks: Iterator[int | None]) -> None:
        """Run all ticks whose messages are recorded; then the node waits for missing ones like any other."""
        drive, node = self._drive, self._node
        step = node.step
        # Changes that people made while the node ran are only in its own record.
        changes = [Change(t, values) for t, name, values in recorded(self._files.local) if name == node.middleware.name]
        step.plan(sorted([*step.changes, *changes], key=lambda change: change.at))
        published = drive.last_published
        assert published is not None
        returning = _Returning(step, self.lacks)
        # These ticks have been published before, so the node repeats only the newest once it has caught up.
        published.silent = True
        for t in ticks:
            if t is None:
                break
        step.link, published.silent = returning.inner, False
        self._resume()

    def lacks(self, t: int) -> bool:
        """Set the inputs to the messages that had arrived up to tick t; return whether the tick lacks an input."""
        # No timer fires during this loop, so the status by which the runner sees the node alive is written here.
        if time.monotonic() - self._reported_at > WATCH_PERIOD * 1e-9:
            self._reported_at = time.monotonic()
            self._node.account.write_status()
        for received in (*self._paired.values(), *self._free):
            if not isinstance(received.row, Pace):
                received.set_value(t)
        if any(not self._has(row, row.wanted(t)) for row in self._drive.senders.rows):
            return True
        solving = self._drive.solving
        block = self._node.block
        # The executor does not spin yet, so the timer that asks for a solver's answer does not fire: it is waited for
        # here.
        while solving is not None and isinstance(block, Solver) and not solving.finished(t):
            block.worker.wait(0.1)
        return False

    def _has(self, row: Paired, want: int) -> bool:
        """Return whether a publisher had published at one of its ticks."""
        if want < self._files.answered.get(row.publisher, 0):
            return True
        times = self._paired[row].times if row in self._paired else []
        return want < 0 or (not row.silent and bool(times) and times[-1] >= want)

    def _resume(self) -> None:
        """Let the table of publishers continue from here."""
        drive, node = self._drive, self._node
        for row in (*drive.senders.rows, *drive.senders.unpaced):
            received = self._paired.get(row)
            used = self._newest_used(row)
            # A silent tick leaves no message, so only the status file of the publisher shows that it was answered.
            reached = self._answered(row) if row.silent or isinstance(row, Ticks) else used
            row.resume(used, reached)
            # A node that has left publishes nothing more, so `Lockstep._leave` must not wait for its first sign of
            # life.
            row.received_any = row.publisher in self.ended
            # No tick waits for an unpaced row, so it counts as complete.
            row.have = row in drive.senders.unpaced
            # Acknowledgements up to `reached` are ignored as repeated ones, so the messages that they announced are
            # announced here.
            if received is not None and isinstance(row, Counted):
                row.count(
                    received.next, [t for t in received.times[received.next :] if t <= reached] if row.silent else []
                )
            if row.port.partial:
                row.decode.kept = node.values[row.name]
        # Recalled messages are compared with the wanted stamps, so these are set first.
        drive.await_tick(node.t)
        for row, received in self._paired.items():
            for k, data in () if isinstance(row, Pace) else received.unused():
                row.recall(k, data)

    def read_earlier(self) -> bool:
        """Read from the current files the messages published before this node was known; return whether nodes
        have left.
        """
        files = self._files = self._open_files()
        new = files.ended - self.ended
        self.ended |= new
        for row in (*self._drive.senders.rows, *self._drive.senders.unpaced):
            row.received_any = row.received_any or row.publisher in new
            # A node that is still there repeats its messages itself; one that has left does not, so all of its messages
            # are read now.
            if row.have and row.publisher not in new:
                continue
            if not isinstance(row, Pace):
                received = _Recorded(row, files, outside=False)
                for k, (t, data) in enumerate(zip(received.times, received.data, strict=True)):
                    # Only ticks at which it published are recorded, so each message also announces its tick.
                    if isinstance(row, Counted) and row.silent:
                        row.acknowledge(t, True)
                    if k >= row.received if isinstance(row, Counted) else t > row.used:
                        row.recall(k, data)
            if row.silent or isinstance(row, Pace):
                row.learn(self._answered(row))
        return bool(new)

    def _newest_used(self, row: Paired) -> int:
        """Return the tick of the newest message that was used; for a sender without messages, its newest tick."""
        received = self._paired.get(row)
        if received is None:
            return self._answered(row)
        if isinstance(row, Pace):
            return received.times[-1] if received.times else -1
        return received.times[received.next - 1] if received.next else -1

    def _answered(self, row: Paired) -> int:
        """Return the newest tick that a sender had answered."""
        before = self._files.answered.get(row.publisher, 0)
        # `read_files` marks a node that has left by infinity: it has answered its last tick, whatever its last status
        # says.
        if math.isinf(before):
            assert row.schedule.last is not None
            return row.schedule.last
        return row.schedule.before(int(before))
