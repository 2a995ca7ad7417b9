"""Figures of merit of a tracker: against the true global maximum power point, which only these functions know."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from softrig_core.model.block import Observer
from softrig_core.model.params import BlockParams, param
from softrig_core.model.port import Port
from softrig_core.node import executable
from softrig_core.rig.metrics import SignalMap

from .array import ArrayParams, possible, split
from .module import Array, ModuleParams
from .ports import array_port, environment
from .string import Characteristic, characteristic

POWER, VOLTAGE = "converter/state/p_in/position", "converter/state/v_in/position"


def _string(conditions: tuple[float, ...], module: ModuleParams) -> Characteristic:
    return characteristic(module, *split(conditions))


class MpptMetricsParams(ArrayParams, BlockParams):
    """The string, and when it counts as tracked."""

    period: float = param(0.001, "sampling period", "s", gt=0.0)
    level: float = param(0.98, "tracked: at least this share of the maximum", gt=0.0, le=1.0)


class MpptMetrics(Observer):
    """Efficiency, basin, tracking time and energy share, from what a tracker sees and from what it must not see.

    - efficiency: power now over the global maximum
    - in_global_basin: 1 when the voltage is in the basin of the global maximum
    - tracking_time: from the last change of the conditions until the power stayed at `level` or above
    - energy_share: energy since the start over the energy at the global maximum
    """

    Params = MpptMetricsParams

    @classmethod
    def ports(cls, params: MpptMetricsParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """One irradiance and one temperature a module."""
        return (array_port("port"), environment(len(params.irradiance), held=True)), ()

    def start(self) -> None:
        """Conditions of the parameters."""
        self._conditions = self.p.irradiance + self.p.temperature
        self._source = _string(self._conditions, self.p.module)
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
            self._source = _string(environment, self.p.module)
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


class _Run:
    """Power, voltage and true maximum of a recording in a time window, ends included."""

    def __init__(
        self, signals: SignalMap, module: Mapping[str, Any] | None, start: float | None, end: float | None
    ) -> None:
        self.module = ModuleParams(**(module or {}))
        t, power = signals[POWER]
        inside = (t >= (-np.inf if start is None else start - 1e-9)) & (t <= (np.inf if end is None else end + 1e-9))
        if not inside.any():
            raise ValueError(f"no samples of {POWER} from {start} to {end} s; the record has {t[0]:g} to {t[-1]:g} s")
        self.t, self.power, self.v = t[inside], power[inside], signals[VOLTAGE][1][inside]
        names = [f"pv/environment/{kind}{k}/position" for kind in "gt" for k in range(1, _modules(signals) + 1)]
        changes = signals[names[0]][0]
        rows = np.column_stack([signals[name][1] for name in names])
        # what holds at a sample is what was published at the tick before it
        self._at = np.maximum(np.searchsorted(changes, self.t - 1e-9) - 1, 0)
        self._rows = [tuple(row) for row in rows.tolist()]

    def source(self, k: int) -> Characteristic:
        """Characteristic that holds at sample k."""
        return _string(self._rows[self._at[k]], self.module)

    @property
    def gmpp(self) -> Array:
        """Global maximum in W at each sample."""
        power = {row: _string(row, self.module).gmpp.p for row in {self._rows[k] for k in np.unique(self._at)}}
        return np.array([power[self._rows[k]] for k in self._at])


def _modules(signals: SignalMap) -> int:
    return sum(name.startswith("pv/environment/g") for name in signals)


def gmpp(signals: SignalMap, *, at: float, module: Mapping[str, Any] | None = None) -> float:
    """Global maximum power in W at the time `at` in s, of the static characteristic."""
    return float(_Run(signals, module, at, None).gmpp[0])


def power(signals: SignalMap, *, start: float | None = None, end: float | None = None) -> float:
    """Mean power of the string in W."""
    return float(_Run(signals, None, start, end).power.mean())


def efficiency(
    signals: SignalMap, *, start: float | None = None, end: float | None = None,
    module: Mapping[str, Any] | None = None,
) -> float:  # fmt: skip
    """Energy in % of the energy at the global maximum; over a whole run this is the energy share."""
    run = _Run(signals, module, start, end)
    return float(100.0 * run.power.sum() / run.gmpp.sum())


def in_global_basin(signals: SignalMap, *, at: float | None = None, module: Mapping[str, Any] | None = None) -> float:
    """1 when the voltage at the time `at` in s (the end) is in the basin of the global maximum, else 0."""
    run = _Run(signals, module, None, at)
    source = run.source(-1)
    return float(source.basin(float(run.v[-1])) == source.global_basin)


def tracking_time(
    signals: SignalMap, *, level: float = 0.99, start: float | None = None, end: float | None = None,
    module: Mapping[str, Any] | None = None,
) -> float:  # fmt: skip
    """Time in s from `start` until the power stayed at `level` of the global maximum or above; inf if it did not."""
    run = _Run(signals, module, start, end)
    low = np.flatnonzero(run.power < level * run.gmpp)
    if low.size == 0:
        return 0.0
    return float("inf") if low[-1] == run.t.size - 1 else float(run.t[low[-1] + 1] - run.t[0])


def settling_time(
    signals: SignalMap, *, band: float = 0.02, start: float | None = None, end: float | None = None
) -> float:
    """Time in s from `start` until the power stayed within `band` of its last value, at whichever peak that is."""
    run = _Run(signals, None, start, end)
    out = np.flatnonzero(np.abs(run.power - run.power[-1]) > band * abs(run.power[-1]))
    return 0.0 if out.size == 0 else float(run.t[out[-1] + 1] - run.t[0])


main = executable(MpptMetrics)
