"""How far an estimate can be trusted: its scatter inside the record, and the accuracy of the instruments."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from softrig_core import Array, Params, param

from ..records.record import GROUPS, Record, Status
from .equations import lagrange
from .location import Location, Locator, locate
from .objective import LocatorParams

# The window is cut into this many parts; their locations show the scatter within the record.
STRETCHES = 8


class ErrorBudget(Params):
    """Standard uncertainties of the instruments and of the line data."""

    sync_us: float = param(1.0, "clocks of the two ends", "us", ge=0.0, le=1e5)
    ratio: float = param(0.005, "each instrument transformer, relative", ge=0.0, le=0.5)
    reactance: float = param(0.01, "line inductance, relative", ge=0.0, le=0.5)
    resistance: float = param(0.05, "line resistance, relative", ge=0.0, le=1.0)


@dataclass(frozen=True)
class Confidence:
    """Uncertainty of a position.

    Parameters
    ----------
    scatter_km : float
        Standard error of the position from the stretches of the window located one by one.
    effects_km : dict of str to float
        Shift of the position by each item of the budget.
    contrast : float
        max F / min F: how much deeper the minimum is than the rest of the line.
    """

    scatter_km: float
    effects_km: dict[str, float]
    contrast: float

    @property
    def total_km(self) -> float:
        """Root of the sum of squares of the scatter and all effects."""
        return float(np.sqrt(self.scatter_km**2 + sum(e * e for e in self.effects_km.values())))


def confidence(record: Record, p: LocatorParams, location: Location, budget: ErrorBudget | None = None) -> Confidence:
    """Describe how far a position can be trusted.

    Raises
    ------
    ValueError
        The location has no position.
    """
    if location.x_km is None:
        raise ValueError(f"there is no position: {location.text}")
    fixed = p.model_copy(update={"mode": str(location.mode), "algorithm": "brent"})
    base = locate(record, fixed)
    effects = {}
    for name, disturbed, settings in _disturbed(record, fixed, budget or ErrorBudget()):
        moved = locate(disturbed, settings)
        if moved.x_km is not None and base.x_km is not None:
            effects[name] = abs(moved.x_km - base.x_km)
    contrast = location.f_max / location.f_min if location.f_min else math.inf
    return Confidence(_scatter(Locator(record, fixed), location), effects, contrast)


def _scatter(work: Locator, location: Location) -> float:
    """Locate on stretches of the window, each within 2 km of the answer; standard deviation of their mean."""
    from scipy.optimize import minimize_scalar

    assert location.x_km is not None
    low, high = max(location.x_km - 2.0, 0.0), min(location.x_km + 2.0, work.section.length)
    edges = np.linspace(work.first, work.first + work.count, STRETCHES + 1).astype(int)
    positions = [
        minimize_scalar(
            lambda x, a=a, b=b: float(work.f(np.array([x]), location.mode, (int(a), int(b - a)))[0]),
            bounds=(low, high),
            method="bounded",
            options={"xatol": 1e-4},
        ).x
        for a, b in pairwise(edges)
        if b > a
    ]
    return float(np.std(positions, ddof=1) / np.sqrt(len(positions)))


def _disturbed(record: Record, p: LocatorParams, budget: ErrorBudget) -> Iterator[tuple[str, Record, LocatorParams]]:
    if budget.sync_us:
        late = replace(record, samples=np.hstack([record.samples[:, :6], shifted(record, budget.sync_us * 1e-6)]))
        yield f"clocks {budget.sync_us:g} us", late, p
    for k, group in enumerate(GROUPS):
        if budget.ratio:
            samples = record.samples.copy()
            samples[:, 3 * k : 3 * k + 3] *= 1.0 + budget.ratio
            yield f"{group} {100 * budget.ratio:g} %", replace(record, samples=samples), p
    for name, key, error in (("L1", "l1", budget.reactance), ("R1", "r1", budget.resistance)):
        if error:
            line = p.line.model_copy(update={key: getattr(p.line, key) * (1.0 + error)})
            yield f"{name} {100 * error:g} %", record, p.model_copy(update={"line": line})


def shifted(record: Record, late: float) -> Array:
    """Return the samples of end R as taken by a clock that is late by `late` seconds (less than a sample)."""
    w = np.empty(6)
    lagrange(late * record.rate, w)
    r = np.pad(record.samples[:, 6:], ((3, 3), (0, 0)), mode="edge")
    n = len(record.samples)
    result: Array = np.sum([w[j] * r[5 - j : 5 - j + n] for j in range(6)], axis=0)
    return result


def conditions(record: Record, p: LocatorParams, window: str) -> str:
    """Describe in a few lines what a location depends on: the line, the record, the window and their sources."""
    line, end = p.line, record.start + (len(record.samples) - 1) / record.rate
    lines = [
        f"  line {line.length:g} km, {line.r1:g} ohm/km, {line.l1:g} H/km, {line.c1:g} F/km",
        f"  record {record.start:.6g} to {end:.6g} s, {len(record.samples)} samples at {record.rate:g} Hz",
        f"  window {p.window_start:.6g} to {p.window_end:.6g} s, {window}",
    ]
    return "\n".join([*lines, f"  {record.note}"] if record.note else lines)


def describe(location: Location, trust: Confidence | None, length: float) -> str:
    """Describe a location in a few lines for a person."""
    if location.x_km is None or trust is None:
        return location.text
    lines = [
        f"fault at {location.x_km:.3f} km from S ({length - location.x_km:.3f} km from R), "
        f"standard uncertainty {_metres(trust.total_km)}",
        f"  aerial mode {location.mode}, F from {location.f_min:.4g} to {location.f_max:.4g} V "
        f"(contrast {trust.contrast:.3g})",
        f"  scatter inside the record {_metres(trust.scatter_km)}",
    ]
    lines += [f"  {name} would move it by {_metres(e)}" for name, e in trust.effects_km.items()]
    if location.status == Status.AT_TERMINAL:
        lines.append(f"  {location.text}: the fault may be beyond the line")
    return "\n".join(lines)


def _metres(km: float) -> str:
    return f"{1e3 * km:.1f} m" if km < 1.0 else f"{km:.2f} km"
