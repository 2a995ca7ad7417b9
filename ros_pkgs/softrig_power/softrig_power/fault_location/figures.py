"""Figures of a fault location run, for scenario files."""

from __future__ import annotations

from typing import Literal

import numpy as np
from softrig_core import SignalMap, figure

from .ports import LOCATION, VERDICT
from .records.record import Status


def _last(signals: SignalMap, topic: str, names: tuple[str, ...], name: str) -> float:
    _, values = signals[f"{topic}/{names.index(name)}"]
    if not len(values):
        raise ValueError(f"no message was recorded on {topic}")
    return float(values[-1])


@figure("m", ("location/0",), {"truth": "fault_location/x_km"})
def location_error(signals: SignalMap, *, truth: float) -> float:
    """Located less true distance (km), in m."""
    return 1e3 * (_last(signals, "location", LOCATION, "x_km") - truth)


@figure("%", ("location/0",), {"truth": "fault_location/x_km", "length": "fault_location/length"})
def location_error_percent(signals: SignalMap, *, truth: float, length: float) -> float:
    """|located - true distance| in % of the length of the line (both km), as the paper's tables."""
    return 100.0 * abs(_last(signals, "location", LOCATION, "x_km") - truth) / length


@figure("", reads=("verdict/0",), follows=True)
def location_status(signals: SignalMap, *, status: str) -> float:
    """1 when the locator's last verdict is `status` (ok, no_fault, mode_not_excited, ...), else 0."""
    return float(_last(signals, "verdict", VERDICT, "status") == Status[status.upper()])


@figure("", reads=("location/0",))
def locations(signals: SignalMap) -> float:
    """Return the number of published positions."""
    return float(len(signals["location/0"][1]))


@figure("A", reads=tuple(f"line/fault_current/{axis}" for axis in "xyz"))
def fault_peak(signals: SignalMap, *, phase: Literal["a", "b", "c"] | None = None) -> float:
    """Return the largest sampled |fault current| of a phase; of all phases if none is named."""
    axes = "xyz" if phase is None else "xyz"["abc".index(phase)]
    return max(float(np.abs(signals[f"line/fault_current/{axis}"][1]).max()) for axis in axes)
