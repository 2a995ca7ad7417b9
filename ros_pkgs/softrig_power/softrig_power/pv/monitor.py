"""Figures of merit of a tracker while it runs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from softrig_core import BlockParams, Observer, Port, executable, param

from .array import ArrayParams, possible
from .figures import characteristic_of
from .ports import array_port, environment


class MpptMonitorParams(ArrayParams, BlockParams):
    """The string, and when it counts as tracked."""

    period: float = param(0.001, "sampling period", "s", gt=0.0, le=100.0)
    level: float = param(0.98, "tracked: at least this share of the maximum", gt=0.0, le=1.0)


class MpptMonitor(Observer[MpptMonitorParams]):
    """Efficiency, basin, tracking time and energy share, from what a tracker sees and from what it must not see.

    - efficiency: power now over the global maximum
    - in_global_basin: 1 when the voltage is in the basin of the global maximum
    - tracking_time: from the last change of the conditions until the power stayed at `level` or above
    - energy_share: energy since the start over the energy at the global maximum
    """

    @classmethod
    def agreed(cls, params: MpptMonitorParams) -> Mapping[str, Any]:
        """The string that it judges."""
        return params.agreed()

    @classmethod
    def ports(cls, params: MpptMonitorParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """One irradiance and one temperature a module."""
        return (array_port("port"), environment(len(params.irradiance), held=True)), ()

    def start(self) -> None:
        """Conditions of the parameters."""
        self._conditions = self.p.irradiance + self.p.temperature
        self._source = characteristic_of(self._conditions, self.p.module)
        self._changed = self._reached = 0.0
        self._energy = self._available = 0.0
        self._v = self._power = 0.0

    def update(
        self, t: int, port: tuple[float, ...], environment: tuple[float, ...] | None
    ) -> Mapping[str, tuple[float, ...]]:
        """Take one sample in; it still belongs to the conditions of the tick before."""
        seconds, best = t / 1e9, self._source.gmpp.p
        self._v, self._power = port[0], port[0] * port[1]
        self._energy += self._power
        self._available += best
        if self._power < self.p.level * best:
            self._reached = seconds + self.p.period
        if environment is not None and environment != self._conditions and possible(self, environment):
            self._conditions = environment
            self._source = characteristic_of(environment, self.p.module)
            self._changed = self._reached = seconds
        return {}

    def status(self) -> Mapping[str, tuple[float, str]]:
        """Give the figures so far; no ratio to a maximum of zero."""
        source = self._source
        figures = {
            "gmpp": (source.gmpp.p, "W"),
            "power": (self._power, "W"),
            "in_global_basin": (float(source.basin(self._v) == source.global_basin), ""),
            "tracking_time": (self._reached - self._changed, "s"),
        }
        if source.gmpp.p > 0.0:
            figures["efficiency"] = (100.0 * self._power / source.gmpp.p, "%")
        if self._available > 0.0:
            figures["energy_share"] = (100.0 * self._energy / self._available, "%")
        return figures


main = executable(MpptMonitor)
