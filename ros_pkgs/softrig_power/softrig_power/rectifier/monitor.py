"""Figures of the DC voltage while the rig runs, event by event."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from itertools import zip_longest
from typing import Any

from softrig_core import Figure, Watch, WatchParams, executable, param, scalars
from softrig_core.judge import measures

from .parameters import RectifierConstants
from .ports import DC_LINK, events

NOMINAL = RectifierConstants()
REFERENCE = scalars("reference", "reference", {"v_dc": "V"}, held=True)
V_DC = "dc_link/voltage/position"
EVENTS = 100  # the newest; a reference that ramps is an event at each tick


class RectifierMonitorParams(WatchParams):
    """Settling band and set point."""

    period: float = param(0.00083, "sampling period", "s", gt=0.0, le=0.1)
    band: float = param(0.02, "settling band as a fraction of the reference", gt=0.0, le=0.5)
    set_point: float = param(400.0, "reference until one arrives", "V", gt=0.0, le=1e4)


class RectifierMonitor(Watch[RectifierMonitorParams]):
    """Least, largest and newest voltage, settling time and overshoot since each change of an event or the reference.

    ``event_0`` is the start. The settling time counts from the change to the first sample from which on the voltage has
    stayed within the band; it is left out while the voltage is outside. The figures of a scenario know the events of
    its file by their times; this finds every change of three kinds of events and of the reference and keeps them apart.
    """

    INPUTS = (DC_LINK, REFERENCE, events(NOMINAL.R_L, NOMINAL.V_g))

    def start(self) -> None:
        """No event yet."""
        super().start()
        self._cause: Any = None
        self._events: deque[tuple[int, float, float]] = deque(maxlen=EVENTS)  # number, s, reference

    def update(
        self, t: int, *, dc_link: tuple[float, ...], reference: tuple[float, ...] | None,
        events: tuple[float, ...] | None,
    ) -> Mapping[str, Any]:  # fmt: skip
        """Take one sample in."""
        w = self.p.set_point if reference is None else reference[0]
        if not self._events or (w, events) != self._cause:
            self._cause = (w, events)
            self._events.append((self._events[-1][0] + 1 if self._events else 0, t / 1e9, w))
        return super().update(t, dc_link=dc_link)

    def figures(self) -> Iterator[Figure]:
        """Figures of each event until the next one."""
        ends = [at - 0.5 * self.p.period for _, at, _ in self._events][1:]
        for (k, at, w), end in zip_longest(self._events, ends):
            part = {"signal": V_DC, "start": at, "end": end}
            yield self.figure(f"event_{k}_v_min", measures.minimum, part)
            yield self.figure(f"event_{k}_v_max", measures.maximum, part)
            yield self.figure(f"event_{k}_final", measures.final_value, part)
            yield self.figure(f"event_{k}_overshoot", measures.overshoot, part | {"final": w})
            band = {"final": w, "band": self.p.band, "at": "sample"}
            yield self.figure(f"event_{k}_settling", measures.settling_time, part | band)


main = executable(RectifierMonitor)
