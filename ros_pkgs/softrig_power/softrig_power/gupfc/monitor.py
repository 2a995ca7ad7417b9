"""Figures of the power flow controller while it runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from softrig_core.model.block import Observer
from softrig_core.model.params import BlockParams, param
from softrig_core.node import executable

from .ports import SERIES_REFERENCE, STATUS

FLOWS = ("p1", "q1", "p2", "q2")
INDEX = {name: k for k, name in enumerate(STATUS.channels)}


class GupfcMonitorParams(BlockParams):
    """What counts as settled."""

    period: float = param(1.0 / 2880.0, "sampling period", "s", ge=1e-5, le=0.1)
    band: float = param(0.02, "half width of the band around a reference", "pu", gt=0.0, le=1.0)


class GupfcMonitor(Observer):
    """Since the last change of a reference: settling times and mean errors of the flows; extremes; power balance.

    In constant memory. The settling time of a flow is the time from the change to the last sample outside the band.
    """

    Params = GupfcMonitorParams
    INPUTS = (STATUS, *(replace(port, name=f"series_{k}") for k, port in SERIES_REFERENCE.items()))

    def start(self) -> None:
        """Nothing seen."""
        self._asked: tuple[float, ...] | None = None
        self._changed = 0.0
        self._outside = dict.fromkeys(FLOWS, 0.0)
        self._errors = dict.fromkeys(FLOWS, 0.0)
        self._balance = 0.0
        self._count = 0
        self._extremes = {name: (float("inf"), -float("inf")) for name in ("v1", "v_dc")}

    def update(
        self, t: int, status: tuple[float, ...], series_1: tuple[float, ...] | None, series_2: tuple[float, ...] | None
    ) -> Mapping[str, tuple[float, ...]]:
        """Take one sample in."""
        seconds = t / 1e9
        for name, (low, high) in self._extremes.items():
            self._extremes[name] = min(low, status[INDEX[name]]), max(high, status[INDEX[name]])
        if series_1 is None or series_2 is None:
            return {}
        asked = (*series_1, *series_2)
        if asked != self._asked:
            self._asked, self._changed, self._count, self._balance = asked, seconds, 0, 0.0
            self._outside = dict.fromkeys(FLOWS, seconds)
            self._errors = dict.fromkeys(FLOWS, 0.0)
        self._count += 1
        self._balance += sum(status[INDEX[name]] for name in ("p_sh", "p12", "p34"))
        for name, wanted in zip(FLOWS, asked, strict=True):
            error = wanted - status[INDEX[name]]
            self._errors[name] += error
            if abs(error) > self.p.band:
                self._outside[name] = seconds + self.p.period
        return {}

    def status(self) -> Mapping[str, tuple[float, str]]:
        """Give the figures so far."""
        found = {f"{name}_min": (low, "pu") for name, (low, _) in self._extremes.items() if low < float("inf")}
        found |= {f"{name}_max": (high, "pu") for name, (_, high) in self._extremes.items() if high > -float("inf")}
        if self._count:
            found |= {f"{name}_settling_time": (self._outside[name] - self._changed, "s") for name in FLOWS}
            found |= {f"{name}_mean_error": (self._errors[name] / self._count, "pu") for name in FLOWS}
            found["power_balance"] = (self._balance / self._count, "pu")
        return found


main = executable(GupfcMonitor)
