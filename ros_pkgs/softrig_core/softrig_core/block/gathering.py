"""Batched ticks of an observer without outputs: processed one by one, they would slow down the other nodes.

Processing eight topics tick by tick is half the work of a 20 kHz loop. Processing their messages of a hundredth of a
second as one batch takes a fifth of that time, with the same result (`Batched.at_once`).
"""

from __future__ import annotations

from array import array
from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from ..timebase import SECOND
from .answer import Messages, ReceivedMessages
from .block import Block
from .link import Link
from .port import Port, Sample
from .step import Step

STRETCH = SECOND // 100  # ns: against the wall clock, what an observer has seen is older by so much at most
# The largest batch of a run in process, in ticks; a larger one saves no more time and takes memory.
MANY = 1 << 12
EVER = -(1 << 63)  # ns: earlier than all stamps
NOTHING: Mapping[str, Any] = {}


@runtime_checkable
class Batched(Protocol):
    """An observer that processes the messages of many ticks as one batch, with the same state as from its `update`.

    Attributes
    ----------
    in_batches : bool
        Whether it does; not necessarily for a subclass that overrides `update`.
    """

    in_batches: bool

    def at_once(self, x: Any, t: int, messages: Mapping[str, Messages]) -> Any:
        """Return the state after all messages that its ticks have received since the last call.

        Parameters
        ----------
        x : named tuple
        t : int
            The newest tick, ns.
        messages : mapping of str to sequence of (int, tuple of float)
            By input: stamp in ns and values of each message that its ticks have received, the oldest first. Inputs
            without a publisher are missing. A tuple, or `ReceivedMessages`.
        """


def takes_batches(block: Block) -> bool:
    """Return whether a block processes the messages of many ticks as one batch."""
    return isinstance(block, Batched) and block.in_batches


class _Stream:
    """The messages received on one input."""

    def __init__(self, port: Port) -> None:
        self.name, self._size = port.name, port.size
        self.newest = EVER
        self.stamps, self.values = array("q"), array("d")

    def messages(self) -> ReceivedMessages:
        """Return the collected messages and clear the collection."""
        stamps, values = np.frombuffer(self.stamps, np.int64), np.frombuffer(self.values)
        # New arrays: an array whose memory numpy refers to cannot grow (BufferError).
        self.stamps, self.values = array("q"), array("d")
        return ReceivedMessages(stamps, values.reshape(len(stamps), self._size))


class Gathering(Link):
    """Collects the messages that the ticks of an observer have received.

    Parameters
    ----------
    step : Step
        Of an observer without outputs that processes messages in batches; its inputs are being wired.
    ticks : int
        Number of messages processed together.
    """

    READS = False

    def __init__(self, step: Step, ticks: int) -> None:
        super().__init__(step)
        self._most = ticks
        self._seen = [_Stream(port) for port in step.inputs]
        self._count, self._t = 0, 0

    def respond(self, x: Any, t: int, **inputs: Any) -> tuple[Any, Mapping[str, Any]]:
        """Store new messages at a tick."""
        values, stamps = self.step.values, self.step.stamps
        for stream in self._seen:
            name = stream.name
            value = values[name]
            if value is None:
                continue
            stamp = stamps[name]()  # None: nothing was published, so it holds its initial value
            if type(value) is Sample:
                stamp, value = value.stamp, value.data
            # A value without a stamp, or with one from the future of this tick, counts from this tick on.
            if stamp is None or stamp > t:
                stamp = t
            if stamp > stream.newest:
                stream.newest = stamp
                stream.stamps.append(stamp)
                stream.values.extend(value)
        self._count, self._t = self._count + 1, t
        return (x if self._count < self._most else self._processed(x)), NOTHING

    def _processed(self, x: Any) -> Any:
        """Let the block process the collected ticks."""
        if not self._count:
            return x
        self._count = 0
        messages = {stream.name: stream.messages() for stream in self._seen if stream.name in self.step.stamps}
        return self.step.block.at_once(x, self._t, messages)  # type: ignore[attr-defined]

    def send_all(self, times: NDArray[np.int64], numbers: NDArray[np.float64], stamps: NDArray[np.int64]) -> None:
        """Pass on ticks of native code, which has processed their messages."""
        assert self.inner is not None
        self.inner.send_all(times, numbers, stamps)

    def settle(self) -> None:
        """Let the block process all ticks collected so far."""
        self.step.x = self._processed(self.step.x)
        super().settle()


def gather(step: Step, ticks: int) -> None:
    """Let a step process several ticks in one batch, if it has no outputs and its block supports batches."""
    if ticks > 1 and not step.outputs and takes_batches(step.block):
        Gathering(step, ticks)
