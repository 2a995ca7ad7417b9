"""Observers as a window and a list of figures: the functions that a recording is measured with, on a running rig."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np

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


class Watch(Observer[W]):
    """An observer that keeps what it saw in a window and measures it with figure functions when it is asked.

    Subclasses say `figures`; signals are named ``topic/channel/field`` with the port's own topic, whatever it is
    remapped to. Each message counts once, at its own stamp: a slower input is not repeated, and at the end of a run,
    where plants speak once more, a command of the tick before is not paired with them.
    """

    def start(self) -> None:
        """Nothing seen yet."""
        inputs, _ = self.ports(self.p)
        self._ports = {port.name: port for port in inputs}
        self._units = {f"{p.topic}/{label}": u for p in inputs for label, u in zip(p.labels, p.units, strict=True)}
        self._rows: dict[str, deque[tuple[int, Any]]] = {port.name: deque() for port in inputs}
        self._reach = round(self.p.window * SECOND)
        self._forgot: set[str] = set()  # topics of which older messages were there

    def update(self, t: int, **inputs: Any) -> Mapping[str, tuple[float, ...]]:
        """Keep what is new."""
        first, age, kept = t - self._reach, self.age, self._rows
        for name, values in inputs.items():
            if values is None:
                continue
            stamp, rows = t - (age(name) or 0), kept[name]
            if not rows or stamp > rows[-1][0]:
                rows.append((stamp, values))
            while rows and rows[0][0] < first:
                rows.popleft()
                self._forgot.add(self._ports[name].topic)
        return {}

    def figure(self, name: str, function: Function, arguments: Mapping[str, Any] = NONE) -> Figure:
        """Make a figure, in the unit that its function and its signal give it."""
        unit = compose(getattr(function, "unit", ""), self._units.get(arguments.get("signal", ""), ""))
        return Figure(name, function, arguments, unit, 1.0)

    def figures(self) -> Iterable[Figure]:
        """Give the figures; asked each time, so that they may depend on what was seen."""
        raise NotImplementedError

    def status(self) -> Mapping[str, tuple[float, str]]:
        """Give the figures that can be measured so far; none of a step that the window has left behind."""
        signals = Seen(self._ports, self._rows)
        found = {}
        for figure in self.figures():
            try:
                value = math.nan if self._left_behind(figure.since, signals) else figure(signals)
            except UNMEASURED:  # not enough samples yet
                continue
            if math.isfinite(value):
                found[figure.name] = (value, figure.unit)
        return found

    def _left_behind(self, since: str, signals: Seen) -> bool:
        """Whether the newest step of a signal was before what is kept of it: its first sample is none then."""
        forgot = signals.topic(since) in self._forgot
        return forgot and newest_step(signals, since)[0] == signals[since].t[0]


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
