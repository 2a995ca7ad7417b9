"""Record the messages of external nodes, by their first subscriber in the rig, or without one by the starter.

Our nodes record what they publish; an external node records nothing. In lockstep each message is recorded at its own
time, even if a slower reader does not use it. In real time a reader records a message at the tick that uses it, so that
a repetition of the run uses it at the same tick (`LiveSenders.record`). The recorder then records only the messages
after the last tick.

The recorder waits for the publishers at the start and for the last messages at the end, each for a bounded time: an
external node need not have all outputs of the node that it replaces.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from softrig_core.block.block import Level
from softrig_core.block.port import Refused
from softrig_core.rig.options import OverheardLink

from ..seam.endpoint import Input
from ..seam.middleware import Reader

if TYPE_CHECKING:
    from .adapter import Adapter

FILLED = 4  # bytes: DDS sends a multiple of them
PATIENCE = 1.0  # s without a publisher at the start, or without a message at the end


class Overheard(Input):
    """One topic of an external node.

    Parameters
    ----------
    node : Adapter
        The recorder.
    number : int
        Of the topic in the record.
    read : bool
        Whether it is an input of the recorder.

    Attributes
    ----------
    used : bool
        Whether the reader records the messages itself.
    """

    def __init__(self, topics: OverheardTopics, node: Adapter, link: OverheardLink, number: int, read: bool) -> None:
        super().__init__(link.made())
        self._node, self._number, self._sporadic = node, number, link.sporadic
        self._schedule = node.peer(link)
        self._length = self.port.layout().length
        self._stamped = self.port.stamped and not link.delayed
        self.read_here = read
        self._live = node.options.mode == "realtime"
        self.used = read and self._live  # what the reader records
        self.topics = topics
        self._count = 0
        self._newest = -1  # time of the newest message in the record, ns from t = 0
        self._last = b""

    def receive(self, data: bytes) -> None:
        """Record a message, and restart the timeout of its topic."""
        # Before t = 0 is set in real time, and after the run, it belongs to no tick.
        if self._node.state == "running" or (self._node.state, self._node.options.mode) == ("starting", "lockstep"):
            self._record(data)
            self.topics.restart_timeout()

    def _record(self, data: bytes) -> None:
        """Record a message unless it is published again for late subscribers, or no input would accept it."""
        node = self._node
        try:
            mark, values = self.decode(data)
        except Refused as error:
            self.refused += 1
            text = f"{self.refused} messages on {self.port.topic} are not recorded: {error}"
            node.step.note(Level.WARN, f"unrecorded {self.port.topic}", text)
            return
        # As in a reader, channels that a partial message leaves out keep these values.
        self.decode.kept = values
        self.received_any = True
        # A message equal to the last one is a repetition if it has a stamp or a number. Without either this is only
        # certain of the first message, before the first tick: later ones may be two with the same values.
        known = self._stamped or (self.port.type.shaped and mark >= 0)
        if node.record.sink is None or (data == self._last and (known or (self._count == 1 and not node.ticks))):
            return
        self._last = bytes(data)
        # DDS fills up the message of a boolean, which would then differ from that of the same node in the rig.
        stored = self._last[: self._length] if 0 < len(data) - self._length < FILLED else self._last
        self._newest = max(self._newest, self._time(mark))
        self._count += 1
        if not self.used:
            node.record.sink.add(self._number, node.epoch + self._newest, stored)

    def _time(self, mark: int) -> int:
        """Return the time to which a message belongs, ns from t = 0."""
        node, end = self._node, self._node.schedule.end
        if self._stamped:
            if mark >= node.epoch and (end is None or mark - node.epoch <= end):
                return mark - int(node.epoch)
            text = f"{self.port.topic} is recorded when it arrives, for its stamps are no times of the run"
            node.step.note(Level.WARN, f"stamps of {self.port.topic}", text)
            return int(node.t)
        if self._sporadic or self._live:
            return int(node.t)
        due = self._schedule.time(mark if self.port.type.shaped and mark >= 0 else self._count)
        return due if end is None or due <= end else int(node.t)

    @property
    def complete(self) -> bool:
        """Return whether no message is missing, as far as this can be known."""
        last = self._schedule.last
        return self._sporadic or not self.publishers or last is None or self._newest >= last


class _Both(Reader):
    """Records the messages of an input and passes them to it."""

    def __init__(self, row: Overheard, item: Input) -> None:
        self._row, self._item, self.numbered = row, item, item.numbered

    def receive(self, data: bytes) -> None:
        # It is recorded first, because the input may answer the last tick at once and end the run.
        self._row.receive(data)
        self._item.receive(data)

    def matched(self, count: int) -> None:
        self._row.matched(count)
        self._item.matched(count)


class OverheardTopics:
    """All topics of external nodes that a node records.

    Parameters
    ----------
    numbers : sequence of int
        Of the topics in the record, in the order of `Links.overheard`.
    """

    def __init__(self, node: Adapter, numbers: Sequence[int]) -> None:
        self._node = node
        read = {node.middleware.resolve(p.topic) for p in node.step.inputs}
        links = [(link, node.of_rig(link.shape["topic"])) for link in node.links.overheard]
        self._rows = {
            topic: Overheard(self, node, link, number, topic in read)
            for (link, topic), number in zip(links, numbers, strict=True)
        }
        self._since: dict[str, float] = {}  # wall-clock time since when the start, or the end, is waited for, s
        self._then: Callable[[], object] = lambda: None

    def subscribe(self, callback: Callable[[], object]) -> None:
        """Subscribe to the topics that are no inputs; `callback` is called after each message of any.

        This must be done before the inputs are offered: an external node may begin when those are matched.
        """
        self._then = callback
        for topic, row in self._rows.items():
            if not row.read_here:
                self._node.middleware.subscribe(topic, row.port.msgtype, row)

    def recorded_reader(self, item: Input) -> Reader:
        """Return the receiver of an input's messages, which also records them."""
        row = self._rows.get(self._node.middleware.resolve(item.port.topic))
        return item if row is None else _Both(row, item)

    def restart_timeout(self) -> None:
        """Restart the timeout: the wait for a slow publisher continues as long as it publishes."""
        self._since.pop("end", None)
        self._then()

    def over(self) -> None:
        """Record every message from now on, because the node has answered its last tick."""
        for row in self._rows.values():
            row.used = False

    def absent(self) -> list[str]:
        """Describe the topics of publishers for which the node still waits at the start."""
        lacking = [row.port.topic for row in self._rows.values() if not row.publishers and not row.received_any]
        if lacking and self._waits("start"):
            return [f"no publisher on {topic} yet (of an external node)" for topic in lacking]
        for topic in lacking:
            text = f"no node publishes {topic}, as an external node should: it is not recorded"
            self._node.step.note(Level.WARN, f"unrecorded {topic}", text)
        return []

    def complete(self) -> bool:
        """Return whether the node may leave: the last messages have arrived, or the wait for them has ended."""
        return all(row.complete for row in self._rows.values()) or not self._waits("end")

    def _waits(self, key: str) -> bool:
        now = self._node.middleware.steady()
        return bool(now - self._since.setdefault(key, now) < PATIENCE)
