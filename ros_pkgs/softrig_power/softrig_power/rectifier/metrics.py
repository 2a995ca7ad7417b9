"""Figures of the DC voltage while the rig runs, event by event."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from softrig_core.model.block import Observer
from softrig_core.model.params import BlockParams, param
from softrig_core.model.port import scalars
from softrig_core.node import executable

from .parameters import RectifierConstants
from .ports import DC_LINK, events

NOMINAL = RectifierConstants()
REFERENCE = scalars("reference", "reference", {"v_dc": "V"}, held=True)


class RigMetricsParams(BlockParams):
    """Settling band and set point."""

    period: float = param(0.00083, "sampling period", "s", gt=0.0, le=0.1)
    band: float = param(0.02, "settling band as a fraction of the reference", gt=0.0, le=0.5)
    set_point: float = param(400.0, "reference until one arrives", "V", gt=0.0, le=1e4)


class RigMetrics(Observer):
    """Least, largest and newest voltage, settling time and overshoot since each change of an event or the reference.

    ``event_0`` is the start. The settling time counts from the change to the first sample from which on the voltage has
    stayed within the band; it is left out while the voltage is outside.
    """

    Params = RigMetricsParams
    INPUTS = (DC_LINK, REFERENCE, events(NOMINAL.R_L, NOMINAL.V_g))

    def start(self) -> None:
        """No event yet."""
        self._cause: Any = None
        self._records: list[_Record] = []

    def update(
        self, t: int, *, dc_link: tuple[float, ...], reference: tuple[float, ...] | None,
        events: tuple[float, ...] | None,
    ) -> Mapping[str, Any]:  # fmt: skip
        """Take one sample in."""
        w = self.p.set_point if reference is None else reference[0]
        if not self._records or (w, events) != self._cause:
            self._cause = (w, events)
            self._records.append(_Record(t / 1e9, w, self.p.band * abs(w)))
        self._records[-1].add(t / 1e9, dc_link[0])
        return {}

    def status(self) -> Mapping[str, tuple[float, str]]:
        """Give the figures of all events so far."""
        return {f"event_{k}_{n}": x for k, record in enumerate(self._records) for n, x in record.status().items()}


class _Record:
    """Figures since one event."""

    def __init__(self, t: float, reference: float, band: float) -> None:
        self._start, self._w, self._band = t, reference, band
        self._low, self._high, self._v = float("inf"), float("-inf"), 0.0
        self._settled: float | None = None

    def add(self, t: float, v: float) -> None:
        self._low, self._high, self._v = min(self._low, v), max(self._high, v), v
        if abs(v - self._w) > self._band:
            self._settled = None
        elif self._settled is None:
            self._settled = t - self._start

    def status(self) -> Mapping[str, tuple[float, str]]:
        found = {
            "v_min": (self._low, "V"),
            "v_max": (self._high, "V"),
            "final": (self._v, "V"),
            "overshoot": (max(0.0, self._high - self._w), "V"),
        }
        return found if self._settled is None else {**found, "settling": (self._settled, "s")}


main = executable(RigMetrics)
