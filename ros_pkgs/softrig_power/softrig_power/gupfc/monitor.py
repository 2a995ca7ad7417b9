"""Figures of the power flow controller while it runs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

from softrig_core import Figure, Watch, WatchParams, executable, param
from softrig_core.judge import measures

from .figures import power_balance
from .ports import SERIES_REFERENCE, STATUS

FLOWS = ("p1", "q1", "p2", "q2")


class GupfcMonitorParams(WatchParams):
    """What counts as settled."""

    period: float = param(1.0 / 2880.0, "sampling period", "s", ge=1e-5, le=0.1)
    window: float = param(10.0, "the figures are those of this last time", "s", gt=0.0, le=3600.0)
    band: float = param(0.02, "half width of the band around a reference", "pu", gt=0.0, le=1.0)


class GupfcMonitor(Watch[GupfcMonitorParams]):
    """Since the last change of a reference: settling times and mean errors of the flows, power balance; extremes.

    The settling time of a flow is the time from the change to the first sample from which on it stays in the band. The
    figures of a scenario count from a step of one reference, in parts of it; here a step of any disturbs all four
    flows, most of which are to stay where they are.
    """

    INPUTS = (STATUS, *(replace(port, name=f"series_{k}") for k, port in SERIES_REFERENCE.items()))

    def start(self) -> None:
        """No reference yet."""
        super().start()
        self._asked: tuple[float, ...] = ()
        self._changed = 0.0

    def update(
        self, t: int, status: tuple[float, ...], series_1: tuple[float, ...] | None, series_2: tuple[float, ...] | None
    ) -> Mapping[str, tuple[float, ...]]:
        """Take one sample in."""
        if series_1 is not None and series_2 is not None and (*series_1, *series_2) != self._asked:
            self._asked, self._changed = (*series_1, *series_2), t / 1e9
        return super().update(t, status=status)

    def _settling_time(self, signals: measures.SignalMap, signal: str, reference: float) -> float:
        settled = measures.error_settling_time(signals, signal, reference=reference, band=self.p.band,
                                              start=self._changed)  # fmt: skip
        return settled - self._changed

    def figures(self) -> Iterator[Figure]:
        """Extremes of the window, figures since the last change."""
        for name in ("v1", "v_dc"):
            signal = {"signal": f"gupfc/status/{name}/position"}
            yield self.figure(f"{name}_min", measures.minimum, signal)
            yield self.figure(f"{name}_max", measures.maximum, signal)
        if not self._asked:
            return
        for name, wanted in zip(FLOWS, self._asked, strict=True):
            error = {"signal": f"gupfc/status/{name}/position", "reference": wanted}
            yield Figure(f"{name}_settling_time", self._settling_time, error, "s", 1.0)
            yield self.figure(f"{name}_mean_error", measures.mean_error, error | {"start": self._changed})
        yield self.figure("power_balance", power_balance, {"start": self._changed})


main = executable(GupfcMonitor)
