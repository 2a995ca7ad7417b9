"""Numbers of figures as pages and tables print them."""

from __future__ import annotations

import math
from collections.abc import Sequence

from softrig_core.judge.words import NEVER
from softrig_core.verdict.result import DECIDED, Result

from .html import NONE

__all__ = ["NEVER", "accepted", "difference", "in_words", "measured", "measured_here", "number", "short", "spans"]


MOST = 3  # intervals that are written out


def number(value: float | None) -> str:
    """Format a number from a file or a person, with all its digits."""
    return NONE if value is None else f"{value:.10g}".replace("-", "−")


def short(value: float | None) -> str:
    """Write a measured number with six digits; empty for None."""
    return "" if value is None else f"{value:.6g}"


def in_words(metric: Result) -> str:
    """Return the words for a missing value: it never happens, or was not measured; empty if there is a value."""
    if metric.value is not None:
        return ""
    word, *remaining = metric.error.split(" ")
    return word if word == NEVER or " ".join(remaining) == DECIDED else "not measured"


def measured_here(metric: Result) -> bool:
    """Return whether the run has a result for a figure: a value, an event that never happened, or a requirement that
    holds.
    """
    return in_words(metric) != "not measured"


def measured(metric: Result) -> str:
    """The measured value, to a hundredth of its tolerance."""
    if metric.value is None:
        return in_words(metric)
    if not metric.tolerance:
        return f"{metric.value:.6g}".replace("-", "−")
    decimals = max(0, 2 - math.floor(math.log10(metric.tolerance)))
    return f"{metric.value:.{decimals}f}".replace("-", "−")


def spans(intervals: Sequence[tuple[float, float]]) -> str:
    """Write intervals of time: ``from 1.4 to 2.1 s, at 3 s``; of many the first ones and how many more."""
    words = [f"at {a:.6g} s" if a == b else f"from {a:.6g} to {b:.6g} s" for a, b in intervals[:MOST]]
    more = f" and {len(intervals) - MOST} times more, to {intervals[-1][1]:.6g} s" if len(intervals) > MOST else ""
    return ", ".join(words) + more


def difference(value: float | None, published: float | None) -> str:
    """Return how far a measured value is from the published one, in percent of it."""
    if value is None or published is None:
        return NONE
    if published == 0.0:
        return f"{value:+.3g}".replace("-", "−")
    return f"{100.0 * (value - published) / abs(published):+.2f} %".replace("-", "−")


def accepted(metric: Result) -> str:
    """Write the accepted interval; empty without an expectation."""
    parts = []
    if metric.expected is not None:
        parts.append(f"{number(metric.expected)} ± {number(metric.tolerance or 0.0)}")
    if metric.at_least is not None:
        parts.append(f"≥ {number(metric.at_least)}")
    if metric.at_most is not None:
        parts.append(f"≤ {number(metric.at_most)}")
    return ", ".join(parts)
