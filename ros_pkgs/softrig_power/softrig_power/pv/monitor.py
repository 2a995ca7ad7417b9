"""Figures of merit of a tracker while it runs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from softrig_core import BlockParams, Observer, Port, executable, param

from .array import ArrayParams, possible
from .ports import array_port, environment


class MpptMonitorParams(ArrayParams, BlockParams):
    """The string, and when it counts as tracked."""

    period: float = param(0.001, "sampling period", "s", gt=0.0, le=100.0)
    level: float = param(0.98, "tracked: at least this share of the maximum", gt=0.0, le=1.0)


class State(NamedTuple):
    """What is remembered from tick to tick."""

    conditions: tuple[float, ...]
    """Irradiance (W/m^2) and temperature (deg C) of each module."""

    changed: float = 0.0
    """When they did, s."""

    reached: float = 0.0
    """From when on the power has been at the level, s."""

    energy: float = 0.0
    """Sum of the powers, W."""

    available: float = 0.0
    """Sum of the maxima, W."""

    v: float = 0.0
    """V."""

    power: float = 0.0
    """W."""


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

    def setup(self) -> None:
        """Characteristics of the string."""
        self._source = self.p.sources()

    def first(self) -> State:
        """Conditions of the parameters."""
        return State(self.p.irradiance + self.p.temperature)

    def update(
        self, x: State, t: int, *, port: tuple[float, ...], environment: tuple[float, ...] | None
    ) -> tuple[State, Mapping[str, tuple[float, ...]]]:
        """Take one sample in; it still belongs to the conditions of the tick before."""
        conditions, changed, reached, energy, available, _, _ = x
        seconds, best = t / 1e9, self._source(conditions).gmpp.p
        v, power = port[0], port[0] * port[1]
        if power < self.p.level * best:
            reached = seconds + self.p.period
        if environment is not None and environment != conditions and possible(self, environment):
            conditions = environment
            changed = reached = seconds
        return State(conditions, changed, reached, energy + power, available + best, v, power), {}

    def status(self, x: State) -> Mapping[str, tuple[float, str]]:
        """Give the figures so far; no ratio to a maximum of zero."""
        source = self._source(x.conditions)
        figures = {
            "gmpp": (source.gmpp.p, "W"),
            "power": (x.power, "W"),
            "in_global_basin": (float(source.basin(x.v) == source.global_basin), ""),
            "tracking_time": (x.reached - x.changed, "s"),
        }
        if source.gmpp.p > 0.0:
            figures["efficiency"] = (100.0 * x.power / source.gmpp.p, "%")
        if x.available > 0.0:
            figures["energy_share"] = (100.0 * x.energy / x.available, "%")
        return figures


main = executable(MpptMonitor)
