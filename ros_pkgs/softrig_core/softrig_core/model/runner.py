"""The runner: steps the local members of a rig in order. What a tick is, once; see `doc/tick.md`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import count

from .block import Plant
from .schedule import Schedule
from .step import Step


class Runner:
    """The members of a rig that live in this process: all of them, some, or one.

    Parameters
    ----------
    steps : sequence of Step
        Plants first, then the others, each after those that it reads. Their schedules have one clock and end together.
    """

    def __init__(self, steps: Sequence[Step]) -> None:
        self.steps = tuple(steps)
        schedule = steps[0].schedule
        stride = math.gcd(*(s.schedule.every for s in steps))  # of the clock's ticks, those at which anybody is due
        self.ticks = None if schedule.ticks is None else schedule.ticks // stride
        self._time = Schedule(schedule.clock * stride).time
        due = [(s, s.schedule.every // stride) for s in self.steps]
        self._plants = [(s, every) for s, every in due if isinstance(s.block, Plant)]
        self._others = [(s, every) for s, every in due if not isinstance(s.block, Plant)]

    def run(self) -> Iterator[int | None]:
        """Answer tick after tick.

        Yields
        ------
        int or None
            The time of a tick that is over, ns; None again and again while the next one to answer lacks something.

        Raises
        ------
        RunError
            A block failed, or gave what may not leave it.
        """
        ticks, time = self.ticks, self._time
        for k in count() if ticks is None else range(ticks + 1):
            t = time(k)
            for plant, every in self._plants:
                if k % every == 0:
                    plant.say(t)
            waiting = [
                step for step, every in self._others
                if k % every == 0 and (ticks is None or k < ticks or t == step.schedule.last)
            ]  # fmt: skip
            while waiting:
                lacking: list[Step] = []
                for step in waiting:
                    if step.lacks is not None and (any(s in lacking for s in step.sources) or step.lacks(t)):
                        lacking.append(step)
                    else:
                        step.say(t)
                if lacking:  # what it waits for may need what another one here has to say
                    yield None
                waiting = lacking
            for plant, every in self._plants:
                if k % every == 0 and (ticks is None or k + every <= ticks):
                    while plant.lacks is not None and plant.lacks(t):
                        yield None
                    plant.advance(t)
            yield t
