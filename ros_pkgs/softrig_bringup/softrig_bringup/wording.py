"""Numbers of figures as pages and tables print them."""

from __future__ import annotations

import math

from softrig_core.rig.figures import Result

from .html import NONE


def number(value: float | None) -> str:
    """A number that somebody wrote down, with all its digits."""
    return NONE if value is None else f"{value:.10g}".replace("-", "−")


def measured(metric: Result) -> str:
    """The measured value, to a hundredth of its tolerance."""
    if metric.value is None:
        return NONE
    if not metric.tolerance:
        return f"{metric.value:.6g}".replace("-", "−")
    decimals = max(0, 2 - math.floor(math.log10(metric.tolerance)))
    return f"{metric.value:.{decimals}f}".replace("-", "−")


def difference(value: float | None, published: float | None) -> str:
    """How far a measured value is from the published one, in percent of it."""
    if value is None or published is None:
        return NONE
    if published == 0.0:
        return f"{value:+.3g}".replace("-", "−")
    return f"{100.0 * (value - published) / abs(published):+.2f} %".replace("-", "−")


def accepted(metric: Result) -> str:
    """Write the interval that passes; empty when nothing was asked."""
    parts = []
    if metric.expected is not None:
        parts.append(f"{number(metric.expected)} ± {number(metric.tolerance or 0.0)}")
    if metric.at_least is not None:
        parts.append(f"≥ {number(metric.at_least)}")
    if metric.at_most is not None:
        parts.append(f"≤ {number(metric.at_most)}")
    return ", ".join(parts)
