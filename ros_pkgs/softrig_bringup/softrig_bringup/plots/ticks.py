"""Ticks of an axis: round numbers between its limits, and how they are printed.

The steps and digits are those of matplotlib's `MaxNLocator` and `ScalarFormatter`, so that a picture on the screen and
the same one in print have the same numbers at their axes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

STEPS = (0.1, 0.2, 0.25, 0.5, 1.0, 2.0, 2.5, 5.0, 10.0, 20.0)
POWERS = (-3, 5)  # powers of ten from which on the axis title has a factor
_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def round_ticks(low: float, high: float, most: int, integers: bool = False) -> list[float]:
    """Return ticks between two limits.

    Parameters
    ----------
    low, high : float
        Finite, low < high.
    most : int
        Of intervals.
    integers : bool
        Only whole numbers.
    """
    raw = (high - low) / max(1, most)
    scale = 10.0 ** math.floor(math.log10(raw))
    steps = [s * scale for s in STEPS]
    if integers:
        steps = [s for s in steps if s < 1.0 or abs(s - round(s)) < 1e-3]
    fitting = next((k for k, s in enumerate(steps) if s >= raw), len(steps) - 1)
    result: list[float] = []
    for step in reversed(steps[: fitting + 1]):  # a finer step if this one gives fewer than two ticks
        if integers and math.floor(high) - math.ceil(low) >= 1:
            step = max(1.0, step)
        first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
        result = [k * step for k in range(first, last + 1)]
        if len(result) > 1:
            break
    return result


def power_of(ticks: Sequence[float]) -> int:
    """Return the power of ten that is moved to the axis title; 0 for none."""
    largest = max(map(abs, ticks), default=0.0)
    power = math.floor(math.log10(largest)) if largest else 0
    return power if power <= POWERS[0] or power >= POWERS[1] else 0


def texts(ticks: Sequence[float], power: int, limits: tuple[float, float]) -> list[str]:
    """Return the printed ticks, all with as many digits as needed to distinguish them.

    Parameters
    ----------
    power : int
        See `power_of`.
    limits : (float, float)
        Limits of the axis, which are used if there is only one tick.
    """
    if not len(ticks):
        return []
    values = np.array(ticks, float) / 10.0**power
    known = np.append(values, np.array(limits) / 10.0**power) if len(values) < 2 else values
    span = float(np.ptp(known)) or float(np.abs(known).max()) or 1.0
    size = math.floor(math.log10(span))
    digits = max(0, 3 - size)
    while digits >= 0 and np.abs(values - values.round(digits)).max() < 1e-3 * 10.0**size:
        digits -= 1
    return [minus(f"{value + 0.0:.{digits + 1}f}") for value in np.where(np.abs(values) < 1e-12 * span, 0.0, values)]


def minus(text: str) -> str:
    """Return the text of a number with a minus sign as wide as a digit."""
    return text.replace("-", "\N{MINUS SIGN}")


def with_power(title: str, power: int, unit_alone: bool) -> str:
    """Insert a factor before the unit of an axis title: "Cost, 10⁴ $"; `unit_alone`: the title is only a unit."""
    if not power:
        return title
    factor = f"10{str(power).translate(_SUPERSCRIPT)}"
    name, comma, unit = title.rpartition(", ")
    if comma or unit_alone:
        return f"{name}{comma}{factor} {unit}"
    return f"{unit}, {factor}".removeprefix(", ")
