"""Figure functions of a tracker: against the true global maximum power point, which only these functions know.

The modules of the string and its initial conditions are those of the rig's plant.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from softrig_core import Array, SignalMap, figure
from softrig_core.judge.measures import HALF_NS, begin, held, mean_over

from .array import split
from .module import ModuleParams
from .string import Characteristic, characteristic

POWER, VOLTAGE = "converter/state/p_in/position", "converter/state/v_in/position"
READS = (POWER, VOLTAGE, "pv/environment/*")
STRING = {"module": "pv/module", "first": "pv/conditions"}


def characteristic_of(conditions: tuple[float, ...], module: ModuleParams) -> Characteristic:
    """Return the string's characteristic under irradiances and temperatures, one of each a module."""
    return characteristic(module, *split(conditions))


class _Run:
    """Power, voltage and true maximum of a recording in a time window, ends included."""

    def __init__(
        self,
        signals: SignalMap,
        module: Mapping[str, Any],
        first: Sequence[float],
        start: float | None,
        end: float | None,
    ) -> None:
        self.module = ModuleParams(**module)
        self.t, self.power, self.gaps = held(signals, POWER, start, end)
        self.v = held(signals, VOLTAGE, start, end)[1]
        names = [f"pv/environment/{kind}{k}/position" for kind in "gt" for k in range(1, len(first) // 2 + 1)]
        changes = signals[names[0]][0]
        rows = np.column_stack([signals[name][1] for name in names])
        # the characteristic at a sample is that published at the tick before it; at the first, the initial one
        self._at = np.searchsorted(changes, self.t - HALF_NS)
        self._rows = [tuple(first), *map(tuple, rows.tolist())]

    def source(self, k: int) -> Characteristic:
        """Return the characteristic that is valid at sample k."""
        return characteristic_of(self._rows[self._at[k]], self.module)

    @property
    def gmpp(self) -> Array:
        """Global maximum in W at each sample."""
        power = {
            row: characteristic_of(row, self.module).gmpp.p for row in {self._rows[k] for k in np.unique(self._at)}
        }
        return np.array([power[self._rows[k]] for k in self._at])


@figure("W", READS, STRING, (0.0, math.inf))
def gmpp(signals: SignalMap, *, module: Mapping[str, Any], first: tuple[float, ...], at: float | None = None) -> float:
    """Return the global maximum power in W at the time `at` in s (the end), of the static characteristic."""
    return float(_Run(signals, module, first, at, None).gmpp[-1 if at is None else 0])


@figure("W", READS, STRING, (0.0, math.inf))
def local_maximum(signals: SignalMap, *, at: float, module: Mapping[str, Any], first: tuple[float, ...]) -> float:
    """Largest maximum power in W below the global one at the time `at` in s, of the static characteristic."""
    return sorted(peak.p for peak in _Run(signals, module, first, at, None).source(0).peaks)[-2]


@figure("%", READS, STRING, (0.0, 100.0), follows=True)
def efficiency(
    signals: SignalMap,
    *,
    module: Mapping[str, Any],
    first: tuple[float, ...],
    start: float | None = None,
    end: float | None = None,
) -> float:
    """Energy in % of the energy at the global maximum; over a whole run this is the energy share."""
    run = _Run(signals, module, first, start, end)
    return 100.0 * mean_over(run.power, run.gaps) / mean_over(run.gmpp, run.gaps)


@figure("", READS, STRING, follows=True)
def in_global_basin(
    signals: SignalMap, *, module: Mapping[str, Any], first: tuple[float, ...], at: float | None = None
) -> float:
    """1 when the voltage at the time `at` in s (the end) is in the basin of the global maximum, else 0."""
    run = _Run(signals, module, first, None, at)
    source = run.source(-1)
    return float(source.basin(float(run.v[-1])) == source.global_basin)


@figure("s", READS, STRING)
def tracking_time(
    signals: SignalMap,
    *,
    module: Mapping[str, Any],
    first: tuple[float, ...],
    level: float = 0.99,
    start: float | None = None,
    end: float | None = None,
    stay: float = math.inf,
) -> float:
    """Time in s from `start` until the power stayed at `level` of the global maximum or above; inf if it did not.

    It must stay there to the end, or for `stay` s: a tracker may scan its range again later.
    """
    run = _Run(signals, module, first, start, end)
    low = np.flatnonzero(run.power < level * run.gmpp)
    # First and last sample of each stretch between two drops.
    since, until = np.append(0, low + 1), np.append(low, run.t.size - 1)
    stays = run.t[until] - run.t[np.minimum(since, until)] >= stay
    stays[-1] |= since[-1] < run.t.size
    return float(run.t[since[stays][0]] - begin(run.t, start)) if stays.any() else math.inf
