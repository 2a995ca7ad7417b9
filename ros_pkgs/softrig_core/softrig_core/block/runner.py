"""The runner: steps the local members of a rig in order. What a tick is, once; see `doc/tick.md`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import count

from .block import Plant
from .schedule import Schedule
from .step import Step

KNOWN = 10_000  # ticks of which it is kept who is due
YOUNG = 200_000  # new objects between two searches for reference cycles: what a tick makes dies with it


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
        self.schedule = Schedule(schedule.clock * stride)
        self._members = [(s, s.schedule.every // stride) for s in self.steps]
        self._again = math.lcm(*(every for _, every in self._members))  # ticks after which the same are due
        self._known: dict[int, tuple[list[tuple[Step, int]], list[Step]]] = {}

    def run(self, first: int = 0) -> Iterator[int | None]:
        """Answer tick after tick.

        Parameters
        ----------
        first : int
            Tick to begin with, where the members are in the state of then.

        Yields
        ------
        int or None
            The time of a tick that is over, ns; None again and again while the next one to answer lacks something.

        Raises
        ------
        RunError
            A block failed, or gave what may not leave it.
        """
        ticks, time, known, again = self.ticks, self.schedule.time, self._known, self._again
        for k in count(first) if ticks is None else range(first, ticks + 1):
            t = time(k)
            plants, others = known.get(k % again) or self._due(k)
            for plant, _ in plants:
                plant.say(t)
            lacking = _say(others if k != ticks else [s for s in others if t == s.schedule.last], t)
            while lacking:  # what it waits for may need what another one here has to say
                yield None
                lacking = _say(lacking, t)
            for plant, every in plants:
                if ticks is None or k + every <= ticks:
                    while plant.link is not None and plant.link.lacks(t):
                        yield None
                    plant.advance(t)
            yield t

    def _due(self, k: int) -> tuple[list[tuple[Step, int]], list[Step]]:
        """Give the plants that are due at a tick, with their ticks to the next one, and the others."""
        due = [(s, every) for s, every in self._members if k % every == 0]
        plants = [(s, every) for s, every in due if isinstance(s.block, Plant)]
        found = plants, [s for s, _ in due if not isinstance(s.block, Plant)]
        if self._again <= KNOWN:
            self._known[k % self._again] = found
        return found


def _say(steps: Sequence[Step], t: int) -> list[Step]:
    """Have those speak that lack nothing; gives the others."""
    lacking: list[Step] = []
    for step in steps:
        waits = lacking and any(fill.source in lacking for fill in step.fed.values())
        if waits or (step.link is not None and step.link.lacks(t)):
            lacking.append(step)
        else:
            step.say(t)
    return lacking
