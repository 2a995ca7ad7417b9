"""Figures of the power flow controller while it runs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import NamedTuple

from softrig_core import Figure, Watch, WatchParams, executable, param
from softrig_core.judge import measures
from softrig_core.verdict.watch import Kept

from .figures import power_balance
from .ports import SERIES_REFERENCE, STATUS

FLOWS = ("p1", "q1", "p2", "q2")


class GupfcMonitorParams(WatchParams):
    """What counts as settled."""

    period: float = param(1.0 / 2880.0, "sampling period", "s", ge=1e-5, le=0.1)
    window: float = param(10.0, "the figures are those of this last time", "s", gt=0.0, le=3600.0)
    band: float = param(0.02, "half width of the band around a reference", "pu", gt=0.0, le=1.0)


class State(NamedTuple):
    """What was seen; the flows that are asked for (pu), and when (s) that changed."""

    seen: tuple[Kept, ...]
    asked: tuple[float, ...] = ()
    changed: float = 0.0


class GupfcMonitor(Watch[GupfcMonitorParams]):
    """Since the last change of a reference: settling times and mean errors of the flows, power balance; extremes.

    The settling time of a flow is the time from the change to the first sample from which on it stays in the band. The
    figures of a scenario count from a step of one reference, in parts of it; here a step of any disturbs all four
    flows, most of which are to stay where they are.
    """

    INPUTS = (STATUS, *(replace(port, name=f"series_{k}") for k, port in SERIES_REFERENCE.items()))

    def first(self) -> State:
        """No reference yet."""
        return State(self.nothing)

    def update(
        self, x: State, t: int, status: tuple[float, ...], series_1: tuple[float, ...] | None,
        series_2: tuple[float, ...] | None,
    ) -> tuple[State, Mapping[str, tuple[float, ...]]]:  # fmt: skip
        """Take one sample in."""
        seen, asked, changed = x
        if series_1 is not None and series_2 is not None and (*series_1, *series_2) != asked:
            asked, changed = (*series_1, *series_2), t / 1e9
        return State(self.keep(seen, t, {"status": status}), asked, changed), {}

    def _settling_time(self, signals: measures.SignalMap, signal: str, reference: float, start: float) -> float:
        found = measures.error_settling_time(signals, signal, reference=reference, band=self.p.band, start=start)
        return found - start

    def figures(self, x: State) -> Iterator[Figure]:
        """Extremes of the window, figures since the last change."""
        for name in ("v1", "v_dc"):
            signal = {"signal": f"gupfc/status/{name}/position"}
            yield self.figure(f"{name}_min", measures.minimum, signal)
            yield self.figure(f"{name}_max", measures.maximum, signal)
        if not x.asked:
            return
        for name, wanted in zip(FLOWS, x.asked, strict=True):
            error = {"signal": f"gupfc/status/{name}/position", "reference": wanted}
            yield Figure(f"{name}_settling_time", self._settling_time, error | {"start": x.changed}, "s", 1.0)
            yield self.figure(f"{name}_mean_error", measures.mean_error, error | {"start": x.changed})
        yield self.figure("power_balance", power_balance, {"start": x.changed})


main = executable(GupfcMonitor)
