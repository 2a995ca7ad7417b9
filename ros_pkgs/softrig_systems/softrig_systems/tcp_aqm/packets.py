"""Packet by packet: N window-controlled sources, one FIFO queue, and the heap of future events."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from softrig_core import jit

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

START, ACK, LOSS, SERVICE, CROSS = 0, 1, 2, 3, 4
NOBODY = -1  # owner of a packet that no source waits for


class Agenda(NamedTuple):
    """Binary heap of events by time: kind, flow, whether its packet was marked and when it was sent."""

    time: Floats
    kind: Ints
    flow: Ints
    marked: Ints
    sent: Floats


class Sources(NamedTuple):
    """For each flow: window, packets in flight, propagation time, time of the last halving, and whether it sends.

    The last field is its propagation time as a fraction of the nominal one.
    """

    window: Floats
    on_the_way: Ints
    propagation: Floats
    halved: Floats
    active: Ints
    spread: Floats


class Fifo(NamedTuple):
    """Ring of waiting packets, the one in service first: flow, mark, time of sending."""

    flow: Ints
    marked: Ints
    sent: Floats


# places in `Inside.counts`: pending events and the largest number of them, head of the ring and packets in it, packets
# served and lost, whether unowned packets arrive, and random numbers drawn
EVENTS, MOST_EVENTS, HEAD, WAITING, SERVED, LOST, CROSSING, DRAWN = range(8)


class Inside(NamedTuple):
    """Everything in flight, as native code changes it; `counts` has the places above."""

    sources: Sources
    agenda: Agenda
    fifo: Fifo
    counts: Ints


class Rules(NamedTuple):
    """Constants of a period: probability p, uncontrolled packets per second (evenly spaced), capacity C, buffer size.

    They also include the bounds of a window, and whether the queue drops packets instead of marking them.
    """

    p: float
    rate: float
    C: float
    room: int
    w_min: float
    w_max: float
    drop: bool


class Traffic:
    """All packets in flight, as an immutable value; the next state is computed on a copy.

    Parameters
    ----------
    inside : Inside
        It must not be modified from then on.
    """

    __slots__ = ("inside",)

    def __init__(self, inside: Inside) -> None:
        self.inside = inside

    def copy(self) -> Inside:
        """Return a copy that may be changed."""
        sources, agenda, fifo, counts = self.inside
        heap, size = Agenda._make([np.empty_like(a) for a in agenda]), counts[EVENTS]
        for new, old in zip(heap, agenda, strict=True):
            new[:size] = old[:size]
        copies = [a.copy() for a in sources[:-1]]
        return Inside(
            Sources._make([*copies, sources.spread]), heap, Fifo._make([a.copy() for a in fifo]), counts.copy()
        )

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Traffic):
            return NotImplemented
        return self._all() == other._all()

    def _all(self) -> list[list[float]]:
        sources, agenda, fifo, counts = self.inside
        return [a.tolist() for a in (*sources, *fifo, counts, *(a[: counts[EVENTS]] for a in agenda))]


@jit
def _move(agenda: Agenda, source: int, place: int) -> None:
    agenda.time[place], agenda.sent[place] = agenda.time[source], agenda.sent[source]
    agenda.kind[place], agenda.flow[place] = agenda.kind[source], agenda.flow[source]
    agenda.marked[place] = agenda.marked[source]


@jit
def schedule(agenda: Agenda, counts: Ints, t: float, kind: int, flow: int, marked: int, sent: float) -> None:
    """Push an event onto the heap."""
    index = counts[EVENTS]
    counts[EVENTS] = index + 1
    if index + 1 > counts[MOST_EVENTS]:
        counts[MOST_EVENTS] = index + 1
    while index > 0:
        above = (index - 1) // 2
        if agenda.time[above] <= t:
            break
        _move(agenda, above, index)
        index = above
    agenda.time[index], agenda.kind[index], agenda.flow[index] = t, kind, flow
    agenda.marked[index], agenda.sent[index] = marked, sent


@jit
def remove_first(agenda: Agenda, counts: Ints) -> None:
    """Pop the earliest event from the heap."""
    size = counts[EVENTS] - 1
    counts[EVENTS] = size
    t = agenda.time[size]
    index = 0
    while True:
        below = 2 * index + 1
        if below >= size:
            break
        if below + 1 < size and agenda.time[below + 1] < agenda.time[below]:
            below += 1
        if agenda.time[below] >= t:
            break
        _move(agenda, below, index)
        index = below
    _move(agenda, size, index)


@jit
def arrive(inside: Inside, now: float, flow: int, marked: int, C: float, room: int) -> bool:
    """Accept a packet into the queue; return false if there is no room."""
    _, agenda, fifo, counts = inside
    waiting = counts[WAITING]
    if waiting >= room:
        counts[LOST] += 1
        return False
    tail = (counts[HEAD] + waiting) % fifo.flow.size
    fifo.flow[tail], fifo.marked[tail], fifo.sent[tail] = flow, marked, now
    counts[WAITING] = waiting + 1
    if waiting == 0:
        schedule(agenda, counts, now + 1.0 / C, SERVICE, NOBODY, 0, 0.0)
    return True


@jit
def run_until(end: float, rules: Rules, rng: np.random.Generator, inside: Inside) -> None:
    """Run all events up to `end` (s).

    Congestion avoidance: an acknowledgement without a mark makes w + 1/w, one with a mark w/2 (floor `w_min`), at most
    once per round trip: packets sent before the last halving do not count. A source sends while fewer than floor(w) of
    its packets are on the way. The queue serves a packet in 1/C; an accepted packet is marked with probability p (with
    `drop` it is lost instead), one that arrives at a full queue is lost; a loss is noticed one propagation time later
    and counts as a mark.

    Parameters
    ----------
    end : float
        s.
    rng : numpy.random.Generator
        Draws one number for each packet that is sent.
    inside : Inside
        Is changed.
    """
    sources, agenda, fifo, counts = inside
    rate, C = rules.rate, rules.C
    if rate > 0.0 and counts[CROSSING] == 0:
        counts[CROSSING] = 1
        schedule(agenda, counts, end, CROSS, NOBODY, 0, 0.0)
    while counts[EVENTS] > 0 and agenda.time[0] <= end:
        now, kind, flow = agenda.time[0], agenda.kind[0], agenda.flow[0]
        marked, sent = agenda.marked[0], agenda.sent[0]
        remove_first(agenda, counts)
        if kind == SERVICE:
            head = counts[HEAD]
            flow = fifo.flow[head]
            counts[HEAD] = (head + 1) % fifo.flow.size
            counts[WAITING] -= 1
            counts[SERVED] += 1
            if counts[WAITING] > 0:
                schedule(agenda, counts, now + 1.0 / C, SERVICE, NOBODY, 0, 0.0)
            if flow != NOBODY:
                arrives = now + sources.propagation[flow]
                schedule(agenda, counts, arrives, ACK, flow, fifo.marked[head], fifo.sent[head])
            continue
        if kind == CROSS:
            if rate > 0.0:
                arrive(inside, now, NOBODY, 0, C, rules.room)
                schedule(agenda, counts, now + 1.0 / rate, CROSS, NOBODY, 0, 0.0)
            else:
                counts[CROSSING] = 0
            continue
        if kind != START:
            sources.on_the_way[flow] -= 1
            if marked == 0:
                sources.window[flow] = min(sources.window[flow] + 1.0 / sources.window[flow], rules.w_max)
            elif sent >= sources.halved[flow]:
                sources.window[flow] = max(0.5 * sources.window[flow], rules.w_min)
                sources.halved[flow] = now
        while sources.active[flow] == 1 and sources.on_the_way[flow] < int(sources.window[flow]):
            sources.on_the_way[flow] += 1
            counts[DRAWN] += 1
            hit = 1 if rng.random() < rules.p else 0
            lost = rules.drop and hit == 1
            if lost:
                counts[LOST] += 1
            elif not arrive(inside, now, flow, hit, C, rules.room):
                lost = True
            if lost:
                schedule(agenda, counts, now + sources.propagation[flow], LOSS, flow, 1, now)


@jit
def mean_window(sources: Sources) -> float:
    """Return the mean window of the flows that send, packets."""
    total, count = 0.0, 0
    for flow in range(sources.window.size):
        if sources.active[flow] == 1:
            total += sources.window[flow]
            count += 1
    return total / count
