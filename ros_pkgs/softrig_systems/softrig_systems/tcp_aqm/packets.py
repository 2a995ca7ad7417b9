"""Packet by packet: N window-controlled sources, one FIFO queue, and the heap of what happens next."""

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
    """Per flow: window, packets on the way, propagation time, time of the last halving, and whether it sends."""

    window: Floats
    on_the_way: Ints
    propagation: Floats
    halved: Floats
    active: Ints


class Fifo(NamedTuple):
    """Ring of waiting packets, the one in service first: flow, mark, time of sending."""

    flow: Ints
    marked: Ints
    sent: Floats


class Counts(NamedTuple):
    """What changes from event to event, each an array of one number."""

    events: Ints
    most_events: Ints
    head: Ints
    waiting: Ints
    served: Ints
    lost: Ints
    crossing: Ints


@jit
def schedule(agenda: Agenda, counts: Counts, t: float, kind: int, flow: int, marked: int, sent: float) -> None:
    """Put an event on the heap."""
    place = counts.events[0]
    counts.events[0] = place + 1
    if place + 1 > counts.most_events[0]:
        counts.most_events[0] = place + 1
    while place > 0:
        above = (place - 1) // 2
        if agenda.time[above] <= t:
            break
        agenda.time[place], agenda.kind[place], agenda.flow[place] = (
            agenda.time[above], agenda.kind[above], agenda.flow[above],
        )  # fmt: skip
        agenda.marked[place], agenda.sent[place] = agenda.marked[above], agenda.sent[above]
        place = above
    agenda.time[place], agenda.kind[place], agenda.flow[place] = t, kind, flow
    agenda.marked[place], agenda.sent[place] = marked, sent


@jit
def remove_first(agenda: Agenda, counts: Counts) -> None:
    """Take the earliest event off the heap."""
    size = counts.events[0] - 1
    counts.events[0] = size
    t = agenda.time[size]
    place = 0
    while True:
        below = 2 * place + 1
        if below >= size:
            break
        if below + 1 < size and agenda.time[below + 1] < agenda.time[below]:
            below += 1
        if agenda.time[below] >= t:
            break
        agenda.time[place], agenda.kind[place], agenda.flow[place] = (
            agenda.time[below], agenda.kind[below], agenda.flow[below],
        )  # fmt: skip
        agenda.marked[place], agenda.sent[place] = agenda.marked[below], agenda.sent[below]
        place = below
    agenda.time[place], agenda.kind[place], agenda.flow[place] = t, agenda.kind[size], agenda.flow[size]
    agenda.marked[place], agenda.sent[place] = agenda.marked[size], agenda.sent[size]


@jit
def arrive(agenda: Agenda, fifo: Fifo, counts: Counts, now: float, flow: int, marked: int, C: float, room: int) -> bool:
    """Let a packet into the queue; false when there is no room."""
    waiting = counts.waiting[0]
    if waiting >= room:
        counts.lost[0] += 1
        return False
    place = (counts.head[0] + waiting) % fifo.flow.size
    fifo.flow[place], fifo.marked[place], fifo.sent[place] = flow, marked, now
    counts.waiting[0] = waiting + 1
    if waiting == 0:
        schedule(agenda, counts, now + 1.0 / C, SERVICE, NOBODY, 0, 0.0)
    return True


@jit
def run_until(
    end: float, p: float, rate: float, C: float, room: int, w_min: float, w_max: float, drop: bool,
    rng: np.random.Generator, sources: Sources, agenda: Agenda, fifo: Fifo, counts: Counts,
) -> None:  # fmt: skip
    """Let everything up to `end` (s) happen.

    Congestion avoidance: an acknowledgement without a mark makes w + 1/w, one with a mark w/2 (floor `w_min`), at
    most once per round trip: packets sent before the last halving do not count. A source sends while fewer than
    floor(w) of its packets are on the way. The queue serves a packet in 1/C; an accepted packet is marked with
    probability p (with `drop` it is lost instead), one that finds no room is lost; a loss is noticed one propagation
    time later and counts as a mark.

    Parameters
    ----------
    rate : float
        Packets of nobody per second, evenly spaced.
    room : int
        Largest number of packets that wait or are served.
    """
    if rate > 0.0 and counts.crossing[0] == 0:
        counts.crossing[0] = 1
        schedule(agenda, counts, end, CROSS, NOBODY, 0, 0.0)
    while counts.events[0] > 0 and agenda.time[0] <= end:
        now, kind, flow = agenda.time[0], agenda.kind[0], agenda.flow[0]
        marked, sent = agenda.marked[0], agenda.sent[0]
        remove_first(agenda, counts)
        if kind == SERVICE:
            head = counts.head[0]
            flow = fifo.flow[head]
            counts.head[0] = (head + 1) % fifo.flow.size
            counts.waiting[0] -= 1
            counts.served[0] += 1
            if counts.waiting[0] > 0:
                schedule(agenda, counts, now + 1.0 / C, SERVICE, NOBODY, 0, 0.0)
            if flow != NOBODY:
                arrives = now + sources.propagation[flow]
                schedule(agenda, counts, arrives, ACK, flow, fifo.marked[head], fifo.sent[head])
            continue
        if kind == CROSS:
            if rate > 0.0:
                arrive(agenda, fifo, counts, now, NOBODY, 0, C, room)
                schedule(agenda, counts, now + 1.0 / rate, CROSS, NOBODY, 0, 0.0)
            else:
                counts.crossing[0] = 0
            continue
        if kind != START:
            sources.on_the_way[flow] -= 1
            if marked == 0:
                sources.window[flow] = min(sources.window[flow] + 1.0 / sources.window[flow], w_max)
            elif sent >= sources.halved[flow]:
                sources.window[flow] = max(0.5 * sources.window[flow], w_min)
                sources.halved[flow] = now
        while sources.active[flow] == 1 and sources.on_the_way[flow] < int(sources.window[flow]):
            sources.on_the_way[flow] += 1
            hit = 1 if rng.random() < p else 0
            lost = drop and hit == 1
            if lost:
                counts.lost[0] += 1
            elif not arrive(agenda, fifo, counts, now, flow, hit, C, room):
                lost = True
            if lost:
                schedule(agenda, counts, now + sources.propagation[flow], LOSS, flow, 1, now)


@jit
def mean_window(sources: Sources) -> float:
    """Give the mean window of the flows that send, packets."""
    total, count = 0.0, 0
    for flow in range(sources.window.size):
        if sources.active[flow] == 1:
            total += sources.window[flow]
            count += 1
    return total / count
