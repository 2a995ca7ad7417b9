"""Figures of the DC voltage while the rig runs, event by event."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import zip_longest
from typing import Any, NamedTuple

from softrig_core import Figure, Watch, WatchParams, executable, param, scalars
from softrig_core.judge import measures
from softrig_core.verdict.watch import Kept

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


class State(NamedTuple):
    """What was seen; reference and events of now; the newest changes of them, each (number, s, reference)."""

    seen: tuple[Kept, ...]
    cause: Any = None
    events: tuple[tuple[int, float, float], ...] = ()


class RectifierMonitor(Watch[RectifierMonitorParams]):
    """Least, largest and newest voltage, settling time and overshoot since each change of an event or the reference.

    ``event_0`` is the start. The settling time counts from the change to the first sample from which on the voltage has
    stayed within the band; it is left out while the voltage is outside. The figures of a scenario know the events of
    its file by their times; this finds every change of three kinds of events and of the reference and keeps them apart.
    """

    INPUTS = (DC_LINK, REFERENCE, events(NOMINAL.R_L, NOMINAL.V_g))

    def first(self) -> State:
        """No event yet."""
        return State(self.nothing)

    def update(
        self, x: State, t: int, *, dc_link: tuple[float, ...], reference: tuple[float, ...] | None,
        events: tuple[float, ...] | None,
    ) -> tuple[State, Mapping[str, Any]]:  # fmt: skip
        """Take one sample in."""
        w = self.p.set_point if reference is None else reference[0]
        seen, cause, past = x
        if not past or (w, events) != cause:
            cause = (w, events)
            past = (*past[1 - EVENTS :], (past[-1][0] + 1 if past else 0, t / 1e9, w))
        return State(self.keep(seen, t, {"dc_link": dc_link}), cause, past), {}

    def figures(self, x: State) -> Iterator[Figure]:
        """Figures of each event until the next one."""
        ends = [at - 0.5 * self.p.period for _, at, _ in x.events][1:]
        for (k, at, w), end in zip_longest(x.events, ends):
            part = {"signal": V_DC, "start": at, "end": end}
            yield self.figure(f"event_{k}_v_min", measures.minimum, part)
            yield self.figure(f"event_{k}_v_max", measures.maximum, part)
            yield self.figure(f"event_{k}_final", measures.final_value, part)
            yield self.figure(f"event_{k}_overshoot", measures.overshoot, part | {"final": w})
            band = {"final": w, "band": self.p.band, "at": "sample"}
            yield self.figure(f"event_{k}_settling", measures.settling_time, part | band)


main = executable(RectifierMonitor)
