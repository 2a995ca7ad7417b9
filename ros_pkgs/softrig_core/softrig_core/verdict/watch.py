"""Observers as a window and a list of figures: the functions that a recording is measured with, on a running rig."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from itertools import chain, islice, pairwise
from operator import itemgetter
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar

import numpy as np

from ..block.answer import Messages
from ..block.block import Observer
from ..block.params import BlockParams, param
from ..block.port import Port
from ..judge.measures import Function, newest_step
from ..judge.units import compose
from ..timebase import SECOND
from ..wire.signals import Signal, topic_of
from .figures import UNMEASURED, Figure


class WatchParams(BlockParams):
    """How far back the figures look."""

    window: float = param(60.0, "the figures are those of this last time", "s", gt=0.0, le=3600.0)


W = TypeVar("W", bound=WatchParams)
NONE: Mapping[str, Any] = MappingProxyType({})
BLOCK = 64  # messages


class Kept(NamedTuple):
    """Messages of one topic in the window, (stamp in ns, values) each: in full blocks, so that a tick copies few."""

    blocks: tuple[Sequence[tuple[int, Any]], ...] = ()
    newest: tuple[tuple[int, Any], ...] = ()
    """The block that is being filled; empty only where nothing is kept."""

    begin: int = 0
    """How many of the first block have left the window."""

    forgot: bool = False
    """Whether older messages were there."""

    def rows(self) -> Iterator[tuple[int, Any]]:
        """Give the messages, the oldest first."""
        return islice(chain(*self.blocks, self.newest), self.begin, None)

    def taken(self, stamp: int, values: Any, since: int) -> Kept:
        """Take a message in, if it is new; what is older than `since` leaves the window."""
        blocks, newest, begin, forgot = self
        if not newest or stamp > newest[-1][0]:
            if len(newest) < BLOCK:
                newest = (*newest, (stamp, values))
            else:
                blocks, newest = (*blocks, newest), ((stamp, values),)
        oldest = blocks[0] if blocks else newest
        while oldest[begin][0] < since:
            begin, forgot = begin + 1, True
            if begin == len(oldest):
                if not blocks:
                    return Kept(forgot=True)
                begin, blocks = 0, blocks[1:]
                oldest = blocks[0] if blocks else newest
        return Kept(blocks, newest, begin, forgot)

    def taken_at_once(self, messages: Messages, since: int) -> Kept:
        """Take new messages in, the oldest first; what `taken` would give that gets one after the other.

        No two of them, nor the newest that is kept, are further apart than what is kept reaches back from `since` on.
        """
        room = BLOCK - len(self.newest)
        more = (messages[k : k + BLOCK] for k in range(room, len(messages), BLOCK))
        blocks = [*self.blocks, (*self.newest, *messages[:room]), *more]  # the last is never empty
        gone = 0
        while blocks[gone] and blocks[gone][-1][0] < since:
            gone += 1
        begin = 0 if gone else self.begin
        after = bisect_left(blocks[gone], since, begin, key=itemgetter(0))
        return Kept(tuple(blocks[gone:-1]), tuple(blocks[-1]), after, self.forgot or after > self.begin or gone > 0)


class Window(NamedTuple):
    """What was seen: of each input, in the order of the ports. The first field of what a subclass remembers."""

    seen: tuple[Kept, ...]


class Watch(Observer[W]):
    """An observer that keeps what it saw in a window and measures it with figure functions when it is asked.

    Subclasses say `figures`; signals are named ``topic/channel/field`` with the port's own topic, whatever it is
    remapped to. Each message counts once, at its own stamp: a slower input is not repeated, and at the end of a run,
    where plants speak once more, a command of the tick before is not paired with them.

    One that remembers more has a state of its own with a field `seen`, at first `nothing`, which `keep` carries on.
    """

    def setup(self) -> None:
        """Find the units of the signals."""
        inputs, _ = self.ports(self.p)
        self._ports = {port.name: port for port in inputs}
        self._units = {f"{p.topic}/{label}": u for p in inputs for label, u in zip(p.labels, p.units, strict=True)}
        self._reach = round(self.p.window * SECOND)
        self.nothing = (Kept(),) * len(inputs)

    def first(self) -> Any:
        """Nothing seen yet."""
        return Window(self.nothing)

    def update(self, x: Any, t: int, **inputs: Any) -> tuple[Any, Mapping[str, tuple[float, ...]]]:
        """Keep what is new."""
        return Window(self.keep(x.seen, t, inputs)), {}

    def keep(self, seen: tuple[Kept, ...], t: int, inputs: Mapping[str, Any]) -> tuple[Kept, ...]:
        """Give what was seen with what is new in the inputs of a tick."""
        since, age, found = t - self._reach, self.age, []
        for name, kept in zip(self._ports, seen, strict=True):
            values = inputs.get(name)
            found.append(kept if values is None else kept.taken(t - (age(name) or 0), values, since))
        return tuple(found)

    def at_once(self, x: Any, t: int, messages: Mapping[str, Messages]) -> Any:
        """See `Observer.at_once`."""
        if type(self).update is not Watch.update:
            return None
        found, since = [], t - self._reach
        for name, kept in zip(self._ports, x.seen, strict=True):
            new = messages.get(name)
            if not new:
                found.append(kept)
                continue
            before, *_ = kept.newest[-1] if kept.newest else new[0]
            if t - before > self._reach < max(b - a for a, b in pairwise((before, *(m[0] for m in new), t))):
                return None
            found.append(kept.taken_at_once(new, since))
        return Window(tuple(found))

    def figure(self, name: str, function: Function, arguments: Mapping[str, Any] = NONE) -> Figure:
        """Make a figure, in the unit that its function and its signal give it."""
        unit = compose(getattr(function, "unit", ""), self._units.get(arguments.get("signal", ""), ""))
        return Figure(name, function, arguments, unit, 1.0)

    def figures(self, x: Any) -> Iterable[Figure]:
        """Give the figures; asked each time, so that they may depend on what was seen."""
        raise NotImplementedError

    def status(self, x: Any) -> Mapping[str, tuple[float, str]]:
        """Give the figures that can be measured so far; none of a step that the window has left behind."""
        signals = Seen(self._ports, {name: kept.rows() for name, kept in zip(self._ports, x.seen, strict=True)})
        forgot = {p.topic for p, kept in zip(self._ports.values(), x.seen, strict=True) if kept.forgot}
        found = {}
        for figure in self.figures(x):
            try:
                value = math.nan if left_behind(figure.since, signals, forgot) else figure(signals)
            except UNMEASURED:  # not enough samples yet
                continue
            if math.isfinite(value):
                found[figure.name] = (value, figure.unit)
        return found


def left_behind(since: str, signals: Seen, forgot: Container[str]) -> bool:
    """Whether the newest steps of signals were before what is kept of them: a first sample is none then."""
    return all(
        signals.topic(name) in forgot and newest_step(signals, name)[0] == signals[name].t[0]
        for name in since.split(", ")
    )


class Seen(Mapping[str, Signal]):
    """What a `Watch` keeps, as the signals that figure functions take."""

    def __init__(self, ports: Mapping[str, Port], rows: Mapping[str, Iterable[tuple[int, tuple[float, ...]]]]) -> None:
        self._ports = {port.topic: (port, rows[name]) for name, port in ports.items()}
        self._tables: dict[str, tuple[Any, Any]] = {}

    def topic(self, name: str) -> str:
        """Topic of a signal; empty where there is none."""
        return topic_of(name, self._ports)

    def __getitem__(self, name: str) -> Signal:
        topic = self.topic(name)
        if not topic or name[len(topic) + 1 :] not in self._ports[topic][0].labels:
            raise KeyError(name)
        port, rows = self._ports[topic]
        if topic not in self._tables:
            kept = list(rows)
            times = np.array([t for t, _ in kept], dtype=np.int64) / SECOND
            values = np.array([getattr(v, "data", v) for _, v in kept], dtype=np.float64).reshape(len(kept), port.size)
            self._tables[topic] = times, values
        times, values = self._tables[topic]
        return Signal(times, values[:, port.labels.index(name[len(topic) + 1 :])])

    def __iter__(self) -> Iterator[str]:
        for topic, (port, _) in self._ports.items():
            yield from (f"{topic}/{label}" for label in port.labels)

    def __len__(self) -> int:
        return sum(1 for _ in self)
