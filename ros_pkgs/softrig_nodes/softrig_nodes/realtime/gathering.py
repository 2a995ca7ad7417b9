"""The ticks of an observer that only listens, some at a time: against the wall clock each costs the others theirs.

To take in eight topics tick by tick is half the work of a loop of 20 kHz; what they said in a hundredth of a second is
taken in at once in a fifth of that time, with the same result (`Observer.at_once`).
"""

from __future__ import annotations

from array import array
from collections.abc import Mapping
from typing import Any

import numpy as np
from softrig_core.block.answer import Heard
from softrig_core.block.block import Observer
from softrig_core.block.link import Link
from softrig_core.block.port import Port, Sample
from softrig_core.block.step import Step
from softrig_core.timebase import SECOND
from softrig_core.verdict.watch import EVER

STRETCH = SECOND // 100  # ns: what it has seen is older by so much at most
NOTHING: Mapping[str, Any] = {}


class _Seen:
    """What has come on one input."""

    def __init__(self, port: Port) -> None:
        self.name, self._size = port.name, port.size
        self.newest = EVER
        self.stamps, self.values = array("q"), array("d")

    def messages(self) -> Heard:
        """Return what there is and begin anew."""
        stamps, values = np.frombuffer(self.stamps, np.int64), np.frombuffer(self.values)
        self.stamps, self.values = array("q"), array("d")
        return Heard(stamps, values.reshape(len(stamps), self._size))


class Gathering(Link):
    """Puts together what the ticks of an observer have seen.

    Parameters
    ----------
    step : Step
        Of an observer without outputs that takes messages at once; its inputs are being wired.
    ticks : int
        So many are taken in together.
    """

    READS = False

    def __init__(self, step: Step, ticks: int) -> None:
        super().__init__(step)
        self._most = ticks
        self._seen = [_Seen(port) for port in step.inputs]
        self._count, self._t = 0, 0

    def respond(self, x: Any, t: int, **inputs: Any) -> tuple[Any, Mapping[str, Any]]:
        """Keep what is new at a tick."""
        values, told = self.step.values, self.step.stamps
        for seen in self._seen:
            name = seen.name
            value = values[name]
            if value is None:
                continue
            stamp = told[name]()  # None: nobody has said anything, it holds what it began with
            if type(value) is Sample:
                stamp, value = value.stamp, value.data
            if stamp is None or stamp > t:
                stamp = t
            if stamp > seen.newest:
                seen.newest = stamp
                seen.stamps.append(stamp)
                seen.values.extend(value)
        self._count, self._t = self._count + 1, t
        return (x if self._count < self._most else self._taken(x)), NOTHING

    def _taken(self, x: Any) -> Any:
        """Let the block process the collected ticks."""
        if not self._count:
            return x
        self._count = 0
        messages = {seen.name: seen.messages() for seen in self._seen if seen.stamps}
        return self.step.block.at_once(x, self._t, messages)

    def settle(self) -> None:
        """Process the ticks collected so far."""
        self.step.x = self._taken(self.step.x)
        super().settle()


def gather(step: Step) -> None:
    """Let a step process some ticks in one batch, if it is an observer that can and is fast enough to pay off."""
    block, ticks = step.block, STRETCH // step.schedule.time(1)
    if ticks > 1 and isinstance(block, Observer) and not step.outputs and block.at_once(step.x, 0, NOTHING) is not None:
        Gathering(step, ticks)
